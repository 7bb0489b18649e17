"""What is remembered of a keyframe: its tokens and the heatmap they led to, in one narrower grid. SAM2's encoder."""

import itertools
import math

import torch
from torch import Tensor, nn

_GROWTH = 4  # of the channels, each time a mask's side is halved
_WIDER = 4
_KERNEL = 7
_EPSILON = 1e-6


class MaskShrinker(nn.Module):
    """A mask [n, 1, s, s] at the grid's size, [n, width, s / 2^stages, …]."""

    def __init__(self, width: int, stages: int) -> None:
        super().__init__()
        channels = [_GROWTH**i for i in range(stages + 1)]
        pairs = list(itertools.pairwise(channels))
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, 3, 2, padding=1) for a, b in pairs)
        self.norms = nn.ModuleList(nn.LayerNorm(b, _EPSILON) for _, b in pairs)
        self.out = nn.Conv2d(channels[-1], width, 1)

    def forward(self, mask: Tensor) -> Tensor:
        """Shrink."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            mask = nn.functional.gelu(norm(convolution(mask).movedim(1, -1)).movedim(-1, 1))
        out: Tensor = self.out(mask)
        return out


class FuserLayer(nn.Module):
    """A ConvNeXt block."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(width, width, _KERNEL, padding=_KERNEL // 2, groups=width)
        self.norm = nn.LayerNorm(width, _EPSILON)
        self.into, self.back = nn.Linear(width, _WIDER * width), nn.Linear(_WIDER * width, width)
        self.scale = nn.Parameter(torch.full((width,), 1e-6))

    def forward(self, x: Tensor) -> Tensor:
        """[n, d, g, g] → the same shape."""
        inner = self.norm(self.depthwise(x).movedim(1, -1))
        inner = self.scale * self.back(nn.functional.gelu(self.into(inner)))
        return x + inner.movedim(-1, 1)


class MemoryEncoder(nn.Module):
    """Tokens and a mask → what is remembered of them."""

    def __init__(self, width: int, memory: int, mask_stages: int, layers: int = 2) -> None:
        super().__init__()
        self.mask = MaskShrinker(width, mask_stages)
        self.tokens = nn.Conv2d(width, width, 1)
        self.fuser = nn.ModuleList(FuserLayer(width) for _ in range(layers))
        self.out = nn.Conv2d(width, memory, 1)

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """[n, memory, g, g] of tokens [n, width, g, g] and a mask [n, 1, g·2^stages, …]."""
        x = self.tokens(tokens) + self.mask(mask)
        for layer in self.fuser:
            x = layer(x)
        out: Tensor = self.out(x)
        return out


def sine_positions(side: int, width: int, device: torch.device | None = None) -> Tensor:
    """Positions [width, side, side] of a grid: the first half of the numbers by row, the second by column."""
    half = width // 2
    line = torch.arange(1, side + 1, device=device).float() / (side + 1e-6) * (2 * math.pi)
    rates = 10_000 ** (-2 * (torch.arange(half, device=device) // 2).float() / half)
    angles = line[:, None] * rates
    codes = torch.stack([angles[:, 0::2].sin(), angles[:, 1::2].cos()], -1).flatten(1).T  # half side
    rows, columns = codes[:, :, None].expand(-1, -1, side), codes[:, None].expand(-1, side, -1)
    return torch.cat([rows, columns])
