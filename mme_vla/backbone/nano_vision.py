"""The nano backbone's vision tower: a small convolutional network, pretrained on renders of the sixteen tasks."""

import math
from collections.abc import Sequence
from importlib.resources import files

import torch
from torch import Tensor, nn

from mme_vla.errors import require

WEIGHTS = "assets/nano_vision.safetensors"
STRIDES = (4, 2, 2)
"""Of the three stages: a 128-pixel image becomes 32×32, 16×16 and 8×8 places."""


class Residual(nn.Module):
    """x + two 3×3 convolutions of its normalised self."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, width)
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(nn.functional.gelu(self.first(self.norm(x))))


CLASSES = (
    "nothing", "robot", "red cube", "green cube", "blue cube", "other cube", "container", "button", "target", "disc",
    "box", "obstacle", "peg",
)  # fmt: skip
"""What a place of an image may show; a class's number is its place in here."""
FINE, COARSE = 8, 4
"""A token means 8×8 places that show a class each, and for 4×4 places that have a colour each."""
LOUDNESS = (1.0, 32.0, 320.0, 320.0, 0.1)
"""Factors of presence, share, column, row and colours, which bring them to one size."""


WORDS = 2048
"""Entries of the shipped tokenizer."""
FAINT = 0.02
"""Tokens full of a class that the image must show at least for shares to add up to about one."""


class ConvTower(nn.Module):
    """Images [n, 3, s, s] in [−1, 1] → tokens [n, (s/16)², d] that say what is where.

    A token holds, for each class but the first, its presence; its share of all that the image shows of the class, as
    it is and times the column and the row in the image, each in [−1, 1]; and the colours of its 4×4 places. So a sum
    of tokens, and pooled ones, say where the things of a class are: their middle.

    Args:
        widths: channels of the three stages. blocks: residual blocks of each. out: channels that the outputs are read
            from.
    """

    words: Tensor
    columns: Tensor
    rows: Tensor

    def __init__(self, widths: Sequence[int], blocks: Sequence[int], out: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = 3
        for width, count, stride in zip(widths, blocks, STRIDES, strict=True):
            kernel = stride + 2 * (stride // 2)  # windows overlap: places know what is at their borders
            layers.append(nn.Conv2d(before, width, kernel, stride, padding=(kernel - stride) // 2))
            layers += [Residual(width) for _ in range(count)]
            before = width
        self.stages = nn.Sequential(*layers)
        self.norm = nn.GroupNorm(8, before)
        self.out = nn.Conv2d(before, out, 1)
        self.classes = nn.Linear(out, FINE**2 * len(CLASSES))
        self.colours = nn.Linear(out, COARSE**2 * 3)
        # word of the shipped tokenizer × class but the first: 1 where the word names the class
        self.register_buffer("words", torch.zeros(WORDS, len(CLASSES) - 1))
        line = (torch.arange(FINE) + 0.5) / FINE * 2 - 1
        self.register_buffer("columns", line.repeat(FINE), persistent=False)
        self.register_buffer("rows", line.repeat_interleave(FINE), persistent=False)

    @property
    def token_width(self) -> int:
        """D."""
        return 4 * (len(CLASSES) - 1) + self.colours.out_features

    def answers(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Scores of the classes [n, (s/16)², classes, 64] and colours [n, (s/16)², 48] in [−1, 1]."""
        features = self.out(nn.functional.gelu(self.norm(self.stages(images)))).flatten(2).transpose(1, 2)
        return self.classes(features).unflatten(-1, (len(CLASSES), -1)), self.colours(features)

    def forward(self, images: Tensor) -> Tensor:
        scores, colours = self.answers(images)
        shares = scores.softmax(2)[:, :, 1:]
        mass, presence = shares.mean(-1), shares.amax(-1)
        share = mass / (mass.sum(1, keepdim=True) + FAINT)
        grid = math.isqrt(shares.shape[1])
        middles = (torch.arange(grid, device=shares.device) + 0.5) / grid * 2 - 1
        column, row = ((shares * line).mean(-1) / mass / grid for line in (self.columns, self.rows))
        column = share * (column + middles.repeat(grid)[:, None])
        row = share * (row + middles.repeat_interleave(grid)[:, None])
        parts = (presence, share, column, row, colours)
        return torch.cat([part * factor for part, factor in zip(parts, LOUDNESS, strict=True)], -1)


def load_shipped(tower: ConvTower) -> None:
    """Give a tower the weights that ship with the library."""
    from safetensors.torch import load

    state = {name: value.float() for name, value in load(files("mme_vla").joinpath(WEIGHTS).read_bytes()).items()}
    expected = tower.state_dict()
    require(
        {name: value.shape for name, value in state.items()} == {name: value.shape for name, value in expected.items()},
        "The vision weights that ship with the library are for the sizes in configs/backbone/nano.yaml. With "
        "others set backbone.vision.pretrained=false, or train a tower of that size: python -m "
        "mme_vla.nano.vision_pretrain.",
    )
    tower.load_state_dict(state)
