"""Optional speed of a backbone: compiled attention, CUDA graphs, recomputation, sharding groups, real-time chunking.

Each is a class to inherit from beside `Backbone`. Callers test for it with `isinstance`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mme_vla.speed.recompute import Recompute
    from mme_vla.speed.sharding import ShardGroup


class HasAttentionBackends:
    """Capability of a backbone: it can compute attention with each backend (`mme_vla.backbone.attention.BACKENDS`)."""

    def set_attention_backend(self, name: str) -> None:
        """Use another backend than `auto`."""
        raise NotImplementedError


class Recomputes:
    """Capability of a backbone or policy: it can compute activations again in the backward pass."""

    def recompute(self, mode: "Recompute") -> None:
        """Set what to compute again; False keeps all activations."""
        raise NotImplementedError


class Sharded:
    """Capability of a backbone or policy: it has sharding groups of its own instead of `backbone_groups`."""

    def shard_groups(self) -> "Sequence[ShardGroup]":
        """Modules that are gathered one by one. All other weights are gathered for a whole pass, in float32."""
        raise NotImplementedError


class CapturableSampling:
    """Capability of a backbone: `sample` never waits for the GPU, so that it can be captured as a CUDA graph."""

    def compile_sampling(self) -> None:
        """Keep what depends on weights alone between chunks."""
        raise NotImplementedError

    def sampling_stamp(self) -> object:
        """Identifies the weights that the kept values were computed from; graphs are captured anew when it changes."""
        raise NotImplementedError
