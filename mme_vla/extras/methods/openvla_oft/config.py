"""Sizes of a Prismatic VLM (two vision towers, a projector, Llama), and of OpenVLA-OFT
around it.
"""

from dataclasses import dataclass, field
from typing import ClassVar

from mme_vla.backbone.base import check_positive
from mme_vla.errors import check_multiple, check_sizes, require


@dataclass(frozen=True)
class TowerConfig:
    """One vision transformer; its tokens after the block before the last are read, so it has two
    blocks at least.
    """

    width: int
    depth: int
    mlp_dim: int
    num_heads: int

    def check(self, section: str) -> None:
        """Raise an error that names a key of its section, such as `backbone.vision.dino.`, if it
        has no such tower.
        """
        check_positive(self, section)
        require(
            self.depth >= 2,
            f"{section}depth={self.depth} has no block before its last: at least 2.",
        )
        check_multiple(section, "width", self.width, "num_heads", self.num_heads)


@dataclass(frozen=True)
class FusedVisionConfig:
    """DINOv2 and SigLIP on the same patches. `image_size` must be a multiple of `patch_size`."""

    image_size: int = 224
    patch_size: int = 14
    dino: TowerConfig = field(default_factory=lambda: TowerConfig(1024, 24, 4096, 16))
    siglip: TowerConfig = field(default_factory=lambda: TowerConfig(1152, 27, 4304, 16))

    def __post_init__(self) -> None:
        check_sizes("backbone.vision", image_size=self.image_size, patch_size=self.patch_size)
        check_multiple(
            "backbone.vision.", "image_size", self.image_size, "patch_size", self.patch_size
        )
        self.dino.check("backbone.vision.dino.")
        self.siglip.check("backbone.vision.siglip.")

    @property
    def width(self) -> int:
        """Width of a fused token: both towers' side by side."""
        return self.dino.width + self.siglip.width

    @property
    def grid(self) -> int:
        """Side of an image's token grid."""
        return self.image_size // self.patch_size


@dataclass(frozen=True)
class LlamaConfig:
    """A Llama without grouped keys.

    norm_eps: OpenVLA's published configuration leaves it at the class's default of 1e-6, although
        Llama 2 itself has 1e-5; OpenVLA-OFT trained and tests with that.
    """

    width: int = 4096
    mlp_dim: int = 11008
    depth: int = 32
    num_heads: int = 32
    norm_eps: float = 1e-6

    def __post_init__(self) -> None:
        check_positive(self, "backbone.vlm.")
        check_multiple("backbone.vlm.", "width", self.width, "2 · num_heads", 2 * self.num_heads)


@dataclass(frozen=True)
class OpenVlaConfig:
    """OpenVLA-OFT: the VLM, a token of the state, and a head that reads a chunk off zeroed slots.

    state_dim: numbers of the state that the network reads; 0 for none.
    end_id: the token that closes the sequence.
    """

    everything_sees_everything: ClassVar[bool] = True

    vision: FusedVisionConfig = field(default_factory=FusedVisionConfig)
    vlm: LlamaConfig = field(default_factory=LlamaConfig)
    vocab_size: int = 32_064
    end_id: int = 2
    action_dim: int = 8
    state_dim: int = 8
    horizon: int = 20

    def __post_init__(self) -> None:
        check_sizes(
            "backbone",
            vocab_size=self.vocab_size,
            end_id=self.end_id,
            action_dim=self.action_dim,
            horizon=self.horizon,
        )
        require(self.state_dim >= 0, f"backbone.state_dim={self.state_dim} must be at least 0.")
        require(
            self.end_id < self.vocab_size,
            f"backbone.end_id={self.end_id} is no token of vocab_size={self.vocab_size}.",
        )
