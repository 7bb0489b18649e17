"""Sizes of the nano backbone."""

from dataclasses import dataclass, field

from mme_vla.backbone.pi05.sizes import ExpertConfig
from mme_vla.backbone.sizes import check_positive
from mme_vla.errors import UserError


@dataclass(frozen=True)
class TowerConfig:
    """The convolutional vision tower: channels of its stages over 32×32, 16×16 and 8×8 places of a 128-pixel picture.

    `blocks_…` are residual blocks. `pretrained` takes the weights that ship with the library.
    """

    image_size: int = 128
    width_32: int = 48
    width_16: int = 96
    width_8: int = 160
    blocks_32: int = 1
    blocks_16: int = 1
    blocks_8: int = 2
    pretrained: bool = True

    def __post_init__(self) -> None:
        check_positive(self, "vision.")
        if self.image_size % 16:
            raise UserError(f"vision.image_size={self.image_size} must be a multiple of 16.")
        for width in (self.width_32, self.width_16, self.width_8):
            if width % 8:
                raise UserError(f"vision: {width} channels cannot be normalised in 8 groups; take a multiple of 8.")


@dataclass(frozen=True)
class NanoConfig:
    """A vision tower, a column of context tokens (`vlm`) and a column of action tokens that reads them (`action`)."""

    vision: TowerConfig = field(default_factory=TowerConfig)
    vlm: ExpertConfig = field(default_factory=lambda: ExpertConfig(128, 256))
    action: ExpertConfig = field(default_factory=lambda: ExpertConfig(128, 256))
    depth: int = 2
    num_heads: int = 4
    head_dim: int = 32
    state_dim: int = 8
    vocab_size: int = 2048
    action_dim: int = 8
    horizon: int = 4
    draws: int = 4
    time_distribution: str = "beta"

    def __post_init__(self) -> None:
        check_positive(self, "backbone.")
        if self.action.width % 2 or self.head_dim % 2:
            raise UserError("backbone.action.width and backbone.head_dim must be even.")
        if self.time_distribution not in ("beta", "uniform"):
            raise UserError(f"time_distribution={self.time_distribution!r}: choose 'beta' or 'uniform'.")
