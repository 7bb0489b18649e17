"""Images as OpenVLA's family sees them: Lanczos-3 on uint8, a crop of 90 % of the area, four
changes of colour.
"""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.config.sections import read_section, without
from mme_vla.errors import require
from mme_vla.processing.base import Sample, SampleSpec, StatsSpec
from mme_vla.processing.images import as_uint8_frames, hsv_to_rgb, rgb_to_hsv
from mme_vla.processing.processor import Processor
from mme_vla.registry import PROCESSORS
from mme_vla.types import Batch, to_unit_range

EPSILON = 1e-8


@dataclass(frozen=True)
class ClippedQuantiles:
    """Maps [q01, q99] to [−1, 1] and clips; a number that never moved becomes 0.

    low, high: the quantiles [d].
    scaled: [d] bool; the others pass as they are.
    still: [d] bool; never moved.
    """

    low: np.ndarray
    high: np.ndarray
    scaled: np.ndarray
    still: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    @classmethod
    def of(cls, stats: Any, scaled: np.ndarray | None = None) -> Self:
        """Of statistics with `q01` and `q99` [d], and `min` and `max` where they were kept.

        scaled: which numbers are scaled; by default all.
        """
        low, high = np.asarray(stats.q01, np.float64), np.asarray(stats.q99, np.float64)
        least, most = getattr(stats, "min", None), getattr(stats, "max", None)
        if least is None or most is None:
            least, most = low, high
        every = np.ones(len(low), bool) if scaled is None else np.asarray(scaled, bool)
        return cls(low, high, every, np.asarray(least) == np.asarray(most))

    def normalize(self, x: Tensor) -> Tensor:
        """Scale x [..., d]: clip(2 (x − q01) / (q99 − q01 + ε) − 1, ±1), and 0 where nothing ever
        moved.
        """
        low, span, scaled, still = self._on(x)
        y = (2 * (x - low) / span - 1).clamp(-1, 1)
        return torch.where(scaled, torch.where(still, torch.zeros_like(y), y), x)

    def unnormalize(self, y: Tensor) -> Tensor:
        """Scale y [..., d] back: ½ (y + 1) (q99 − q01 + ε) + q01; nothing is clipped."""
        low, span, scaled, _ = self._on(y)
        return torch.where(scaled, (y + 1) / 2 * span + low, y)

    def _on(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        require(
            x.is_floating_point() and x.shape[-1] == len(self.low),
            f"Statistics of {len(self.low)} numbers do not fit values {x.dtype} of shape"
            f" {list(x.shape)}.",
        )
        still = self.still if len(self.still) else np.zeros(len(self.low), bool)
        return (
            x.new_tensor(self.low),
            x.new_tensor(self.high - self.low + EPSILON),
            torch.from_numpy(self.scaled).to(x.device),
            torch.from_numpy(still).to(x.device),
        )


SIDE = math.sqrt(0.9)  # of the crop, as a fraction of the image's
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
    """What each of `size` places takes of each of `length` ones: [size, length] float32, rows add
    up to 1.
    """
    scale = length / size
    widened = max(scale, 1.0)
    centres = (np.arange(size) + 0.5) * scale
    x = (np.arange(length) + 0.5 - centres[:, None]) / widened
    weights = np.where(np.abs(x) < RADIUS, np.sinc(x) * np.sinc(x / RADIUS), 0.0)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def jpeg_round_trip(frames: np.ndarray) -> np.ndarray:
    """Write images [..., H, W, 3] uint8 as JPEG of quality 95 and read them again."""
    from PIL import Image

    out = np.empty_like(frames)
    for index in np.ndindex(frames.shape[:-3]):
        file = io.BytesIO()
        Image.fromarray(frames[index]).save(file, "JPEG", quality=JPEG_QUALITY)
        out[index] = np.asarray(Image.open(file))
    return out


def crop(pixels: Tensor, top: Tensor, left: Tensor) -> Tensor:
    """Cut a square of 90 % of the area and resize it back, bilinear, corner on corner, without
    antialiasing.

    Args:
        pixels: [n, 3, s, s].
        top, left: [n] fractions of the image, in [0, 1 − √0.9].

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
    """What test time shows of images [..., 3, s, s] uint8: the middle 90 % of the area, resized
    back; uint8.
    """
    flat = images.flatten(0, -4)
    middle = torch.full((len(flat),), (1 - SIDE) / 2, device=images.device, dtype=torch.float64)
    return quantised(crop(flat.float() / 255, middle, middle).clamp(0, 1)).view(images.shape)


def centre_cut(images: Tensor) -> Tensor:
    """As `centre_crop`, but of whole pixels and resized back with Lanczos-3: how MemoryVLA shows
    images.
    """
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


def draw_changes(
    count: int, generator: torch.Generator | None = None, device: torch.device | None = None
) -> Tensor:
    """Draws of `count` images [n, 6], made on the CPU: top, left, brightness, contrast, saturation,
    hue.
    """
    u = torch.rand(count, 6, generator=generator)
    low = torch.tensor([0, 0, -BRIGHTNESS, CONTRAST[0], SATURATION[0], -HUE])
    high = torch.tensor([1 - SIDE, 1 - SIDE, BRIGHTNESS, CONTRAST[1], SATURATION[1], HUE])
    return (low + (high - low) * u).to(device)


def augment(images: Tensor, draws: Tensor) -> Tensor:
    """Crop and change the colours of images, each by its own draws.

    Args:
        images: [n, 3, s, s] uint8.
        draws: [n, 6] as `draw_changes` makes them.

    Returns:
        [n, 3, s, s] uint8.
    """
    top, left, *colours = draws.to(images.device).unbind(1)
    pixels = crop(images.float() / 255, top, left).clamp(0, 1)
    for change, by in zip((brighten, contrast, saturate, shift_hue), colours, strict=True):
        pixels = change(pixels, by[:, None, None, None].float()).clamp(0, 1)
    return quantised(pixels)


def brighten(pixels: Tensor, by: Tensor) -> Tensor:
    return pixels + by


def contrast(pixels: Tensor, by: Tensor) -> Tensor:
    """Stretch about the image's mean of each colour."""
    mean = pixels.mean((-2, -1), keepdim=True)
    return (pixels - mean) * by + mean


def saturate(pixels: Tensor, by: Tensor) -> Tensor:
    """Multiply the saturation."""
    hue, saturation, value = rgb_to_hsv(pixels[:, None])
    return hsv_to_rgb(hue, (saturation * by.squeeze(-1)).clamp(0, 1), value)[:, 0]


def shift_hue(pixels: Tensor, by: Tensor) -> Tensor:
    """Turn the hue, in turns of the circle."""
    hue, saturation, value = rgb_to_hsv(pixels[:, None])
    return hsv_to_rgb((hue + by.squeeze(-1)) % 1, saturation, value)[:, 0]


@dataclass(frozen=True)
class OpenVlaProcessorSettings:
    """Settings of an `OpenVlaProcessor` beside those of `Processor`."""

    jpeg: bool = False


@PROCESSORS.register("openvla")
class OpenVlaProcessor(Processor):
    """Lanczos-3 images, Llama's words, clipped quantiles of raw numbers, and the state for the
    network.
    """

    stats_spec = StatsSpec(horizon=1, every=True, extremes=True, exact=True)
    samples = SampleSpec(full_chunks_only=True)
    jpeg: bool = False
    """Write every image as JPEG and read it again before it is resized, as the original's data
    were.
    """

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """As `Processor.from_config`, with `jpeg` beside the other settings."""
        settings = read_section(OpenVlaProcessorSettings, config, "processor", others=True)
        built = super().from_config(without(config, "name", "jpeg"))
        require(
            built.embodiment.action.width == built.action_dim,
            f"backbone.action_dim={built.action_dim}: this network's actions are as wide as the"
            f" robot's, {built.embodiment.action.width}.",
        )
        built.jpeg = settings.jpeg
        return built

    # Images

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """As `Processor.images`, resized with Lanczos-3; a crop or an augmentation is
        the policy's.
        """
        return super().images([self._resized(as_uint8_frames(view)) for view in views])

    def memory_images(
        self, frames: np.ndarray | Tensor, device: torch.device | str | None = None
    ) -> Tensor:
        """As `Processor.memory_images`, resized with Lanczos-3; neither cropped nor augmented."""
        if isinstance(frames, Tensor):
            frames = frames.cpu().numpy()
        resized = np.require(self._resized(frames), requirements=["C", "W"])
        images = torch.from_numpy(resized).to(device)
        return to_unit_range(images).movedim(-1, 1)

    @property
    def memory_image_format(self) -> str:
        """Whether they are JPEG in between."""
        return "jpeg" if self.jpeg else ""

    def _resized(self, frames: np.ndarray) -> np.ndarray:
        if self.jpeg:
            frames = jpeg_round_trip(frames)
        return lanczos(frames, self.image_size)

    # Words

    def prompt(self, *args: Any, **named: Any) -> tuple[Tensor, Tensor]:
        """As `Processor.prompt`, closed by the piece `▁`, whose state predicts the first number of
        the chunk.
        """
        ids, mask = super().prompt(*args, **named)
        place = min(int(mask.sum()), len(ids) - 1)
        ids[place], mask[place] = self.tokenizer.piece("▁"), True
        return ids, mask

    # Numbers

    def proprio(self, state: np.ndarray | Tensor) -> Tensor:
        """Raw states [..., s], normalised and clipped, for the network to read."""
        stats = self.require_stats().state
        return ClippedQuantiles.of(stats).normalize(torch.as_tensor(state, dtype=torch.float32))

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        """As `Processor.actions`, clipped."""
        raw = torch.as_tensor(chunk, dtype=torch.float32)
        at = torch.as_tensor(state, dtype=torch.float32)
        relative = self.embodiment.action.to_relative(raw, at)
        return ClippedQuantiles.of(self.require_stats().actions).normalize(relative)

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        raw = ClippedQuantiles.of(self.require_stats().actions).unnormalize(chunk.float())
        return self.embodiment.action.to_absolute(raw, state.to(raw))

    # Batches

    def item(self, sample: Sample) -> dict[str, Any]:
        """As `Processor.item`, with the normalised state `proprio` [s]."""
        return super().item(sample) | {"proprio": self.proprio(sample.states[-1])}

    def collate(self, items: Sequence[dict[str, Any]]) -> Batch:
        return replace(
            super().collate(items), proprio=torch.stack([item["proprio"] for item in items])
        )

    def to_config(self) -> dict[str, Any]:
        return {"name": "openvla", **super().to_config(), "jpeg": self.jpeg}
