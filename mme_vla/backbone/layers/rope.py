"""Rotary position embedding, halves convention: x[:h/2] is rotated against x[h/2:]."""

from typing import NamedTuple

import torch
from torch import Tensor

BASE = 10_000.0


class Rotation(NamedTuple):
    """cos and sin of every position's angles, float32 [b, n, 1, h]: both halves turn by the same angles."""

    cos: Tensor
    sin: Tensor

    def rows(self, keep: slice) -> "Rotation":
        """Return the rotation of some of the tokens."""
        return Rotation(self.cos[:, keep], self.sin[:, keep])


def rotation(positions: Tensor, head_dim: int) -> Rotation:
    """Angles p·10000^(−2i/h) for positions [b, n], whole numbers or not."""
    exponent = torch.arange(head_dim // 2, device=positions.device, dtype=torch.float32) * (2 / head_dim)
    angles = (positions[..., None, None].float() / BASE**exponent).repeat(1, 1, 1, 2)
    return Rotation(angles.cos(), angles.sin())


def rotate(x: Tensor, turn: Rotation) -> Tensor:
    """Rotate queries or keys [b, n, heads, h]; the result keeps the dtype of x."""
    a, b = x.float().chunk(2, dim=-1)
    quarter_turned = torch.cat([-b, a], dim=-1)
    return torch.addcmul(x.float() * turn.cos, quarter_turned, turn.sin).to(x.dtype)
