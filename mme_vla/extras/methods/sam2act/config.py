"""Sizes of SAM2Act+: the defaults are the released model's."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Self

from mme_vla.config.sections import Range, read_section, without
from mme_vla.errors import UserError, check_multiple, require
from mme_vla.extras.methods.sam2act.geometry import VIEWS

LEVELS = 4
"""Stages of the encoder, each half as fine as the one before."""
Size = Annotated[int, Range(1, 2**16)]


@dataclass(frozen=True)
class EncoderSizes:
    """SAM2's image encoder (Hiera and its neck); Hiera-B+ by default.

    width, heads: of the first stage; both double from stage to stage.
    blocks, windows: number of blocks and side of the attention windows, of each stage.
    global_blocks: blocks, counted through all stages, that attend to the whole image.
    background: side of the table of positions.
    neck: width of its output maps.
    lora: rank of the adapters.
    """

    width: Size = 112
    heads: Size = 2
    blocks: tuple[Size, ...] = (2, 3, 16, 3)
    windows: tuple[Size, ...] = (8, 4, 14, 7)
    global_blocks: tuple[Size, ...] = (12, 16, 20)
    background: Size = 14
    neck: Size = 256
    lora: Size = 16

    def __post_init__(self) -> None:
        for name in ("blocks", "windows"):
            require(
                len(getattr(self, name)) == LEVELS,
                f"backbone.encoder.{name} must have {LEVELS} numbers, one a stage.",
            )
        if any(place >= sum(self.blocks) for place in self.global_blocks):
            raise UserError(
                f"backbone.encoder.global_blocks={list(self.global_blocks)}: there are"
                f" {sum(self.blocks)}."
            )

    @property
    def widths(self) -> list[int]:
        """Width of each stage."""
        return [self.width * 2**stage for stage in range(LEVELS)]


@dataclass(frozen=True)
class SAM2ActSizes:
    """The network: both looks have the same sizes.

    grid, patch: patches of a virtual image, and their side in pixels; an image has grid · patch of
        them.
    width, heads, depth: of the multi-view transformer.
    language, words: width and number of the goal's tokens.
    sam, pictures, state: what of a token's width the encoder's map, the image and the robot's state
        take.
    state_dim: numbers of the robot's state.
    rotation_bins: of a whole turn.
    head: first width of the heads.
    memory: width of a remembered place; memory_layers,
    memory_feedforward: of the attention over memories.
    mask_stages: halvings between a heatmap's image and the grid.
    remembered: most keyframes that are read.
    """

    encoder: EncoderSizes = field(default_factory=EncoderSizes)
    grid: Size = 16
    patch: Size = 14
    width: Size = 512
    heads: Size = 8
    depth: Size = 8
    language: Size = 512
    words: Size = 77
    sam: Size = 48
    pictures: Size = 48
    state: Size = 32
    state_dim: Size = 4
    rotation_bins: Size = 72
    head: Size = 256
    memory: Size = 64
    memory_layers: Size = 4
    memory_feedforward: Size = 2048
    mask_stages: Size = 4
    remembered: Size = 9

    @classmethod
    def from_dict(cls, section: Mapping[str, Any]) -> Self:
        """Read the section `backbone` of a configuration, but for its `name`."""
        return read_section(cls, without(section, "name"), "backbone")

    def __post_init__(self) -> None:
        check_multiple("backbone.", "width", self.width, "backbone.heads", self.heads)
        # half of the layers see one view alone
        check_multiple("backbone.", "depth", self.depth, "pairs", 2)
        check_multiple("backbone.", "memory", self.memory, "quarters", 4)
        check_multiple(
            "backbone.", "sam + backbone.pictures + backbone.state", self.token, "quarters", 4
        )
        require(
            360 % self.rotation_bins == 0,
            f"backbone.rotation_bins={self.rotation_bins} must divide 360 degrees.",
        )

    @property
    def side(self) -> int:
        """Side of a virtual image in pixels."""
        return self.grid * self.patch

    @property
    def token(self) -> int:
        """Width of a patch's token outside the transformer."""
        return self.sam + self.pictures + self.state

    @property
    def feature(self) -> int:
        """Width of what the heads read."""
        return 2 * VIEWS * self.token
