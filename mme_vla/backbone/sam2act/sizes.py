"""Sizes of SAM2Act+: the defaults are the released model's."""

from dataclasses import dataclass, field

from mme_vla.backbone.sam2act.views import VIEWS
from mme_vla.backbone.sizes import Sizes, check_positive
from mme_vla.errors import UserError

LEVELS = 4
"""Stages of the encoder, each half as fine as the one before."""


@dataclass(frozen=True)
class EncoderSizes(Sizes):
    """SAM2's picture encoder (Hiera and its neck); Hiera-B+ by default.

    width, heads: of the first stage; both double from stage to stage. blocks_1 … blocks_4, window_1 … window_4: blocks
    and attention windows of the stages. The last `global_blocks` blocks of the third stage that look at the whole
    picture stand `global_step` apart, the last of them before the fourth stage's first.
    background: side of the table of positions. neck: width of the maps it answers with. lora: rank of the adapters.
    """

    width: int = 112
    heads: int = 2
    blocks_1: int = 2
    blocks_2: int = 3
    blocks_3: int = 16
    blocks_4: int = 3
    window_1: int = 8
    window_2: int = 4
    window_3: int = 14
    window_4: int = 7
    global_blocks: int = 3
    global_step: int = 4
    background: int = 14
    neck: int = 256
    lora: int = 16

    def __post_init__(self) -> None:
        check_positive(self, "backbone.encoder.")

    @property
    def blocks(self) -> list[int]:
        """Blocks of each stage."""
        return [self.blocks_1, self.blocks_2, self.blocks_3, self.blocks_4]

    @property
    def windows(self) -> list[int]:
        """Side of each stage's attention windows."""
        return [self.window_1, self.window_2, self.window_3, self.window_4]

    @property
    def widths(self) -> list[int]:
        """Width of each stage."""
        return [self.width * 2**stage for stage in range(LEVELS)]

    @property
    def global_places(self) -> list[int]:
        """Numbers of the blocks that look at the whole picture."""
        last = sum(self.blocks[:3]) - 1
        return [last - self.global_step * i for i in reversed(range(self.global_blocks))]


@dataclass(frozen=True)
class SAM2ActSizes(Sizes):
    """The network: both looks have the same sizes.

    grid, patch: patches of a virtual picture, and their side in pixels; a picture has grid · patch of them.
    width, heads, depth: of the multi-view transformer. language, words: width and number of the goal's tokens.
    sam, pictures, state: what of a token's width the encoder's map, the picture and the robot's state take.
    state_dim: numbers of the robot's state. rotation_bins: of a whole turn. head: first width of the heads.
    memory: width of a remembered place; memory_layers, memory_feedforward: of the attention over memories.
    mask_stages: halvings between a heatmap's picture and the grid. remembered: most keyframes that are read.
    """

    encoder: EncoderSizes = field(default_factory=EncoderSizes)
    grid: int = 16
    patch: int = 14
    width: int = 512
    heads: int = 8
    depth: int = 8
    language: int = 512
    words: int = 77
    sam: int = 48
    pictures: int = 48
    state: int = 32
    state_dim: int = 4
    rotation_bins: int = 72
    head: int = 256
    memory: int = 64
    memory_layers: int = 4
    memory_feedforward: int = 2048
    mask_stages: int = 4
    remembered: int = 9

    def __post_init__(self) -> None:
        check_positive(self, "backbone.")
        if self.width % self.heads:
            raise UserError(f"backbone.width={self.width} must be a multiple of backbone.heads={self.heads}.")
        if self.depth % 2:
            raise UserError(f"backbone.depth={self.depth} must be even: half of the layers see one view alone.")
        if self.token % 4 or self.memory % 4:
            raise UserError(f"Tokens ({self.token}) and memories ({self.memory}) need widths that are multiples of 4.")
        if 360 % self.rotation_bins:
            raise UserError(f"backbone.rotation_bins={self.rotation_bins} must divide a turn of 360 degrees.")

    @property
    def side(self) -> int:
        """Side of a virtual picture in pixels."""
        return self.grid * self.patch

    @property
    def token(self) -> int:
        """Width of a patch's token outside the transformer."""
        return self.sam + self.pictures + self.state

    @property
    def feature(self) -> int:
        """Width of what the heads read."""
        return 2 * VIEWS * self.token
