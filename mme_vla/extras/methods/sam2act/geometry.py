"""Between a point of the cube and the three heatmaps that tell it: targets, loss, reading, and the
best point.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

ZOOM = 4.0
"""How much closer the second look is than the first, as released."""


def unproject(depth: np.ndarray, intrinsic: np.ndarray, extrinsic: np.ndarray) -> np.ndarray:
    """World points [h, w, 3] float64 of a depth image.

    A pixel stands at its whole-numbered column and row, not at its centre, as in the released code.

    Args:
        depth: [h, w], metres along the camera's axis.
        intrinsic: [3, 3].
        extrinsic: world to camera, [3, 4] or [4, 4].
    """
    depth = np.asarray(depth, np.float64)
    intrinsic = np.asarray(intrinsic, np.float64)
    extrinsic = np.asarray(extrinsic, np.float64)
    rows, columns = np.indices(depth.shape, dtype=np.float64)
    x = (columns - intrinsic[0, 2]) / intrinsic[0, 0] * depth
    y = (rows - intrinsic[1, 2]) / intrinsic[1, 1] * depth
    rotation, shift = extrinsic[:3, :3], extrinsic[:3, 3]
    camera_points: np.ndarray = np.stack([x, y, depth], -1) - shift
    return camera_points @ rotation  # of row vectors: the rotation's transpose, its inverse


@dataclass(frozen=True)
class Cube:
    """The workspace, scaled to the cube [−1, 1]³ by its longest side.

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


def shift_and_rotate(points: Tensor, centre: Tensor, shift: Tensor, angle: Tensor) -> Tensor:
    """Points [b, n, 3] turned about the vertical through a centre and moved.

    Args:
        centre: [b, 3].
        shift: [b, 3].
        angle: [b], radians, counter-clockwise seen from above.
    """
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    x, y, z = (points - centre[:, None]).unbind(-1)
    turned = torch.stack([cos * x - sin * y, sin * x + cos * y, z], -1)
    return turned + (centre + shift)[:, None]


VIEWS = 3
"""top · front · right, everywhere in this order."""
# Where the eyes stand; the third one stands closer, as released.
_ABOVE = 1.0
_AHEAD = 1.0
_BESIDE = 0.5


def project(points: Tensor, side: int) -> Tensor:
    """Columns and rows [..., 3 views, 2] of points [..., 3], in pixels of images of `side` and not
    rounded.
    """
    x, y, z = points.unbind(-1)
    half = side / 2
    columns = torch.stack([x, y, -x], -1)
    rows = torch.stack([-y, -z, -z], -1)
    return torch.stack([columns, rows], -1) * half + half


def depths(points: Tensor) -> Tensor:
    """How far points [..., 3] are from each camera along its axis, [..., 3 views]; negative behind
    it.
    """
    x, y, z = points.unbind(-1)
    return torch.stack([_ABOVE - z, _AHEAD - x, _BESIDE - y], -1)


def constant_channels(side: int, device: torch.device | None = None) -> Tensor:
    """Constant channels of each image, [3 views, 3, side, side]: its number from −1 to 1, and every
    row and column.
    """
    line = torch.linspace(-1, 1, side, device=device)
    number = torch.linspace(-1, 1, VIEWS, device=device)[:, None, None].expand(VIEWS, side, side)
    rows = line[:, None].expand(VIEWS, side, side)
    columns = line[None].expand(VIEWS, side, side)
    return torch.stack([number, rows, columns], 1)


_LOCK = 1.0
"""Degrees from straight up or down within which roll and yaw cannot be told apart, as released."""


def angles_of(quaternions: Tensor) -> Tensor:
    """Extrinsic x-y-z angles [..., 3] in degrees, in (−180, 180], of quaternions [..., 4] (x, y, z,
    w).

    Where y is within a degree of ±90 it counts as ±90, and all of the rest is the turn about x.
    """
    x, y, z, w = torch.nn.functional.normalize(quaternions.double(), dim=-1).unbind(-1)
    # With half angles a, b, c: (cos b + sin b)·(cos, sin)(a − c) and (cos b − sin b)·(cos, sin)(a +
    # c). Unlike the textbook's tangents neither of them is ill-conditioned at the pole that the
    # other fails at.
    difference, added = torch.atan2(x - z, w + y), torch.atan2(x + z, w - y)
    plus, minus = torch.hypot(x - z, w + y), torch.hypot(x + z, w - y)
    tilt = torch.rad2deg(2 * torch.atan2(plus - minus, plus + minus))
    up, down = tilt > 90 - _LOCK, tilt < -90 + _LOCK
    roll = torch.where(up, 2 * difference, torch.where(down, 2 * added, difference + added))
    yaw = torch.where(up | down, 0.0, added - difference)
    tilt = torch.where(up, 90.0, torch.where(down, -90.0, tilt))
    degrees = torch.rad2deg(torch.stack([roll, yaw]))
    roll, yaw = 180 - (180 - degrees).remainder(360)  # into (−180, 180]
    return torch.stack([roll, tilt, yaw], -1)


def to_bins(quaternions: Tensor, count: int) -> Tensor:
    """The bins [..., 3] int64 of quaternions [..., 4] (x, y, z, w), where a turn has `count` of
    them.
    """
    width = 360 / count
    return ((angles_of(quaternions) + 180) / width).round().to(torch.int64) % count


def angles_of_bins(bins: Tensor, count: int) -> Tensor:
    """The angles [..., 3] in degrees of bins [..., 3]."""
    return bins.double() * (360 / count) - 180


SIGMA = 1.5
"""Width of a target's peak in pixels, as released."""
_CUT = 4.5
"""A target is zero where its Gaussian's exponent is below −4.5, three widths from the peak."""


def targets(pixels: Tensor, side: int, sigma: float = SIGMA) -> Tensor:
    """Heatmaps [n, side, side] that sum to 1, with a peak at each of the pixels [n, 2] (column,
    row).

    With a `sigma` below 0 all of a target is in the one pixel that is nearest.
    """
    if sigma < 0:
        base = pixels.round().to(torch.int64)
        sharp = pixels.new_zeros(len(pixels), side * side)
        inside = ((base >= 0) & (base < side)).all(-1)
        sharp[inside.nonzero()[:, 0], (base[:, 1] * side + base[:, 0])[inside]] = 1
        return sharp.view(-1, side, side)
    line = torch.arange(side, device=pixels.device, dtype=pixels.dtype)
    squares = (line - pixels[..., None]) ** 2  # n 2 side
    exponent = (squares[:, 0, None, :] + squares[:, 1, :, None]) / (2 * sigma**2)
    peaks = torch.where(exponent <= _CUT, (-exponent).exp(), 0)
    return peaks / (peaks.sum((-2, -1), keepdim=True) + 1e-6)


def soft_cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    """The cross entropy of each map: logits and target [..., h, w] → [...]."""
    return -(target.flatten(-2) * logits.flatten(-2).log_softmax(-1)).sum(-1)


def heatmap_loss(logits: Tensor, points: Tensor, sigma: float = SIGMA) -> Tensor:
    """The loss of each sample and view [b, v].

    Args:
        logits: [b, v, 1, side, side].
        points: [b, 3], in the cube's coordinates.
    """
    side = logits.shape[-1]
    pixels = project(points, side)
    expected = targets(pixels.flatten(0, 1), side, sigma).view(*pixels.shape[:2], side, side)
    return soft_cross_entropy(logits[:, :, 0], expected)


def corners(pixels: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The four pixels around each place, and how much each of them counts.

    Args:
        pixels: [..., 2] (column, row), not rounded.

    Returns:
        int64 [..., 4] numbers of pixels, row by row, and weights [..., 4] that sum to 1, or to 0
        outside the image.
    """
    low, high = pixels.floor(), pixels.ceil()
    columns = torch.stack([low[..., 0], low[..., 0], high[..., 0], high[..., 0]], -1)
    rows = torch.stack([low[..., 1], high[..., 1], low[..., 1], high[..., 1]], -1)
    distance = ((columns - pixels[..., :1]) ** 2 + (rows - pixels[..., 1:]) ** 2).sqrt()
    weights = 1 / (distance + 1e-10)
    weights = weights / weights.sum(-1, keepdim=True)
    limit = pixels.new_tensor([width - 1, height - 1])
    outside = ((pixels < 0) | (pixels > limit)).any(-1)
    weights = weights.masked_fill(outside[..., None], 0)
    columns, rows = columns.clamp(0, width - 1), rows.clamp(0, height - 1)
    return (rows * width + columns).to(torch.int64), weights


def read_maps(maps: Tensor, pixels: Tensor) -> Tensor:
    """Values [v, n, c] of maps [v, c, h, w] at places [v, n, 2] (column, row); 0 outside."""
    height, width = maps.shape[-2:]
    numbers, weights = corners(pixels, height, width)
    flat = maps.flatten(2).transpose(1, 2)  # v (h w) c
    view = torch.arange(len(maps), device=maps.device)[:, None, None]
    return (flat[view, numbers] * weights[..., None]).sum(2)


class PointFinder:
    """Finds the point of the cube that three heatmaps agree on, among the centres of side³ cells.

    The cells' places in the views never change: a column and a row of a view depend on one
    coordinate each, so that reading a map at all of them is resampling it along its two axes. What
    is kept is a number and a weight for each pair of coordinates.
    """

    def __init__(self, side: int, device: torch.device | None = None) -> None:
        self.side = side
        self.line = torch.linspace(-1 + 1 / side, 1 - 1 / side, side, device=device)
        first, second = torch.meshgrid(self.line, self.line, indexing="ij")
        zero = torch.zeros_like(first)
        # top is seen by (x, y), front by (y, z), right by (x, z)
        axes = [(first, second, zero), (zero, first, second), (first, zero, second)]
        pixels = []
        for view, xyz in enumerate(axes):
            pixels.append(project(torch.stack(xyz, -1), side)[..., view, :])
        self._numbers, self._weights = corners(torch.stack(pixels), side, side)

    def scores(self, heatmaps: Tensor) -> Tensor:
        """The views' mean at every cell, [side, side, side] by x, y, z, of maps [3, side, side]."""
        flat = heatmaps.flatten(1)
        read = []
        for values, numbers, weights in zip(flat, self._numbers, self._weights, strict=True):
            read.append((values[numbers] * weights).sum(-1))
        top, front, right = read
        return (top[:, :, None] + front[None] + right[:, None, :]) / VIEWS

    def find(self, logits: Tensor) -> Tensor:
        """The best points [b, 3] of logits [b, 3, 1, side, side]; the first of equal ones."""
        maps = logits[:, :, 0].flatten(2).softmax(-1).view_as(logits[:, :, 0])
        best = torch.stack([self.scores(maps_of_one).argmax() for maps_of_one in maps])
        cells = torch.stack(
            [best // self.side**2, best // self.side % self.side, best % self.side], -1
        )
        return self.line[cells]


RADIUS = 0.012
"""Of a splat, in the cube's coordinates, as released."""
EMPTY = -1.0
"""Depth of a pixel where nothing is."""
_MILLIMETRES = 1000


def z_buffer(points: Tensor, features: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Each view's nearest points.

    Args:
        points: [n, 3] in the cube's coordinates.
        features: [n, c].

    Returns:
        images [3, side, side, c], zero where nothing is, and depths [3, side, side], `EMPTY` there.
    """
    count = len(points)
    free = torch.iinfo(torch.int64).max
    pixels = project(points, side).permute(1, 0, 2)  # v n 2
    columns, rows = pixels.unbind(-1)
    inside = (
        (columns >= 0) & (columns < side) & (rows >= 0) & (rows < side) & points.isfinite().all(-1)
    )
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

    Each pixel takes over its neighbour of least depth within the radius, if that is nearer than its
    own or it is empty. Neighbours of depth exactly 0 do not spread; among equal ones the last in
    order counts, columns before rows.

    Args:
        images: [v, side, side, c].
        depth: [v, side, side].
        radius: in the cube's coordinates.
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


def render(points: Tensor, features: Tensor, side: int, radius: float = RADIUS) -> Tensor:
    """Images [3, side, side, c + 1] of a cloud: its features and, last, the centred depth.

    Args:
        points: [n, 3] in the cube's coordinates.
        features: [n, c].
    """
    images, depth = splat(*z_buffer(points, features, side), radius)
    # Depth less the mean of each view's filled pixels; empty ones stay.
    filled = depth >= 0
    mean = torch.where(filled, depth, 0).sum((-2, -1)) / filled.sum((-2, -1)).clamp(min=1)
    centred = torch.where(filled, depth - mean[:, None, None], depth)
    return torch.cat([images, centred[..., None]], -1)


@torch.no_grad()
def virtual_images(points: Tensor, colours: Tensor, side: int) -> Tensor:
    """What the network sees of a cloud: [3 views, 10, side, side].

    Channels: place / the cloud's largest coordinate (3), colour (3), centred depth, then
    `constant_channels` (3).

    Args:
        points: [n, 3] in the cube's coordinates; at least one.
        colours: [n, 3] in [0, 1].
    """
    places = points / points.abs().max().clamp(min=1e-12)
    views = render(points, torch.cat([places, colours], -1), side).permute(0, 3, 1, 2)
    return torch.cat([views, constant_channels(side, points.device)], 1)


def _shifted(image: Tensor, across: int, down: int, fill: float) -> Tensor:
    """[v, s, s] whose pixel (row, column) is the given one's (row + down, column + across)."""
    side = image.shape[-1]
    shifted = torch.full_like(image, fill)
    rows = slice(max(-down, 0), side - max(down, 0))
    columns = slice(max(-across, 0), side - max(across, 0))
    there_rows = slice(max(down, 0), side + min(down, 0))
    there_columns = slice(max(across, 0), side + min(across, 0))
    shifted[:, rows, columns] = image[:, there_rows, there_columns]
    return shifted
