"""Training-time augmentation of the current views. Memory frames are never augmented.

As released: base cameras are cropped, resized back and rotated in one resampling; then every camera's colours are
jittered half of the time. The released saturation jitter has no effect, so there is none here.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.errors import UserError

CROP = 0.95  # side of the crop, rounded down to whole pixels: 212 of 224
ROTATION = math.radians(5)
JITTER_PROBABILITY = 0.5
BRIGHTNESS, CONTRAST, HUE = 0.3, 0.4, 0.1
NUMBERS = 7  # random numbers a sample: place of the crop (2), angle, brightness, contrast, hue, whether it is coloured


def augmentation_draws(count: int, generator: torch.Generator | None = None) -> Tensor:
    """The random numbers of `count` samples, uniform [count, 7] on the CPU: none depends on which cameras there are."""
    return torch.rand(count, NUMBERS, generator=generator)


@torch.no_grad()
def augment_views(images: Tensor, augmentations: Sequence[str], draws: Tensor) -> Tensor:
    """Augment a batch of current observations on the device they are on, without waiting for it.

    All views of one sample share their random numbers, as released.

    Args:
        images: [b, v, 3, s, s] float in [-1, 1].
        augmentations: what is done to each of the v views: `all`, `colour` (neither cropped nor rotated) or `none`.
        draws: [b, 7] as `augmentation_draws` makes them, on that device.

    Returns:
        [b, v, 3, s, s] float32 in [-1, 1].
    """
    if images.ndim != 5 or images.shape[2] != 3 or images.shape[-1] != images.shape[-2]:
        raise UserError(f"Expected square images [b, v, 3, s, s], got {list(images.shape)}.")
    if images.shape[1] != len(augmentations):
        raise UserError(f"Got {images.shape[1]} views but {len(augmentations)} cameras are described.")
    symmetric = draws[:, :6] * 2 - 1
    offset, angle = symmetric[:, :2], symmetric[:, 2] * ROTATION
    brightness, contrast, hue = symmetric[:, 3] * BRIGHTNESS, symmetric[:, 4] * CONTRAST, symmetric[:, 5] * HUE
    jittered = (draws[:, 6] < JITTER_PROBABILITY)[:, None, None, None]

    pixels = (images.float() + 1) / 2  # in [0, 1] the zero fill of the resampling is black
    views = list(pixels.unbind(1))
    base = [i for i, kind in enumerate(augmentations) if kind == "all"]
    if base:
        warped = crop_and_rotate(torch.stack([views[i] for i in base], 1), offset, angle)
        for i, view in zip(base, warped.unbind(1), strict=True):
            views[i] = view
    coloured = jitter_colours(torch.stack(views, 1), brightness, contrast, hue)
    for i, kind in enumerate(augmentations):
        if kind != "none":
            views[i] = torch.where(jittered, coloured[:, i], views[i])
    return torch.stack(views, 1).clamp(0, 1) * 2 - 1


def crop_and_rotate(pixels: Tensor, offset: Tensor, angle: Tensor) -> Tensor:
    """Crop, resize back and rotate in one bilinear resampling, black outside.

    Args:
        pixels: [b, v, 3, s, s] in [0, 1].
        offset: [b, 2] in [-1, 1]; where the crop lies between its extreme places, (x, y), sub-pixel.
        angle: [b] radians.
    """
    batch, views, _, size, _ = pixels.shape
    scale = int(CROP * size) / size
    cos, sin = scale * angle.cos(), scale * angle.sin()
    shift = (1 - scale) * offset
    rows = torch.stack([torch.stack([cos, -sin, shift[:, 0]], 1), torch.stack([sin, cos, shift[:, 1]], 1)], 1)
    grid = functional.affine_grid(rows, [batch, 1, size, size], align_corners=False)
    stacked = pixels.flatten(1, 2)  # the views of a sample move together: as channels they share one grid
    warped = functional.grid_sample(stacked, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return warped.unflatten(1, (views, 3))


def jitter_colours(pixels: Tensor, brightness: Tensor, contrast: Tensor, hue: Tensor) -> Tensor:
    """Change brightness and contrast of the HSV value, then turn the hue.

    Args:
        pixels: [b, v, 3, s, s] in [0, 1].
        brightness: [b]; below 0 towards black, above 0 towards white.
        contrast: [b] in (-1, 1); 0 changes nothing.
        hue: [b] in turns.
    """
    brightness, contrast, hue = (x[:, None, None, None] for x in (brightness, contrast, hue))
    h, s, value = rgb_to_hsv(pixels)
    value = torch.where(brightness < 0, value * (1 + brightness), value * (1 - brightness) + brightness)
    # A line of slope k through the middle, continued by lines of slope 1/k that end in black and in white.
    k = torch.tan((contrast + 1) * (math.pi / 4))
    knee = k / (2 * (1 + k))
    middle = k * (value - 0.5) + 0.5
    value = torch.where(value < knee, value / k, torch.where(value > 1 - knee, (value - 1) / k + 1, middle))
    return hsv_to_rgb(h + hue, s, value)


def rgb_to_hsv(pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """[b, v, 3, s, s] → hue in turns, saturation, value, each [b, v, s, s]."""
    red, green, blue = pixels.unbind(2)
    value, low = pixels.amax(2), pixels.amin(2)
    chroma = value - low
    divisor = torch.where(chroma > 0, chroma, 1.0)
    sextant = torch.where(
        value == red,
        (green - blue) / divisor,
        torch.where(value == green, (blue - red) / divisor + 2, (red - green) / divisor + 4),
    )
    saturation = chroma / torch.where(value > 0, value, 1.0)
    return (sextant / 6) % 1, saturation, value


def hsv_to_rgb(hue: Tensor, saturation: Tensor, value: Tensor) -> Tensor:
    """Inverse of `rgb_to_hsv`: each channel falls from `value` as the hue moves away from it."""
    channels = []
    for start in (5, 3, 1):
        k = (start + hue * 6) % 6
        channels.append(value * (1 - saturation * torch.minimum(k, 4 - k).clamp(0, 1)))
    return torch.stack(channels, 2)
