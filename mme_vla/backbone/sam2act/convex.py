"""Convex upsampling: a finer pixel is a weighted mean of the coarse ones around it, with weights that are learnt."""

import torch
from torch import Tensor, nn

_NEIGHBOURS = 9
_MASK_SCALE = 0.1  # as released


class ConvexUp(nn.Module):
    """[b, in, h, w] → [b, out, 2h, 2w]."""

    RATIO = 2

    def __init__(self, wide: int, narrow: int) -> None:
        super().__init__()
        inner = 2 * wide
        self.net_out = nn.Sequential(
            _around(wide, inner), nn.ReLU(), _around(inner, inner), nn.ReLU(), _around(inner, narrow)
        )
        self.net_mask = nn.Sequential(_around(wide, inner), nn.ReLU(), nn.Conv2d(inner, _NEIGHBOURS * self.RATIO**2, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Upsample."""
        coarse = self.net_out(x)
        batch, channels, height, width = coarse.shape
        mask = _MASK_SCALE * self.net_mask(x)
        weights = mask.view(batch, 1, _NEIGHBOURS, self.RATIO, self.RATIO, height, width).softmax(2)
        around = nn.functional.unfold(coarse, 3, padding=1).view(batch, channels, _NEIGHBOURS, 1, 1, height, width)
        fine = (weights * around).sum(2)  # b c ratio ratio h w
        return fine.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels, self.RATIO * height, self.RATIO * width)


class ChannelNorm(nn.LayerNorm):
    """A layer norm over the channels of [b, c, h, w]."""

    def __init__(self, channels: int, eps: float = 1e-6) -> None:
        super().__init__(channels, eps)

    def forward(self, x: Tensor) -> Tensor:
        """Normalise."""
        return torch.movedim(super().forward(torch.movedim(x, 1, -1)), -1, 1)


def _around(wide: int, narrow: int) -> nn.Conv2d:
    return nn.Conv2d(wide, narrow, 3, padding=1)
