"""Between a point of the cube and the three heatmaps that tell it: targets, loss, reading, and the best point."""

import torch
from torch import Tensor

from mme_vla.backbone.sam2act.views import project

SIGMA = 1.5
"""Width of a target's peak in pixels, as released."""
_CUT = 4.5  # a target is zero where its Gaussian's exponent is below −4.5, three widths from the peak


def targets(pixels: Tensor, side: int, sigma: float = SIGMA) -> Tensor:
    """Heatmaps [n, side, side] that sum to 1, with a peak at each of the pixels [n, 2] (column, row).

    With a `sigma` below 0 all of a target stands in the one pixel that is nearest.
    """
    if sigma < 0:
        whole = pixels.round().to(torch.int64)
        sharp = pixels.new_zeros(len(pixels), side * side)
        inside = ((whole >= 0) & (whole < side)).all(-1)
        sharp[inside.nonzero()[:, 0], (whole[:, 1] * side + whole[:, 0])[inside]] = 1
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
        logits: [b, v, 1, side, side]. points: [b, 3], in the cube's coordinates.
    """
    side = logits.shape[-1]
    pixels = project(points, side)
    wanted = targets(pixels.flatten(0, 1), side, sigma).view(*pixels.shape[:2], side, side)
    return soft_cross_entropy(logits[:, :, 0], wanted)


def corners(pixels: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The four pixels around each place, and how much each of them counts.

    Args:
        pixels: [..., 2] (column, row), not rounded.

    Returns:
        int64 [..., 4] numbers of pixels, row by row, and weights [..., 4] that sum to 1, or to 0 outside the picture.
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

    The cells' places in the views never change: a column and a row of a view depend on one coordinate each, so that
    reading a map at all of them is resampling it along its two axes. What is kept is a number and a weight for
    each pair of coordinates.
    """

    def __init__(self, side: int, device: torch.device | None = None) -> None:
        self.side = side
        self.line = torch.linspace(-1 + 1 / side, 1 - 1 / side, side, device=device)
        first, second = torch.meshgrid(self.line, self.line, indexing="ij")
        zero = torch.zeros_like(first)
        # top is seen by (x, y), front by (y, z), right by (x, z)
        seen = [(first, second, zero), (zero, first, second), (first, zero, second)]
        pixels = torch.stack([project(torch.stack(xyz, -1), side)[..., view, :] for view, xyz in enumerate(seen)])
        self._numbers, self._weights = corners(pixels, side, side)

    def scores(self, heatmaps: Tensor) -> Tensor:
        """The views' mean at every cell, [side, side, side] by x, y, z, of maps [3, side, side]."""
        flat = heatmaps.flatten(1)
        read = [(flat[view][self._numbers[view]] * self._weights[view]).sum(-1) for view in range(len(flat))]
        top, front, right = read
        return (top[:, :, None] + front[None] + right[:, None, :]) / len(read)

    def find(self, logits: Tensor) -> Tensor:
        """The best points [b, 3] of logits [b, 3, 1, side, side]; the first of equal ones."""
        maps = logits[:, :, 0].flatten(2).softmax(-1).view_as(logits[:, :, 0])
        best = torch.stack([self.scores(maps_of_one).argmax() for maps_of_one in maps])
        cells = torch.stack([best // self.side**2, best // self.side % self.side, best % self.side], -1)
        return self.line[cells]
