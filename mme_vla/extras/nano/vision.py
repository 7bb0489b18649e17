"""The vision tower of the shipped policy `checkpoint=nano`: which of twelve classes each place
shows. New policies have `tower.PlaceTower`.
"""

import math
from collections.abc import Sequence
from itertools import chain

import torch
from torch import Tensor, nn

from mme_vla.extras.nano.tower import build_stages

CLASSES = (
    "nothing",
    "robot",
    "red cube",
    "green cube",
    "blue cube",
    "other cube",
    "container",
    "button",
    "target",
    "disc",
    "box",
    "obstacle",
    "peg",
)
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

    A token holds, for each class but the first, its presence; its share of all that the image shows
    of the class, as it is and times the column and the row in the image, each in [−1, 1]; and the
    colours of its 4×4 places. So a sum of tokens, and pooled ones, say where the things of a class
    are: their middle.

    Args:
        widths: channels of the three stages.
        blocks: residual blocks of each.
        out: channels that the outputs are read from.
    """

    words: Tensor

    def __init__(self, widths: Sequence[int], blocks: Sequence[int], out: int) -> None:
        super().__init__()
        self.stages = nn.Sequential(*chain.from_iterable(build_stages(widths, blocks)))
        before = widths[-1]
        self.norm = nn.GroupNorm(8, before)
        self.out = nn.Conv2d(before, out, 1)
        self.classes = nn.Linear(out, FINE**2 * len(CLASSES))
        self.colours = nn.Linear(out, COARSE**2 * 3)
        # word of the shipped tokenizer × class but the first: 1 where the word names the class
        self.register_buffer("words", torch.zeros(WORDS, len(CLASSES) - 1))

    @property
    def token_width(self) -> int:
        """D."""
        return 4 * (len(CLASSES) - 1) + self.colours.out_features

    def answers(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Scores of the classes [n, (s/16)², classes, 64] and colours [n, (s/16)², 48]
        in [−1, 1].
        """
        features = (
            self.out(nn.functional.gelu(self.norm(self.stages(images)))).flatten(2).transpose(1, 2)
        )
        return self.classes(features).unflatten(-1, (len(CLASSES), -1)), self.colours(features)

    def forward(self, images: Tensor) -> Tensor:
        scores, colours = self.answers(images)
        shares = scores.softmax(2)[:, :, 1:]
        mass, presence = shares.mean(-1), shares.amax(-1)
        share = mass / (mass.sum(1, keepdim=True) + FAINT)
        grid = math.isqrt(shares.shape[1])
        middles = (torch.arange(grid, device=shares.device) + 0.5) / grid * 2 - 1
        line = (torch.arange(FINE, device=shares.device) + 0.5) / FINE * 2 - 1
        # The place of a class in its token, then in the image
        column = (shares * line.repeat(FINE)).mean(-1) / mass / grid
        row = (shares * line.repeat_interleave(FINE)).mean(-1) / mass / grid
        column = share * (column + middles.repeat(grid)[:, None])
        row = share * (row + middles.repeat_interleave(grid)[:, None])
        parts = (presence, share, column, row, colours)
        return torch.cat([part * factor for part, factor in zip(parts, LOUDNESS, strict=True)], -1)
