"""The released (JAX) names of the memories' tensors."""

from mme_vla.memory.base import MemoryModule
from mme_vla.memory.perceptual import PerceptualMemory
from mme_vla.naming import Derived, NameTable, Unread, linear, prefixed

ENCODER = "mem_encoder/feature_encoder"


def released_names(memory: MemoryModule) -> NameTable | None:
    """The table of a memory, or None where no released checkpoint has one (a memory of one's own)."""
    if isinstance(memory, PerceptualMemory):
        return prefixed("encoder.position", linear(f"{ENCODER}/pos_proj")) | prefixed(
            "encoder.project", linear(f"{ENCODER}/encoder_static")
        )
    return None


def released_unread(memory: MemoryModule | None) -> list[Unread]:
    """What released checkpoints hold of a memory and no action reads."""
    return []


def released_derived(memory: MemoryModule | None) -> list[Derived]:
    """Constants that released checkpoints store of a memory."""
    return []
