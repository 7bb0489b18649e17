"""The nano backbone's vision tower: a small convolutional network that says what is where on the
table.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

import torch
from torch import Tensor, nn

from mme_vla.backbone.base import check_positive
from mme_vla.errors import check_choice, check_multiple, require

WEIGHTS = "assets/nano_tower.safetensors"
STRIDES = (4, 2, 2)
"""Of the three stages: a 128-pixel image becomes 32×32, 16×16 and 8×8 places."""
CLASSES = (
    "hand",
    "red cube",
    "green cube",
    "blue cube",
    "other cube",
    "container",
    "button",
    "pressed button",
    "target",
    "disc",
    "mark",
    "highlight",
    "board",
    "box",
    "obstacle",
    "peg end",
    "held red cube",
    "held green cube",
    "held blue cube",
    "other held object",
)
"""What the tower locates. `hand` is the tool's centre, `mark` the red rings over a visited target,
`highlight` a white area. What is held, or pressed, has two classes: its own and that of its state.
"""
CELLS = 4
"""A token is 4×4 cells, each with a presence and a place for every class."""
CELLS_PER_OBJECT = (
    4  # those whose centres are less than a cell away from an object's, along both axes
)
FLOOR = 0.1
"""Presence from which on a cell counts: a thousand nearly empty cells add up to nothing."""
FAINT = 0.1
"""Objects of a class that an image must show at least for its shares to add up to about one."""
NEARLY_ABSENT = 0.02
"""Share, times its factor, that is added to every one: where a class is absent, a place is no
division by zero.
"""
IN_USE = 5 / 8
"""The part of an image's height, from the top, that the network sees: nothing lies on RoboMME's
table below it.
"""
NOTHING = -10.0  # logit of presence there
COLUMNS, ROWS = (-0.7, 0.7), (-1.0, 0.1)
"""The part of an image, whose sides are −1 … 1, in which tasks take place; places are
−1 … 1 in it.
"""
WAVES = 4
"""Orders of the cosines, along each axis, that say how the objects of a class are distributed."""
TOKEN_WIDTH = (4 + WAVES**2) * len(CLASSES)
FACTORS = (1.0, 16.0, 16.0, 16.0, 16.0)
"""Of presence, share, column, row and waves: between the size of a token's numbers and of a mean of
64 tokens.
"""


@dataclass(frozen=True)
class TowerConfig:
    """The convolutional vision tower: channels of its stages over 32×32, 16×16 and 8×8 places of a
    128-pixel image.

    `blocks_…` are residual blocks. `pretrained` takes the weights that ship with the library.
    `layout` is that of the tokens: `places` (`PlaceTower`), or `segments` (`vision.ConvTower`) of
    the shipped policy `checkpoint=nano`. `in_use` is the part of an image's height, from the top,
    that `PlaceTower` sees.
    """

    image_size: int = 128
    width_32: int = 48
    width_16: int = 96
    width_8: int = 160
    blocks_32: int = 1
    blocks_16: int = 1
    blocks_8: int = 2
    pretrained: bool = True
    layout: str = "segments"
    in_use: float = IN_USE

    def __post_init__(self) -> None:
        check_positive(self, "backbone.vision.")
        check_choice("backbone.vision.layout", self.layout, ("places", "segments"))
        check_multiple("backbone.vision.", "image_size", self.image_size, "stride", 16)
        for name in ("width_32", "width_16", "width_8"):
            check_multiple("backbone.vision.", name, getattr(self, name), "groups", 8)

    @property
    def widths(self) -> tuple[int, int, int]:
        """Channels of the three stages."""
        return self.width_32, self.width_16, self.width_8

    @property
    def blocks(self) -> tuple[int, int, int]:
        """Residual blocks of the three stages."""
        return self.blocks_32, self.blocks_16, self.blocks_8


class Residual(nn.Module):
    """x + two 3×3 convolutions of its normalised self."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, width)
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(nn.functional.gelu(self.first(self.norm(x))))


def build_stages(widths: Sequence[int], blocks: Sequence[int]) -> list[list[nn.Module]]:
    """The layers of each stage, the first on images: a strided convolution and residual blocks."""
    stages = []
    before = 3  # channels of an image
    for width, count, stride in zip(widths, blocks, STRIDES, strict=True):
        kernel = stride + 2 * (stride // 2)  # windows overlap: places know what is at their borders
        down = nn.Conv2d(before, width, kernel, stride, padding=(kernel - stride) // 2)
        stages.append([down, *(Residual(width) for _ in range(count))])
        before = width
    return stages


class PlaceTower(nn.Module):
    """Images [n, 3, s, s] in [−1, 1] → tokens [n, (s/16)², d] that say what is where.

    For each of 32×32 cells of a 128-pixel image, and each of `CLASSES`, the network says whether an
    object's centre is near, and where. A token sums up its 4×4 cells in 20 numbers for each of the
    K classes, d = 20·K, in this order:

    - [K] presence: the largest of its cells, 0 … 1;
    - [K] share: the token's part of all objects of the class, so that tokens add up to 1 where
      there is one, else 0;
    - [K] column and [K] row: the share times the place, which is −1 … 1 between `COLUMNS` and
      `ROWS`;
    - [K·16] waves: the number of objects times cos(πi·c)·cos(πj·r), for i (slower) and j from 0 to
      3, at the column c and the row r, 0 … 1. The first of a class counts its objects; together
      they are a coarse map of them.

    All but the first are sums: tokens that are pooled to one for a frame still say where the middle
    of a class is, how many objects there are, roughly where each of them is, and what is held,
    pressed, marked or highlighted. Each is times `FACTORS`.

    Args:
        widths: channels of the three stages.
        blocks: residual blocks of each.
        in_use: the part of an image's height, from the top, that the network sees.
    """

    def __init__(
        self, widths: Sequence[int], blocks: Sequence[int], in_use: float = IN_USE
    ) -> None:
        super().__init__()
        self.in_use = in_use
        self.stages = nn.ModuleList()
        for layers in build_stages(widths, blocks):
            self.stages.append(nn.Sequential(*layers))
        fine = widths[0]
        self.laterals = nn.ModuleList(nn.Conv2d(width, fine, 1) for width in widths)
        self.join = Residual(fine)
        self.norm = nn.GroupNorm(8, fine)
        self.out = nn.Conv2d(fine, 3 * len(CLASSES), 1)

    @property
    def token_width(self) -> int:
        """D."""
        return TOKEN_WIDTH

    def locate(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Presence logits [n, K, s/4, s/4], and places [n, K, 2, s/4, s/4]: column and row from a
        cell's centre.

        Places are in cells, between −1 and 1.
        """
        side = images.shape[-1]
        # whole tokens, and at least one row of them
        x = images[..., : max(1, round(side * self.in_use / 16)) * 16, :]
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        merged = self.laterals[2](features[2])
        for lateral, feature in ((self.laterals[1], features[1]), (self.laterals[0], features[0])):
            merged = lateral(feature) + nn.functional.interpolate(merged, scale_factor=2.0)
        output = self.out(nn.functional.gelu(self.norm(self.join(merged)))).unflatten(1, (3, -1))
        below = (0, 0, 0, side // STRIDES[0] - output.shape[-2])
        logits = nn.functional.pad(output[:, 0], below, value=NOTHING)
        return logits, nn.functional.pad(output[:, 1:].tanh().transpose(1, 2), below)

    def forward(self, images: Tensor) -> Tensor:
        logits, offsets = self.locate(images)
        return summarise(logits.sigmoid(), offsets)


def summarise(presence: Tensor, offsets: Tensor) -> Tensor:
    """Tokens [n, t², 20·K] of cells, as `PlaceTower` describes them.

    Args:
        presence: [n, K, 4t, 4t], 0 … 1.
        offsets: column and row from each cell's centre, in cells, [n, K, 2, 4t, 4t].
    """
    side = presence.shape[-1]
    middles = torch.arange(side, device=presence.device, dtype=presence.dtype) + 0.5
    column = within((offsets[:, :, 0] + middles) / side, COLUMNS)
    row = within((offsets[:, :, 1] + middles[:, None]) / side, ROWS)
    counted = (presence - FLOOR).clamp(min=0) / (1 - FLOOR)
    mass = counted / CELLS_PER_OBJECT
    share = mass / (mass.sum((-2, -1), keepdim=True) + FAINT)
    orders = torch.arange(WAVES, device=presence.device, dtype=presence.dtype) * math.pi
    orders = orders[:, None, None]
    # K waves of each order over cells, and their products summed up over the cells of each token
    across = (orders * (column[:, :, None].clamp(-1, 1) + 1) / 2).cos()
    along = (orders * (row[:, :, None].clamp(-1, 1) + 1) / 2).cos()
    across, along = _by_token(mass[:, :, None] * across), _by_token(along)
    waves = (across @ along.transpose(-2, -1)).permute(0, 1, 4, 5, 2, 3).flatten(1, 3)
    summed = torch.cat([share, share * column, share * row], 1)
    sums = nn.functional.avg_pool2d(summed, CELLS) * CELLS**2
    parts = [nn.functional.max_pool2d(counted, CELLS), *sums.chunk(3, 1), waves]
    tokens = torch.cat([part * factor for part, factor in zip(parts, FACTORS, strict=True)], 1)
    return tokens.flatten(2).transpose(1, 2)


def located(tokens: Tensor) -> tuple[Tensor, Tensor]:
    """What the tokens [..., 20·K] of `PlaceTower` say of each class: its presence [..., K], and
    where [..., K, 2].

    Places are column and row, −1 … 1 between `COLUMNS` and `ROWS`; where a class is absent they
    mean nothing.
    """
    presence, share, column, row = tokens[..., : 4 * len(CLASSES)].chunk(4, -1)
    where = torch.stack([column, row], -1) / (share[..., None].clamp(min=0) + NEARLY_ABSENT)
    return presence.clamp(0, 1), where.clamp(-1, 1)


def by_class(tokens: Tensor) -> Tensor:
    """The features of each class [..., K, 20] in tokens [..., ≥ 20·K] of `PlaceTower`."""
    first = tokens[..., : 4 * len(CLASSES)].unflatten(-1, (4, len(CLASSES))).transpose(-2, -1)
    return torch.cat(
        [first, tokens[..., 4 * len(CLASSES) : TOKEN_WIDTH].unflatten(-1, (len(CLASSES), -1))], -1
    )


def reflect(tokens: Tensor, signs: Tensor, exchange: Tensor) -> Tensor:
    """Tokens [b, …, ≥ 20·K] of `PlaceTower` as if all objects lay at reflected places.

    Tokens of an image keep their order, so that only their numbers say where an object is. The
    numbers of selected classes behind those of the tower are left as they are.

    Args:
        signs: of columns and rows, 1 or −1, [b, 2].
        exchange: whether column and row then change places, [b] bool.
    """
    count = 4 * len(CLASSES)
    ones = [1] * (tokens.ndim - 2)
    presence, share, column, row = tokens[..., :count].chunk(4, -1)
    column = column * signs[:, 0].view(-1, *ones, 1)
    row = row * signs[:, 1].view(-1, *ones, 1)
    swapped = exchange.view(-1, *ones, 1)
    column, row = torch.where(swapped, row, column), torch.where(swapped, column, row)
    # A cosine of odd order changes its sign where its place does.
    odd = torch.arange(WAVES, device=tokens.device) % 2 == 1
    signed = torch.where(odd, signs[..., None], 1).to(tokens.dtype)  # b 2 i
    factors = (signed[:, 0, :, None] * signed[:, 1, None]).view(-1, *ones, 1, WAVES, WAVES)
    waves = tokens[..., count:TOKEN_WIDTH].unflatten(-1, (-1, WAVES, WAVES)) * factors
    waves = torch.where(swapped[..., None, None], waves.transpose(-2, -1), waves).flatten(-3)
    return torch.cat([presence, share, column, row, waves, tokens[..., TOKEN_WIDTH:]], -1)


def reflect_points(points: Tensor, signs: Tensor, exchange: Tensor) -> Tensor:
    """Rows and columns [b, …, 2] as shares of an image's sides, at the places where `reflect` puts
    objects.
    """
    ones = [1] * (points.ndim - 2)
    row, column = points.unbind(-1)
    column = within(column, COLUMNS) * signs[:, 0].view(-1, *ones)
    row = within(row, ROWS) * signs[:, 1].view(-1, *ones)
    swapped = exchange.view(-1, *ones)
    column, row = torch.where(swapped, row, column), torch.where(swapped, column, row)
    shares = []
    for place, (low, high) in ((row, ROWS), (column, COLUMNS)):  # back from `within`
        shares.append((place * (high - low) / 2 + (low + high) / 2 + 1) / 2)
    return torch.stack(shares, -1)


def place_waves(where: Tensor) -> Tensor:
    """cos(πi·c)·cos(πj·r) of places [..., 2], i and j from 0 to 3: [..., 16], as a token's waves
    are of one object.
    """
    orders = torch.arange(WAVES, device=where.device, dtype=where.dtype) * math.pi
    across, along = (orders * (where[..., None] + 1) / 2).cos().unbind(-2)
    return (across[..., :, None] * along[..., None, :]).flatten(-2)


def _by_token(x: Tensor) -> Tensor:
    """[n, K, i, 4t, 4t] → [n, K, t, t, i, 16]: the cells of each token together."""
    return (
        x.unflatten(-1, (-1, CELLS))
        .unflatten(-3, (-1, CELLS))
        .permute(0, 1, 3, 5, 2, 4, 6)
        .flatten(-2)
    )


def within(place: Tensor, ends: tuple[float, float]) -> Tensor:
    """Places of 0 … 1 in an image as −1 … 1 between two of its places of −1 … 1."""
    low, high = ends
    return (2 * place - 1 - (low + high) / 2) / ((high - low) / 2)


def load_shipped(tower: nn.Module, layout: str) -> None:
    """Give a tower of this layout the weights that ship with the library."""
    from safetensors.torch import load

    require(
        layout == "places",
        "vision.layout=segments is of checkpoints that bring their weights: none ship with the"
        " library. Use vision.layout=places, or vision.pretrained=false.",
    )
    stored = load(files("mme_vla").joinpath(WEIGHTS).read_bytes())
    state = {name: value.float() for name, value in stored.items()}
    shapes = {name: value.shape for name, value in stored.items()}
    required = {name: value.shape for name, value in tower.state_dict().items()}
    require(
        shapes == required,
        "The vision weights that ship with the library are for the sizes of backbone=nano. With"
        " others set backbone.vision.pretrained=false, or train a tower of that size: mme-vla"
        " vision-pretrain.",
    )
    tower.load_state_dict(state)
