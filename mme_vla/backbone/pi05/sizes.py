"""Sizes as rows of a table: `pi05` is the real model, `tiny` a first-class citizen that trains on a laptop's CPU."""

from dataclasses import dataclass, field

from mme_vla.backbone.sizes import check_positive
from mme_vla.errors import UserError


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
        check_positive(self, "vision.")
        if self.image_size % self.patch_size:
            raise UserError(f"vision.image_size={self.image_size} must be a multiple of patch_size={self.patch_size}.")


@dataclass(frozen=True)
class ExpertConfig:
    """One Gemma expert's own sizes; depth, heads and head width are shared by all (paper, section 4.1)."""

    width: int
    mlp_dim: int

    def __post_init__(self) -> None:
        check_positive(self, "an expert's ")


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
    time_distribution: str = "beta"  # `beta`: 0.001 + 0.999·Beta(1.5, 1), as released; `uniform`: the paper's text

    def __post_init__(self) -> None:
        check_positive(self, "backbone.")
        if self.num_heads % self.num_kv_heads:
            raise UserError(f"num_heads={self.num_heads} must be a multiple of num_kv_heads={self.num_kv_heads}.")
        if self.head_dim % 2:
            raise UserError(f"head_dim={self.head_dim} must be even: rotary embedding turns pairs.")
        if self.action.width % 2:
            raise UserError(f"action.width={self.action.width} must be even: the flow time is embedded in sin and cos.")
        if self.time_distribution not in ("beta", "uniform"):
            raise UserError(f"time_distribution={self.time_distribution!r}: choose 'beta' or 'uniform'.")
