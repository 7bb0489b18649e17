"""Rotations as three whole numbers: extrinsic x-y-z angles in bins of equal width, and back; all in float64."""

import torch
from torch import Tensor

_LOCK = 1.0
"""Degrees from straight up or down within which roll and yaw cannot be told apart, as released."""


def angles_of(quaternions: Tensor) -> Tensor:
    """Extrinsic x-y-z angles [..., 3] in degrees, in (−180, 180], of quaternions [..., 4] (x, y, z, w).

    Where y is within a degree of ±90 it counts as ±90, and all of the rest is the turn about x.
    """
    x, y, z, w = torch.nn.functional.normalize(quaternions.double(), dim=-1).unbind(-1)
    # With half angles a, b, c: (cos b + sin b)·(cos, sin)(a − c) and (cos b − sin b)·(cos, sin)(a + c). Unlike the
    # textbook's tangents neither of them is ill-conditioned at the pole that the other fails at.
    difference, added = torch.atan2(x - z, w + y), torch.atan2(x + z, w - y)
    plus, minus = torch.hypot(x - z, w + y), torch.hypot(x + z, w - y)
    tilt = torch.rad2deg(2 * torch.atan2(plus - minus, plus + minus))
    up, down = tilt > 90 - _LOCK, tilt < -90 + _LOCK
    roll = torch.where(up, 2 * difference, torch.where(down, 2 * added, difference + added))
    yaw = torch.where(up | down, 0.0, added - difference)
    tilt = torch.where(up, 90.0, torch.where(down, -90.0, tilt))
    return torch.stack([_half_turn(torch.rad2deg(roll)), tilt, _half_turn(torch.rad2deg(yaw))], -1)


def quaternions_of(angles: Tensor) -> Tensor:
    """Quaternions [..., 4] (x, y, z, w) of extrinsic x-y-z angles [..., 3] in degrees."""
    halves = torch.deg2rad(angles.double()) / 2
    (sa, sb, sc), (ca, cb, cc) = halves.sin().unbind(-1), halves.cos().unbind(-1)
    x, y = sa * cb * cc - ca * sb * sc, ca * sb * cc + sa * cb * sc
    z, w = ca * cb * sc - sa * sb * cc, ca * cb * cc + sa * sb * sc
    return torch.stack([x, y, z, w], -1)


def to_bins(quaternions: Tensor, count: int) -> Tensor:
    """The bins [..., 3] int64 of quaternions [..., 4] (x, y, z, w), where a turn has `count` of them."""
    width = 360 / count
    return ((angles_of(quaternions) + 180) / width).round().to(torch.int64) % count


def angles_of_bins(bins: Tensor, count: int) -> Tensor:
    """The angles [..., 3] in degrees that bins [..., 3] stand for."""
    return bins.double() * (360 / count) - 180


def from_bins(bins: Tensor, count: int) -> Tensor:
    """Quaternions [..., 4] (x, y, z, w) of bins [..., 3]."""
    return quaternions_of(angles_of_bins(bins, count))


def _half_turn(degrees: Tensor) -> Tensor:
    return 180 - (180 - degrees).remainder(360)
