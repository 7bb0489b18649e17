"""Images between camera and vision tower: two resize paths, as released.

The current observation goes through Pillow on uint8; memory frames go through an antialiased float resize.
The two differ by rounding only, yet the released weights were trained with exactly this pair.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.errors import UserError
from mme_vla.memory.base import PastViewSpec
from mme_vla.types import PastViews


def resize_with_pad_uint8(frames: np.ndarray, size: tuple[int, int] | int) -> np.ndarray:
    """Resize with Pillow's bilinear filter, keeping the aspect ratio, on a black canvas: the path of current views.

    Args:
        frames: [..., H, W, 3] uint8.
        size: (h, w), or one number for a square.

    Returns:
        [..., h, w, 3] uint8; `frames` itself when they have this size already.
    """
    from PIL import Image

    if frames.dtype != np.uint8 or frames.ndim < 3 or frames.shape[-1] != 3:
        raise UserError(f"Expected uint8 images [..., height, width, 3], got {frames.dtype} {list(frames.shape)}.")
    height, width = _pair(size)
    if frames.shape[-3:-1] == (height, width):
        return frames
    inner_h, inner_w, top, left = _fit(frames.shape[-3], frames.shape[-2], height, width)
    canvas = np.zeros((*frames.shape[:-3], height, width, 3), np.uint8)
    for index in np.ndindex(frames.shape[:-3]):
        resized = Image.fromarray(frames[index]).resize((inner_w, inner_h), Image.Resampling.BILINEAR)
        canvas[index][top : top + inner_h, left : left + inner_w] = np.asarray(resized)
    return canvas


def resize_with_pad(images: Tensor, size: tuple[int, int] | int) -> Tensor:
    """Resize with an antialiased bilinear filter, keeping the aspect ratio: the path of memory frames.

    Args:
        images: [n, H, W, 3], uint8 or float in [-1, 1].
        size: (h, w), or one number for a square.

    Returns:
        [n, 3, h, w] float32 in [-1, 1], on the device of `images`.
    """
    if images.ndim != 4 or images.shape[-1] != 3:
        raise UserError(f"Expected images [n, height, width, 3], got {list(images.shape)}.")
    if images.dtype != torch.uint8 and not images.is_floating_point():
        raise UserError(f"Expected images as uint8, or as float in [-1, 1]; got {images.dtype}.")
    height, width = _pair(size)
    channels_first = images.movedim(-1, 1)
    source = to_unit_range(channels_first) if images.dtype == torch.uint8 else channels_first.float()
    if source.shape[-2:] == (height, width):
        return source.contiguous()
    inner_h, inner_w, top, left = _fit(source.shape[-2], source.shape[-1], height, width)
    resized = functional.interpolate(source, (inner_h, inner_w), mode="bilinear", antialias=True, align_corners=False)
    borders = (left, width - inner_w - left, top, height - inner_h - top)
    return functional.pad(resized.clamp(-1, 1), borders, value=-1.0)


def to_unit_range(images: Tensor) -> Tensor:
    """Map uint8 0…255 to float32 -1…1."""
    # In place: the images of an episode are large, and each step would take as much memory again.
    return images.to(torch.float32, copy=True).div_(255).mul_(2).sub_(1)


def as_uint8_frames(image: np.ndarray | Tensor) -> np.ndarray:
    """Bring one image, or a stack of them, into the form the resize expects: uint8, channels last.

    Accepts uint8, or float in [0, 1] (mapped by truncating 255·x, as released), with the channels last or first.
    """
    array = image.detach().cpu().numpy() if isinstance(image, Tensor) else np.asarray(image)
    if array.ndim not in (3, 4):
        raise UserError(f"Expected an image [H, W, 3] or a stack [n, H, W, 3], got shape {list(array.shape)}.")
    if array.shape[-1] != 3 and array.shape[-3] == 3:
        array = np.moveaxis(array, -3, -1)
    if array.shape[-1] != 3:
        raise UserError(f"Expected RGB images (three channels first or last), got shape {list(array.shape)}.")
    if np.issubdtype(array.dtype, np.floating):
        if array.size and not (array.min() >= 0 and array.max() <= 1):
            raise UserError(
                f"Float images must lie in [0, 1], got values from {array.min():g} to {array.max():g}; "
                "give uint8 images or divide by 255."
            )
        return (255 * array).astype(np.uint8)
    if array.dtype != np.uint8:
        raise UserError(f"Expected images as uint8, or as float in [0, 1]; got {array.dtype}.")
    return array


def _pair(size: tuple[int, int] | int) -> tuple[int, int]:
    return (size, size) if isinstance(size, int) else size


def _fit(source_h: int, source_w: int, height: int, width: int) -> tuple[int, int, int, int]:
    """Say how large the image becomes inside (height, width) and where it sits: (h, w, top, left)."""
    ratio = max(source_w / width, source_h / height)
    inner_h, inner_w = int(source_h / ratio), int(source_w / ratio)
    return inner_h, inner_w, (height - inner_h) // 2, (width - inner_w) // 2


Prepare = Callable[[Sequence[np.ndarray]], Tensor]
"""Images [n, H, W, 3] uint8 of every camera in the embodiment's order → [n, v, 3, s, s] uint8."""


class PastImages:
    """Holds an episode's images as they came, as far back as is looked; they are prepared when they are asked for.

    Which of them are looked at is known only when the policy acts, and preparing one costs more than keeping it.
    """

    def __init__(self, spec: PastViewSpec) -> None:
        self.spec = spec
        self._frames: dict[int, list[np.ndarray]] = {}
        self._count = 0

    def take(self, views: Mapping[str, np.ndarray], count: int, rendered: Mapping[str, np.ndarray] | None) -> None:
        """Add the next `count` frames of every camera; `rendered` as in `Episode.observe`."""
        first, self._count = self._count, self._count + count
        oldest = self._count - 1 - self.spec.span
        for frame in range(max(oldest, first), self._count):
            places = [_place(frame - first, None if rendered is None else rendered[name]) for name in views]
            if all(place is not None for place in places):
                pairs = zip(views.values(), places, strict=True)
                self._frames[frame] = [view[place].copy() for view, place in pairs if place is not None]
        self._frames = {frame: images for frame, images in self._frames.items() if frame >= oldest}

    def at(self, step: int, prepare: Prepare) -> PastViews:
        """Past views of a step, unbatched: `images` [k, v, 3, s, s] uint8 and `mask` [k]."""
        return past_views(self.spec, step, self._read, prepare)

    def _read(self, frames: np.ndarray) -> list[np.ndarray]:
        lacking = [frame for frame in frames.tolist() if frame not in self._frames]
        if lacking:
            raise UserError(
                f"This policy looks back at the frames {lacking[:5]}, which were not drawn of every camera: what "
                "`frames_read` names has to be observed with all images."
            )
        stored = [self._frames[frame] for frame in frames.tolist()]
        return [np.stack(of_camera) for of_camera in zip(*stored, strict=True)]


def past_views(
    spec: PastViewSpec, step: int, read: Callable[[np.ndarray], Sequence[np.ndarray]], prepare: Prepare
) -> PastViews:
    """Past views of a step, unbatched; where there is no such frame yet, black images that nobody sees.

    Args:
        read: frames [n], ascending, at least one → images [n, H, W, 3] of every camera.
    """
    requested = spec.at(step)
    there = requested >= 0
    # The current frame goes along where there is no other: it says how large images are.
    frames = requested[there] if there.any() else np.array([step])
    prepared = prepare(read(frames))
    images = prepared.new_zeros(len(requested), *prepared.shape[1:])
    if there.any():
        images[torch.from_numpy(there)] = prepared
    return PastViews(images, torch.from_numpy(there), spec.every)


def stack_past(items: Sequence[PastViews | None]) -> PastViews | None:
    """Unbatched past views as those of a batch; None where there are none."""
    present = [item for item in items if item is not None]
    if not present:
        return None
    return PastViews(
        torch.stack([item.images for item in present]), torch.stack([item.mask for item in present]), present[0].every
    )


def full_past(spec: PastViewSpec | None, views: int, size: int, device: torch.device | str) -> PastViews | None:
    """Past views of a batch of one, all there and without content."""
    if spec is None:
        return None
    images = torch.zeros(1, spec.frames - 1, views, 3, size, size, dtype=torch.uint8, device=device)
    return PastViews(images, torch.ones(images.shape[:2], dtype=torch.bool, device=device), spec.every)


def _place(offset: int, rendered: np.ndarray | None) -> int | None:
    if rendered is None:
        return offset
    at = int(np.searchsorted(rendered, offset))
    return at if at < len(rendered) and int(rendered[at]) == offset else None
