"""Rotations as three whole numbers: extrinsic x-y-z angles in bins of equal width, and back."""

import numpy as np

_LOCK = 1.0
"""Degrees from straight up or down within which roll and yaw cannot be told apart, as released."""


def angles_of(quaternions: np.ndarray) -> np.ndarray:
    """Extrinsic x-y-z angles [..., 3] in degrees, in (−180, 180], of quaternions [..., 4] (x, y, z, w).

    Where y is within a degree of ±90 it counts as ±90, and all of the rest is the turn about x.
    """
    q = np.asarray(quaternions, np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    # With half angles a, b, c: (cos b + sin b)·(cos, sin)(a − c) and (cos b − sin b)·(cos, sin)(a + c). Unlike the
    # textbook's tangents neither of them is ill-conditioned at the pole that the other fails at.
    difference, added = np.arctan2(x - z, w + y), np.arctan2(x + z, w - y)
    plus, minus = np.hypot(x - z, w + y), np.hypot(x + z, w - y)
    tilt = np.degrees(2 * np.arctan2(plus - minus, plus + minus))
    up, down = tilt > 90 - _LOCK, tilt < -90 + _LOCK
    roll = np.where(up, 2 * difference, np.where(down, 2 * added, difference + added))
    yaw = np.where(up | down, 0, added - difference)
    tilt = np.where(up, 90, np.where(down, -90, tilt))
    return np.stack([_half_turn(np.degrees(roll)), tilt, _half_turn(np.degrees(yaw))], -1)


def quaternions_of(angles: np.ndarray) -> np.ndarray:
    """Quaternions [..., 4] (x, y, z, w) of extrinsic x-y-z angles [..., 3] in degrees."""
    a, b, c = np.moveaxis(np.radians(np.asarray(angles, np.float64)) / 2, -1, 0)
    quaternions: np.ndarray = np.stack(
        [
            np.sin(a) * np.cos(b) * np.cos(c) - np.cos(a) * np.sin(b) * np.sin(c),
            np.cos(a) * np.sin(b) * np.cos(c) + np.sin(a) * np.cos(b) * np.sin(c),
            np.cos(a) * np.cos(b) * np.sin(c) - np.sin(a) * np.sin(b) * np.cos(c),
            np.cos(a) * np.cos(b) * np.cos(c) + np.sin(a) * np.sin(b) * np.sin(c),
        ],
        -1,
    )
    return quaternions


def to_bins(quaternions: np.ndarray, count: int) -> np.ndarray:
    """The bins [..., 3] int64 of quaternions [..., 4] (x, y, z, w), where a turn has `count` of them."""
    width = 360 / count
    return np.round((angles_of(quaternions) + 180) / width).astype(np.int64) % count


def angles_of_bins(bins: np.ndarray, count: int) -> np.ndarray:
    """The angles [..., 3] in degrees that bins [..., 3] stand for."""
    angles: np.ndarray = np.asarray(bins) * (360 / count) - 180
    return angles


def from_bins(bins: np.ndarray, count: int) -> np.ndarray:
    """Quaternions [..., 4] (x, y, z, w) of bins [..., 3]."""
    return quaternions_of(angles_of_bins(bins, count))


def _half_turn(degrees: np.ndarray) -> np.ndarray:
    turned: np.ndarray = 180 - (180 - degrees) % 360
    return turned
