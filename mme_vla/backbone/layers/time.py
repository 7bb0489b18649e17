"""Whole numbers in time as sines and cosines."""

import torch
from torch import Tensor

LONGEST = 10_000.0


def sin_cos(time: Tensor, width: int) -> Tensor:
    """[cos(t f) | sin(t f)] of times [n], f_j = 10000^(−j/half), half = ⌊width/2⌋; an odd width ends in a zero.

    Returns:
        [n, width] float32.
    """
    half = width // 2
    ramp = torch.arange(half, device=time.device, dtype=torch.float32) / max(half, 1)
    angles = time.float()[:, None] * LONGEST**-ramp
    return torch.nn.functional.pad(torch.cat([angles.cos(), angles.sin()], -1), (0, width % 2))
