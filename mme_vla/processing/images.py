"""Images between camera and vision tower: two resize paths, as released.

The current observation goes through Pillow on uint8; memory frames go through an antialiased float
resize. The two differ by rounding only, yet the released weights were trained with exactly this
pair.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.errors import UserError
from mme_vla.memory.base import PastViewSpec
from mme_vla.types import FrameBatch, PastViews, to_unit_range


def resize_with_pad_uint8(frames: np.ndarray, size: tuple[int, int] | int) -> np.ndarray:
    """Resize with Pillow's bilinear filter, keeping the aspect ratio, on a black canvas: the path
    of current views.

    Args:
        frames: [..., H, W, 3] uint8.
        size: (h, w), or one number for a square.

    Returns:
        [..., h, w, 3] uint8; `frames` itself when they have this size already.
    """
    from PIL import Image

    if frames.dtype != np.uint8 or frames.ndim < 3 or frames.shape[-1] != 3:
        raise UserError(
            f"Expected uint8 images [..., height, width, 3], got {frames.dtype}"
            f" {list(frames.shape)}."
        )
    height, width = _pair(size)
    if frames.shape[-3:-1] == (height, width):
        return frames
    inner_h, inner_w, top, left = _fit(frames.shape[-3], frames.shape[-2], height, width)
    canvas = np.zeros((*frames.shape[:-3], height, width, 3), np.uint8)
    for index in np.ndindex(frames.shape[:-3]):
        resized = Image.fromarray(frames[index]).resize(
            (inner_w, inner_h), Image.Resampling.BILINEAR
        )
        canvas[index][top : top + inner_h, left : left + inner_w] = np.asarray(resized)
    return canvas


def resize_with_pad(images: Tensor, size: tuple[int, int] | int) -> Tensor:
    """Resize with an antialiased bilinear filter, keeping the aspect ratio: the path of memory
    frames.

    Args:
        images: [n, H, W, 3], uint8 or float in [-1, 1].
        size: (h, w), or one number for a square.

    Returns:
        [n, 3, h, w] float32 in [-1, 1], on the device of `images`.
    """
    if images.ndim != 4 or images.shape[-1] != 3:
        raise UserError(f"Expected images [n, height, width, 3], got {list(images.shape)}.")
    source = images.movedim(-1, 1)
    if images.dtype == torch.uint8:
        source = to_unit_range(source)
    elif images.is_floating_point():
        source = source.float()
    else:
        raise UserError(f"Expected images as uint8, or as float in [-1, 1]; got {images.dtype}.")
    height, width = _pair(size)
    if source.shape[-2:] == (height, width):
        return source.contiguous()
    inner_h, inner_w, top, left = _fit(source.shape[-2], source.shape[-1], height, width)
    resized = functional.interpolate(
        source, (inner_h, inner_w), mode="bilinear", antialias=True, align_corners=False
    )
    borders = (left, width - inner_w - left, top, height - inner_h - top)
    return functional.pad(resized.clamp(-1, 1), borders, value=-1.0)


def as_uint8_frames(image: np.ndarray | Tensor) -> np.ndarray:
    """Bring one image, or a stack of them, into the form the resize expects: uint8, channels last.

    Accepts uint8, or float in [0, 1] (mapped by truncating 255·x, as released), with the channels
    last or first.
    """
    if isinstance(image, Tensor):
        image = image.detach().cpu().numpy()
    array = np.asarray(image)
    if array.ndim not in (3, 4):
        raise UserError(
            f"Expected an image [H, W, 3] or a stack [n, H, W, 3], got shape {list(array.shape)}."
        )
    if array.shape[-1] != 3 and array.shape[-3] == 3:
        array = np.moveaxis(array, -3, -1)
    if array.shape[-1] != 3:
        raise UserError(
            f"Expected RGB images (three channels first or last), got shape {list(array.shape)}."
        )
    if np.issubdtype(array.dtype, np.floating):
        # `not …` refuses NaN as well.
        if array.size and not (array.min() >= 0 and array.max() <= 1):
            raise UserError(
                f"Float images must lie in [0, 1], got values from {array.min():g} to"
                f" {array.max():g}: divide by 255."
            )
        return (255 * array).astype(np.uint8)
    if array.dtype != np.uint8:
        raise UserError(f"Expected images as uint8, or as float in [0, 1]; got {array.dtype}.")
    return array


def _pair(size: tuple[int, int] | int) -> tuple[int, int]:
    return (size, size) if isinstance(size, int) else size


def _fit(source_h: int, source_w: int, height: int, width: int) -> tuple[int, int, int, int]:
    """Say how large the image becomes inside (height, width) and where it sits: (h, w,
    top, left).
    """
    ratio = max(source_w / width, source_h / height)
    inner_h, inner_w = max(int(source_h / ratio), 1), max(int(source_w / ratio), 1)
    return inner_h, inner_w, (height - inner_h) // 2, (width - inner_w) // 2


Prepare = Callable[[Sequence[np.ndarray]], Tensor]
"""Images [n, H, W, 3] uint8 of every camera in the embodiment's order → [n, v, 3, s, s] uint8."""


class PastImages:
    """An episode's recent images, as far back as a memory reads past views; prepared only when they
    are read.
    """

    def __init__(self, spec: PastViewSpec) -> None:
        self.spec = spec
        self._frames: dict[int, list[np.ndarray]] = {}

    def take(self, views: Mapping[str, FrameBatch], first: int, stop: int) -> None:
        """Add the frames `first` … `stop` − 1 of every camera, the next ones of the episode."""
        oldest = stop - 1 - self.spec.span
        for frame in range(max(oldest, first), stop):
            images = [view.image(frame - first) for view in views.values()]
            rendered = [image.copy() for image in images if image is not None]
            if len(rendered) == len(views):
                self._frames[frame] = rendered
        self._frames = {frame: images for frame, images in self._frames.items() if frame >= oldest}

    def at(self, step: int, prepare: Prepare) -> PastViews:
        """Past views of a step, unbatched: `images` [k, v, 3, s, s] uint8 and `mask` [k]."""
        return past_views(self.spec, step, self._read, prepare)

    def _read(self, frames: np.ndarray) -> list[np.ndarray]:
        lacking = [frame for frame in frames.tolist() if frame not in self._frames]
        if lacking:
            raise UserError(
                f"This policy looks back at the frames {lacking[:5]}, which were not rendered by"
                " every camera: observe all images of the frames in `frames_read`."
            )
        stored = [self._frames[frame] for frame in frames.tolist()]
        return [np.stack(of_camera) for of_camera in zip(*stored, strict=True)]


def past_views(
    spec: PastViewSpec,
    step: int,
    read: Callable[[np.ndarray], Sequence[np.ndarray]],
    prepare: Prepare,
) -> PastViews:
    """Past views of a step, unbatched; where there is no such frame yet, masked black images.

    Args:
        read: frames [n], ascending, at least one → images [n, H, W, 3] of every camera.
    """
    requested = spec.at(step)
    exists = requested >= 0
    mask = torch.from_numpy(exists)
    if exists.any():
        prepared = prepare(read(requested[exists]))
        images = prepared.new_zeros(len(requested), *prepared.shape[1:])
        images[mask] = prepared
    else:  # the current frame gives the size of the images
        prepared = prepare(read(np.array([step])))
        images = prepared.new_zeros(len(requested), *prepared.shape[1:])
    return PastViews(images, mask, spec.every)


def stack_past(items: Sequence[PastViews | None]) -> PastViews | None:
    """Unbatched past views as those of a batch; None where there are none."""
    images, masks = [], []
    every = 0
    for item in items:
        if item is not None:
            images.append(item.images)
            masks.append(item.mask)
            every = item.every
    if not images:
        return None
    return PastViews(torch.stack(images), torch.stack(masks), every)


def full_past(
    spec: PastViewSpec | None, views: int, size: int, device: torch.device | str
) -> PastViews | None:
    """Past views of a batch of one, all there and without content."""
    if spec is None:
        return None
    count = spec.frames - 1
    images = torch.zeros(1, count, views, 3, size, size, dtype=torch.uint8, device=device)
    mask = torch.ones(1, count, dtype=torch.bool, device=device)
    return PastViews(images, mask, spec.every)


CROP = 0.95  # side of the crop, rounded down to whole pixels: 212 of 224
ROTATION = math.radians(5)
JITTER_PROBABILITY = 0.5
BRIGHTNESS, CONTRAST, HUE = 0.3, 0.4, 0.1
# random numbers a sample: place of the crop (2), angle, brightness, contrast, hue, whether it is
# coloured
NUMBERS = 7


def augmentation_draws(count: int, generator: torch.Generator | None = None) -> Tensor:
    """The random numbers of `count` samples, uniform [count, 7] on the CPU: none depends on which
    cameras there are.
    """
    return torch.rand(count, NUMBERS, generator=generator)


@torch.no_grad()
def augment_views(images: Tensor, augmentations: Sequence[str], draws: Tensor) -> Tensor:
    """Augment a batch of current observations on the device they are on, without waiting for it.

    All views of one sample share their random numbers, as released.

    Args:
        images: [b, v, 3, s, s] float in [-1, 1].
        augmentations: what is done to each of the v views: `all`, `colour` (neither cropped nor
            rotated) or `none`.
        draws: [b, 7] as `augmentation_draws` makes them, on that device.

    Returns:
        [b, v, 3, s, s] float32 in [-1, 1].
    """
    if images.ndim != 5 or images.shape[2] != 3 or images.shape[-1] != images.shape[-2]:
        raise UserError(f"Expected square images [b, v, 3, s, s], got {list(images.shape)}.")
    if images.shape[1] != len(augmentations):
        raise UserError(
            f"Got {images.shape[1]} views but {len(augmentations)} cameras are described."
        )
    symmetric = draws[:, :6] * 2 - 1
    offset = symmetric[:, :2]
    angle = symmetric[:, 2] * ROTATION
    brightness = symmetric[:, 3] * BRIGHTNESS
    contrast = symmetric[:, 4] * CONTRAST
    hue = symmetric[:, 5] * HUE
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
        offset: [b, 2] in [-1, 1]; where the crop lies between its extreme places, (x, y),
            sub-pixel.
        angle: [b] radians.
    """
    batch, views, _, size, _ = pixels.shape
    scale = int(CROP * size) / size
    cos, sin = scale * angle.cos(), scale * angle.sin()
    shift = (1 - scale) * offset
    first_row = torch.stack([cos, -sin, shift[:, 0]], 1)
    second_row = torch.stack([sin, cos, shift[:, 1]], 1)
    rows = torch.stack([first_row, second_row], 1)
    grid = functional.affine_grid(rows, [batch, 1, size, size], align_corners=False)
    # the views of a sample move together: as channels they share one grid
    stacked = pixels.flatten(1, 2)
    warped = functional.grid_sample(
        stacked, grid, mode="bilinear", padding_mode="zeros", align_corners=False
    )
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
    value = torch.where(
        brightness < 0, value * (1 + brightness), value * (1 - brightness) + brightness
    )
    # A line of slope k through the middle, continued by lines of slope 1/k that end in black and in
    # white.
    k = torch.tan((contrast + 1) * (math.pi / 4))
    knee = k / (2 * (1 + k))
    middle = k * (value - 0.5) + 0.5
    bright = torch.where(value > 1 - knee, (value - 1) / k + 1, middle)
    value = torch.where(value < knee, value / k, bright)
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
