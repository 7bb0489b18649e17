"""Pictures as OpenVLA's family sees them: Lanczos-3 on uint8, a crop of 90 % of the area, four changes of colour."""

import io
import math

import numpy as np
import torch
from torch import Tensor

from mme_vla.processing.augment import hsv_to_rgb, rgb_to_hsv

SIDE = math.sqrt(0.9)  # of the crop, as a fraction of the picture's
BRIGHTNESS, CONTRAST, SATURATION, HUE = 0.2, (0.8, 1.2), (0.8, 1.2), 0.05
JPEG_QUALITY = 95
RADIUS = 3.0  # lobes of the Lanczos kernel


def lanczos(frames: np.ndarray, size: int) -> np.ndarray:
    """Resize to size × size with Lanczos-3, antialiased where it shrinks; half-pixel centres.

    Args:
        frames: [..., H, W, 3] uint8.

    Returns:
        [..., size, size, 3] uint8, rounded and clipped; `frames` itself where it has this size.
    """
    if frames.shape[-3:-1] == (size, size):
        return frames
    *count, height, width, colours = frames.shape
    lines = frames.reshape(*count, height, width * colours).astype(np.float32)
    resized = (_weights(height, size) @ lines).reshape(*count, size, width, colours)
    resized = _weights(width, size) @ resized
    return np.clip(np.rint(resized), 0, 255).astype(np.uint8)


def _weights(length: int, size: int) -> np.ndarray:
    """What each of `size` places takes of each of `length` ones: [size, length] float32, rows add up to 1."""
    scale = length / size
    widened = max(scale, 1.0)
    centres = (np.arange(size) + 0.5) * scale
    x = (np.arange(length) + 0.5 - centres[:, None]) / widened
    weights = np.where(np.abs(x) < RADIUS, np.sinc(x) * np.sinc(x / RADIUS), 0.0)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def jpeg_round_trip(frames: np.ndarray) -> np.ndarray:
    """Write pictures [..., H, W, 3] uint8 as JPEG of quality 95 and read them again."""
    from PIL import Image

    out = np.empty_like(frames)
    for index in np.ndindex(frames.shape[:-3]):
        file = io.BytesIO()
        Image.fromarray(frames[index]).save(file, "JPEG", quality=JPEG_QUALITY)
        out[index] = np.asarray(Image.open(file))
    return out


def crop(pixels: Tensor, top: Tensor, left: Tensor) -> Tensor:
    """Cut a square of 90 % of the area and resize it back, bilinear, corner on corner, without antialiasing.

    Args:
        pixels: [n, 3, s, s]. top, left: [n] fractions of the picture, in [0, 1 − √0.9].

    Returns:
        [n, 3, s, s].
    """
    size = pixels.shape[-1]
    steps = torch.arange(size, device=pixels.device, dtype=pixels.dtype) * SIDE
    rows = _lines(pixels, top[:, None].to(pixels) * (size - 1) + steps, -2)
    return _lines(rows, left[:, None].to(pixels) * (size - 1) + steps, -1)


def _lines(pixels: Tensor, places: Tensor, axis: int) -> Tensor:
    """Interpolate [n, 3, s, s] along an axis at places [n, s] in pixels."""
    last = pixels.shape[axis] - 1
    low = places.floor().clamp(0, last)
    shape = [len(pixels), 1, 1, 1]
    shape[axis] = places.shape[1]
    take = [len(pixels), *pixels.shape[1:]]

    def at(index: Tensor) -> Tensor:
        return pixels.gather(pixels.ndim + axis, index.long().view(shape).expand(take))

    share = (places - low).view(shape)
    first = at(low)
    return first + (at((low + 1).clamp(max=last)) - first) * share


def centre_crop(images: Tensor) -> Tensor:
    """What test time shows of pictures [..., 3, s, s] uint8: the middle 90 % of the area, resized back; uint8."""
    flat = images.flatten(0, -4)
    middle = torch.full((len(flat),), (1 - SIDE) / 2, device=images.device, dtype=torch.float64)
    return quantised(crop(flat.float() / 255, middle, middle).clamp(0, 1)).view(images.shape)


def centre_cut(images: Tensor) -> Tensor:
    """As `centre_crop`, but of whole pixels and resized back with Lanczos-3: how MemoryVLA shows pictures."""
    if images.is_meta:  # shapes alone: there is nothing to resize
        return images
    size = images.shape[-1]
    side = int(SIDE * size)
    start = (size - side) // 2
    cut = images[..., start : start + side, start : start + side].movedim(-3, -1)
    return torch.from_numpy(lanczos(cut.cpu().numpy(), size)).movedim(-1, -3).to(images.device)


def quantised(pixels: Tensor) -> Tensor:
    """[0, 1] → uint8, as TensorFlow's `convert_image_dtype` rounds: the floor of 255.5·x."""
    return (pixels * 255.5).floor().clamp(0, 255).to(torch.uint8)


def draw_changes(count: int, generator: torch.Generator | None = None, device: torch.device | None = None) -> Tensor:
    """Draws of `count` pictures [n, 6], made on the CPU: top, left, brightness, contrast, saturation, hue."""
    u = torch.rand(count, 6, generator=generator)
    low = torch.tensor([0, 0, -BRIGHTNESS, CONTRAST[0], SATURATION[0], -HUE])
    high = torch.tensor([1 - SIDE, 1 - SIDE, BRIGHTNESS, CONTRAST[1], SATURATION[1], HUE])
    return (low + (high - low) * u).to(device)


def augment(images: Tensor, draws: Tensor) -> Tensor:
    """Crop and change the colours of pictures, each by its own draws.

    Args:
        images: [n, 3, s, s] uint8. draws: [n, 6] as `draw_changes` makes them.

    Returns:
        [n, 3, s, s] uint8.
    """
    top, left, *colours = draws.to(images.device).unbind(1)
    pixels = crop(images.float() / 255, top, left).clamp(0, 1)
    for change, by in zip((brighten, contrast, saturate, turn_hue), colours, strict=True):
        pixels = change(pixels, by[:, None, None, None].float()).clamp(0, 1)
    return quantised(pixels)


def brighten(pixels: Tensor, by: Tensor) -> Tensor:
    """Add to every colour."""
    return pixels + by


def contrast(pixels: Tensor, by: Tensor) -> Tensor:
    """Stretch about the picture's mean of each colour."""
    mean = pixels.mean((-2, -1), keepdim=True)
    return (pixels - mean) * by + mean


def saturate(pixels: Tensor, by: Tensor) -> Tensor:
    """Multiply the saturation."""
    hue, saturation, value = rgb_to_hsv(pixels[:, None])
    return hsv_to_rgb(hue, (saturation * by.squeeze(-1)).clamp(0, 1), value)[:, 0]


def turn_hue(pixels: Tensor, by: Tensor) -> Tensor:
    """Turn the hue, in turns of the circle."""
    hue, saturation, value = rgb_to_hsv(pixels[:, None])
    return hsv_to_rgb((hue + by.squeeze(-1)) % 1, saturation, value)[:, 0]
