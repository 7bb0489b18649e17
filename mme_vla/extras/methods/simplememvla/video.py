"""The video of SimpleMemVLA: which frames it shows, when they were, at which size, and as which
rows of pixels.

Shapes: n frames · H, W pixels · p side of a patch · m merged patches a side.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from einops import rearrange
from torch import Tensor
from torch.nn import functional

from mme_vla.errors import UserError

TEMPORAL = 2
"""Frames of a temporal patch."""
_LUMA = (0.2989, 0.587, 0.114)
_HUE = np.array([
    [[0.299, 0.701, 0.168], [0.587, -0.587, 0.330], [0.114, -0.114, -0.497]],
    [[0.299, -0.299, -0.328], [0.587, 0.413, 0.035], [0.114, -0.114, 0.292]],
    [[0.299, -0.300, 1.250], [0.587, -0.588, -1.050], [0.114, 0.886, -0.203]],
])  # fmt: skip
"""Rotation of hue: each entry is c₀ + c₁·cos + c₂·sin."""


@dataclass(frozen=True)
class Window:
    """The frames that a video shows at a step.

    seconds, fps: length and rate of the video.
    native_fps: rate of the camera.
    variable: show only frames that exist, at least two; else a full window, the first frame
        repeated before the start.
    """

    seconds: float
    fps: float
    native_fps: float
    variable: bool = True

    @property
    def length(self) -> int:
        """Frames of a full window, an even number."""
        count = max(TEMPORAL, round(self.seconds * self.fps))
        return count + count % 2

    @property
    def stride(self) -> int:
        """Camera frames between two shown ones."""
        return max(1, round(self.native_fps / self.fps))

    @property
    def span(self) -> int:
        """Camera frames before the current one that a full window reaches back."""
        return (self.length - 1) * self.stride

    def frames(self, step: int) -> np.ndarray:
        """The frames shown at a step, counted from the episode's first one, video included: int64
        [n], ascending.
        """
        count = self.length
        if self.variable:  # those that exist, an even number
            available = min(step // self.stride + 1, self.length)
            count = max(TEMPORAL, available + available % 2)
        return np.maximum(step - self.stride * np.arange(count - 1, -1, -1), 0)

    def times(self, count: int) -> list[float]:
        """The time of each temporal patch of `count` frames in seconds since the first one."""
        seconds = np.arange(count) / (self.native_fps / self.stride)
        return [float((a + b) / 2) for a, b in zip(seconds[::2], seconds[1::2], strict=True)]


def timestamp(seconds: float) -> str:
    """How a prompt says when a temporal patch was."""
    return f"<{seconds:.1f} seconds>"


def fitting_size(
    height: int, width: int, frames: int, factor: int, bounds: tuple[int, int]
) -> tuple[int, int]:
    """The size that images of H×W are resized to: sides are multiples of `factor`, pixels lie
    within `bounds`.

    Args:
        frames: of a video, all of which count, or 1 for an image.
        bounds: least and most pixels.
    """
    if max(height, width) > 200 * min(height, width):
        raise UserError(f"Images of {height}×{width} pixels are too narrow for the vision tower.")
    low, high = bounds
    padded = frames
    if frames > 1:
        padded += frames % TEMPORAL
    rows = max(1, round(height / factor))
    columns = max(1, round(width / factor))
    pixels = padded * rows * columns * factor**2
    if pixels > high:
        scale = math.sqrt(frames * height * width / high)
        rows = max(1, math.floor(height / scale / factor))
        columns = max(1, math.floor(width / scale / factor))
    elif pixels < low:
        scale = math.sqrt(low / (frames * height * width))
        rows = math.ceil(height * scale / factor)
        columns = math.ceil(width * scale / factor)
    return rows * factor, columns * factor


def resized(frames: Tensor, size: tuple[int, int]) -> Tensor:
    """Frames [..., 3, H, W] uint8 at another size: bicubic with antialiasing, rounded to uint8."""
    if frames.shape[-2:] == size:
        return frames
    flat = frames.reshape(-1, *frames.shape[-3:])
    new = functional.interpolate(flat, size, mode="bicubic", antialias=True, align_corners=False)
    return new.reshape(*frames.shape[:-2], *size)


def channels_first(frames: np.ndarray) -> Tensor:
    """Frames [..., H, W, 3] uint8 as a tensor [..., 3, H, W]."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(frames, -1, -3)))


def pixel_rows(frames: Tensor, patch: int, merge: int) -> Tensor:
    """Pairs of frames as the rows that the vision tower reads.

    Args:
        frames: [n, 2, 3, H, W] uint8, the two frames of each temporal patch.

    Returns:
        float32 [n · H/p · W/p, 3 · 2 · p · p] in [−1, 1], the patches of one merged token side by
        side.
    """
    pixels = (frames.float() / 255 - 0.5) / 0.5
    axes = {"p": patch, "q": patch, "a": merge, "b": merge}
    return rearrange(pixels, "n t c (h a p) (w b q) -> (n h w a b) (c t p q)", **axes)


# Augmentation: one draw for all images of a sample


def augmentation_draw(uniform: Sequence[float]) -> np.ndarray:
    """Seven numbers in [0, 1) as (area, top, left, brightness, contrast, saturation, hue): [7]."""
    low = np.array([0.9, 0, 0, 0.8, 0.8, 0.8, -0.05])
    high = np.array([1.0, 1, 1, 1.2, 1.2, 1.2, 0.05])
    return low + (high - low) * np.asarray(uniform, np.float64)


def colour_matrix(saturation: float, hue: float) -> np.ndarray:
    """The matrix [3, 3] that changes saturation, then hue."""
    of_saturation = saturation * np.eye(3) + (1 - saturation) * np.array([0.299, 0.587, 0.114])
    angle = 2 * math.pi * hue
    return (_HUE @ np.array([1, math.cos(angle), math.sin(angle)])) @ of_saturation


def augment(frames: Tensor, draw: np.ndarray) -> Tensor:
    """Frames [n, 3, H, W] uint8, all changed alike.

    Args:
        draw: of `augmentation_draw`.
    """
    area, top, left, brightness, contrast, saturation, hue = map(float, draw)
    height, width = frames.shape[-2:]
    sides = [max(1, round(side * math.sqrt(area))) for side in (height, width)]
    y, x = round(top * (height - sides[0])), round(left * (width - sides[1]))
    pixels = frames.float()[..., y : y + sides[0], x : x + sides[1]] / 255
    pixels = functional.interpolate(pixels, (height, width), mode="bilinear", align_corners=False)
    pixels = (brightness * pixels).clamp(0, 1)
    luma = (pixels * pixels.new_tensor(_LUMA)[:, None, None]).sum(-3, keepdim=True)
    mean = luma.mean((-2, -1), keepdim=True)
    pixels = (contrast * pixels + (1 - contrast) * mean).clamp(0, 1)
    matrix = torch.from_numpy(colour_matrix(saturation, hue)).to(pixels)
    pixels = torch.einsum("ij,njhw->nihw", matrix, pixels).clamp(0, 1)
    return (pixels * 255).round().to(torch.uint8)
