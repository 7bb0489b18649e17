"""Where points are: out of a depth picture into the world, into the cube that is rendered, closer to one of them.

All of it is plain arithmetic on [..., 3] arrays of points, NumPy's or PyTorch's.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

ZOOM = 4.0
"""How much closer the second look is than the first, as released."""


def unproject(depth: np.ndarray, intrinsic: np.ndarray, extrinsic: np.ndarray) -> np.ndarray:
    """World points [h, w, 3] float64 of a depth picture.

    A pixel stands at its whole-numbered column and row, not at its centre, as in the released code.

    Args:
        depth: [h, w], metres along the camera's axis. intrinsic: [3, 3]. extrinsic: world to camera, [3, 4] or [4, 4].
    """
    depth, intrinsic, extrinsic = (np.asarray(x, np.float64) for x in (depth, intrinsic, extrinsic))
    rows, columns = np.indices(depth.shape, dtype=np.float64)
    x = (columns - intrinsic[0, 2]) / intrinsic[0, 0] * depth
    y = (rows - intrinsic[1, 2]) / intrinsic[1, 1] * depth
    rotation, shift = extrinsic[:3, :3], extrinsic[:3, 3]
    seen: np.ndarray = np.stack([x, y, depth], -1) - shift
    return seen @ rotation  # of row vectors: the rotation's transpose, its inverse


@dataclass(frozen=True)
class Cube:
    """The part of the world that is looked at, scaled to the cube [−1, 1]³ by its longest side.

    low, high: corners in metres.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @classmethod
    def of(cls, bounds: np.ndarray | tuple[float, ...] | list[float]) -> Self:
        """From x, y, z of the lowest corner and then of the highest."""
        numbers = [float(number) for number in bounds]
        return cls((numbers[0], numbers[1], numbers[2]), (numbers[3], numbers[4], numbers[5]))

    def inside(self, points: Tensor) -> Tensor:
        """Which of the points [..., 3] lie strictly inside and are numbers; bool [...]."""
        low, high = points.new_tensor(self.low), points.new_tensor(self.high)
        return ((points > low) & (points < high)).all(-1)  # NaN compares false

    def place(self, points: Tensor) -> Tensor:
        """World points [..., 3] in the cube's coordinates."""
        middle, half = self._middle_and_half(points)
        return (points - middle) / half

    def back(self, points: Tensor) -> Tensor:
        """The cube's coordinates [..., 3] as world points: the inverse of `place`."""
        middle, half = self._middle_and_half(points)
        return points * half + middle

    def _middle_and_half(self, like: Tensor) -> tuple[Tensor, Tensor]:
        low, high = like.new_tensor(self.low), like.new_tensor(self.high)
        return (low + high) / 2, (high - low).max() / 2


def zoom(points: Tensor, centre: Tensor, factor: float = ZOOM) -> Tensor:
    """Points [b, n, 3] as seen from closer to a centre [b, 3]."""
    return factor * (points - centre[:, None])


def zoom_back(point: Tensor, centre: Tensor, factor: float = ZOOM) -> Tensor:
    """One point [b, 3] of a closer look, in the coordinates of the first."""
    return point / factor + centre


def shift_and_turn(points: Tensor, centre: Tensor, shift: Tensor, angle: Tensor) -> Tensor:
    """Points [b, n, 3] turned about the vertical through a centre and moved.

    Args:
        centre: [b, 3]. shift: [b, 3]. angle: [b], radians, counter-clockwise seen from above.
    """
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    x, y, z = (points - centre[:, None]).unbind(-1)
    turned = torch.stack([cos * x - sin * y, sin * x + cos * y, z], -1)
    return turned + (centre + shift)[:, None]
