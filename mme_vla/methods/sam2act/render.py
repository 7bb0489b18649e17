"""The virtual images of a cloud of points: a z-buffer in millimetres, small splats, centred depth; plain PyTorch.

The same rules as the released renderer, which is a CUDA kernel: depths count in whole millimetres, what is behind a
camera counts as depth 0 and so stands before everything, and equal depths go to the point that comes first.
"""

import torch
from torch import Tensor

from mme_vla.methods.sam2act.geometry import VIEWS, constant_channels, depths, project

RADIUS = 0.012
"""Of a splat, in the cube's coordinates, as released."""
EMPTY = -1.0
"""Depth of a pixel where nothing is."""
_MILLIMETRES = 1000


def z_buffer(points: Tensor, features: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Each view's nearest points.

    Args:
        points: [n, 3] in the cube's coordinates. features: [n, c].

    Returns:
        images [3, side, side, c], zero where nothing is, and depths [3, side, side], `EMPTY` there.
    """
    count, free = len(points), torch.iinfo(torch.int64).max
    pixels = project(points, side).permute(1, 0, 2)  # v n 2
    columns, rows = pixels.unbind(-1)
    inside = (columns >= 0) & (columns < side) & (rows >= 0) & (rows < side) & points.isfinite().all(-1)
    millimetres = (depths(points).T * _MILLIMETRES).clamp(min=0).to(torch.int64)
    view = torch.arange(VIEWS, device=points.device)[:, None]
    places = (view * side + rows.to(torch.int64)) * side + columns.to(torch.int64)
    # One number orders by depth and then by place in the cloud.
    ranks = millimetres * max(count, 1) + torch.arange(count, device=points.device)
    nearest = torch.full((VIEWS * side * side,), free, dtype=torch.int64, device=points.device)
    nearest.scatter_reduce_(0, places[inside], ranks[inside], "amin")
    hit = nearest != free
    images = features.new_zeros(len(nearest), features.shape[-1])
    images[hit] = features[nearest[hit] % max(count, 1)]
    depth = points.new_full((len(nearest),), EMPTY)
    depth[hit] = (nearest[hit] // max(count, 1)).to(points.dtype) * (1 / _MILLIMETRES)
    return images.view(VIEWS, side, side, -1), depth.view(VIEWS, side, side)


def splat(images: Tensor, depth: Tensor, radius: float = RADIUS) -> tuple[Tensor, Tensor]:
    """Let near points cover the pixels around them.

    Each pixel takes over its neighbour of least depth within the radius, if that is nearer than its own or it is empty.
    Neighbours of depth exactly 0 do not spread; among equal ones the last in order counts, columns before rows.

    Args:
        images: [v, side, side, c]. depth: [v, side, side]. radius: in the cube's coordinates.
    """
    side = depth.shape[-1]
    reach = radius * side / 2
    near = depth.clone()
    near[depth < 0] = torch.inf
    pixels = torch.arange(side * side, device=depth.device).view(side, side)
    best, source = near.clone(), pixels.expand_as(depth)
    spreading = torch.where(near == 0, torch.inf, near)
    reach_pixels = int(reach)
    for across in range(-reach_pixels, reach_pixels + 1):
        for down in range(-reach_pixels, reach_pixels + 1):
            if (across, down) == (0, 0) or (across**2 + down**2) ** 0.5 >= reach:
                continue
            neighbour = _shifted(spreading, across, down, torch.inf)
            # An own point holds against its equals; a neighbour does not.
            taken = (neighbour < near) & (neighbour <= best)
            source = torch.where(taken, pixels + down * side + across, source)
            best = torch.where(taken, neighbour, best)
    nearest = source.view(len(depth), -1)
    view = torch.arange(len(depth), device=depth.device)[:, None]
    covered = images.view(len(depth), side * side, -1)[view, nearest].view_as(images)
    return covered, torch.where(best.isinf(), EMPTY, best)


def centred(depth: Tensor) -> Tensor:
    """Depths [v, side, side] less the mean of each view's filled pixels; empty ones stay."""
    filled = depth >= 0
    mean = torch.where(filled, depth, 0).sum((-2, -1)) / filled.sum((-2, -1)).clamp(min=1)
    return torch.where(filled, depth - mean[:, None, None], depth)


def render(points: Tensor, features: Tensor, side: int, radius: float = RADIUS) -> Tensor:
    """Images [3, side, side, c + 1] of a cloud: its features and, last, the centred depth.

    Args:
        points: [n, 3] in the cube's coordinates. features: [n, c].
    """
    images, depth = splat(*z_buffer(points, features, side), radius)
    return torch.cat([images, centred(depth)[..., None]], -1)


@torch.no_grad()
def virtual_images(points: Tensor, colours: Tensor, side: int) -> Tensor:
    """What the network sees of a cloud: [3 views, 10, side, side].

    Channels: place / the cloud's largest coordinate (3), colour (3), centred depth, then `constant_channels` (3).

    Args:
        points: [n, 3] in the cube's coordinates; at least one. colours: [n, 3] in [0, 1].
    """
    places = points / points.abs().max().clamp(min=1e-12)
    views = render(points, torch.cat([places, colours], -1), side).permute(0, 3, 1, 2)
    return torch.cat([views, constant_channels(side, points.device)], 1)


def _shifted(image: Tensor, across: int, down: int, fill: float) -> Tensor:
    """[v, s, s] whose pixel (row, column) is the given one's (row + down, column + across)."""
    side = image.shape[-1]
    shifted = torch.full_like(image, fill)
    rows, columns = slice(max(-down, 0), side - max(down, 0)), slice(max(-across, 0), side - max(across, 0))
    there_rows, there_columns = slice(max(down, 0), side + min(down, 0)), slice(max(across, 0), side + min(across, 0))
    shifted[:, rows, columns] = image[:, there_rows, there_columns]
    return shifted
