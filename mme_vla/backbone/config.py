"""Sizes of π0.5 (`pi05`) and of its small twin (`tiny`), and the class that the section `backbone`
names.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mme_vla.errors import brief, check_choice, check_multiple, require

LARGEST, DEEPEST = 2**24, 2**10
"""Bounds of every size and of layers, far above any network here: a number of a damaged file
exceeds them.
"""


def check_positive(config: Any, prefix: str) -> None:
    """Raise an error if a number of a dataclass is not a possible size."""
    for name, value in vars(config).items():
        if isinstance(value, float):
            require(0 < value < 1, f"{prefix}{name}={brief(value)} must lie between 0 and 1.")
        if isinstance(value, int) and not isinstance(value, bool):
            most = DEEPEST if name in ("depth", "horizon") else LARGEST
            require(
                1 <= value <= most,
                f"{prefix}{name}={brief(value)} must be at least 1 and at most {most}.",
            )


@dataclass(frozen=True)
class VisionConfig:
    """SigLIP; its output width is the VLM's. `image_size` must be a multiple of `patch_size`."""

    image_size: int = 224
    patch_size: int = 14
    width: int = 1152
    depth: int = 27
    mlp_dim: int = 4304
    num_heads: int = 16

    def __post_init__(self) -> None:
        check_positive(self, "backbone.vision.")
        check_multiple(
            "backbone.vision.", "image_size", self.image_size, "patch_size", self.patch_size
        )


@dataclass(frozen=True)
class ExpertConfig:
    """One Gemma expert's own sizes; depth, heads and head width are shared by all (paper, section
    4.1).
    """

    width: int
    mlp_dim: int


@dataclass(frozen=True)
class BackboneConfig:
    """π0.5: a vision tower, a VLM expert and an action expert under joint attention."""

    vision: VisionConfig = field(default_factory=VisionConfig)
    vlm: ExpertConfig = field(default_factory=lambda: ExpertConfig(2048, 16384))
    action: ExpertConfig = field(default_factory=lambda: ExpertConfig(1024, 4096))
    depth: int = 18
    num_heads: int = 8
    num_kv_heads: int = 1
    head_dim: int = 256
    vocab_size: int = 257_152
    action_dim: int = 32
    horizon: int = 20
    time_distribution: str = (
        "beta"  # `beta`: 0.001 + 0.999·Beta(1.5, 1), as released; `uniform`: the paper's text
    )
    # a key of HEADS, its options
    head: Mapping[str, Any] = field(default_factory=lambda: {"name": "flow"}, hash=False)

    def __post_init__(self) -> None:
        check_positive(self, "backbone.")
        check_positive(self.vlm, "backbone.vlm.")
        check_positive(self.action, "backbone.action.")
        check_multiple("backbone.", "num_heads", self.num_heads, "num_kv_heads", self.num_kv_heads)
        check_multiple("backbone.", "head_dim", self.head_dim, "pairs", 2)  # of a rotation
        # sin and cos of the flow time
        check_multiple("backbone.", "action.width", self.action.width, "pairs", 2)
        check_choice("backbone.time_distribution", self.time_distribution, ("beta", "uniform"))
