"""The three virtual cameras on the cube [−1, 1]³: from above, from the front, from the right; all orthographic."""

import torch
from torch import Tensor

VIEWS = 3
"""top · front · right, everywhere in this order."""
_ABOVE, _AHEAD, _BESIDE = 1.0, 1.0, 0.5  # where the eyes stand; the third one stands closer, as released


def project(points: Tensor, side: int) -> Tensor:
    """Columns and rows [..., 3 views, 2] of points [..., 3], in pixels of pictures of `side` and not rounded."""
    x, y, z = points.unbind(-1)
    half = side / 2
    columns = torch.stack([x, y, -x], -1)
    rows = torch.stack([-y, -z, -z], -1)
    return torch.stack([columns, rows], -1) * half + half


def depths(points: Tensor) -> Tensor:
    """How far points [..., 3] are from each camera along its axis, [..., 3 views]; negative behind it."""
    x, y, z = points.unbind(-1)
    return torch.stack([_ABOVE - z, _AHEAD - x, _BESIDE - y], -1)


def constant_channels(side: int, device: torch.device | None = None) -> Tensor:
    """What each picture says of itself, [3 views, 3, side, side]: its number from −1 to 1, and every row and column."""
    line = torch.linspace(-1, 1, side, device=device)
    number = torch.linspace(-1, 1, VIEWS, device=device)[:, None, None].expand(VIEWS, side, side)
    rows, columns = line[:, None].expand(side, side), line[None].expand(side, side)
    return torch.stack([number, *(x.expand(VIEWS, side, side) for x in (rows, columns))], 1)
