"""What the cameras show, as one cloud of coloured points; and what the network sees of a cloud."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.backbone.sam2act.geometry import Cube, unproject
from mme_vla.backbone.sam2act.render import EMPTY, virtual_pictures
from mme_vla.backbone.sam2act.views import VIEWS, constant_channels

MILLIMETRES = 1000.0
CHANNELS = 10
"""Of a virtual picture."""


@dataclass(frozen=True)
class Shot:
    """One camera at one moment.

    colours: [h, w, 3] uint8. depth: [h, w], millimetres. intrinsic: [3, 3]. extrinsic: world to camera, [3, 4].
    """

    colours: np.ndarray
    depth: np.ndarray
    intrinsic: np.ndarray
    extrinsic: np.ndarray

    def shrunk(self, side: int) -> "Shot":
        """The same at another size: colours averaged over areas, depths interpolated, as the authors do.

        Depths across an edge become points in the air between the two surfaces; the released weights know them.
        """
        height, width = self.depth.shape
        if (height, width) == (side, side):
            return self
        colours = torch.from_numpy(self.colours).permute(2, 0, 1)[None].float()
        small = nn.functional.interpolate(colours, (side, side), mode="area")[0].permute(1, 2, 0)
        deep = torch.from_numpy(np.asarray(self.depth, np.float32))[None, None]
        depth = nn.functional.interpolate(deep, (side, side), mode="bilinear")[0, 0]
        intrinsic = np.asarray(self.intrinsic, np.float64).copy()
        intrinsic[0] *= side / width
        intrinsic[1] *= side / height
        return Shot(small.round().to(torch.uint8).numpy(), depth.numpy(), intrinsic, self.extrinsic)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """World points [h·w, 3] float32 in metres, and their colours [h·w, 3] uint8."""
        world = unproject(np.asarray(self.depth, np.float64) / MILLIMETRES, self.intrinsic, self.extrinsic)
        return world.reshape(-1, 3).astype(np.float32), self.colours.reshape(-1, 3)


def cloud_of(shots: Sequence[Shot], side: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] float32 and colours [n, 3] uint8 of several cameras at `side` × `side` pixels each."""
    points, colours = zip(*(shot.shrunk(side).points() for shot in shots), strict=True)
    return np.concatenate(points), np.concatenate(colours)


def cloud_pictures(points: Tensor, colours: Tensor, cube: Cube, side: int) -> Tensor:
    """What the coarse look sees of clouds in the world: [b, 3, 10, side, side].

    Args:
        points: [b, n, 3] in metres; those outside of the cube are left out. colours: [b, n, 3] in [0, 1].
    """
    inside = cube.inside(points)
    return _pictures(cube.place(points), colours, inside, side)


def closer_pictures(points: Tensor, colours: Tensor, cube: Cube, centre: Tensor, zoom: float, side: int) -> Tensor:
    """What the closer look sees: the same points, `zoom` times larger around centres [b, 3] in the cube."""
    inside = cube.inside(points)
    return _pictures(zoom * (cube.place(points) - centre[:, None]), colours, inside, side)


def _pictures(points: Tensor, colours: Tensor, shown: Tensor, side: int) -> Tensor:
    if points.is_meta:  # shapes alone: there is nothing to draw
        return points.new_empty(len(points), VIEWS, CHANNELS, side, side)
    seen = [
        virtual_pictures(cloud[kept], paint[kept], side) if kept.any() else _nothing(side, cloud.device)
        for cloud, paint, kept in zip(points, colours, shown, strict=True)
    ]
    return torch.stack(seen)


def _nothing(side: int, device: torch.device) -> Tensor:
    blank = torch.zeros(VIEWS, 7, side, side, device=device)
    blank[:, 6] = EMPTY
    return torch.cat([blank, constant_channels(side, device)], 1)
