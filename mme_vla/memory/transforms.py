"""Transforms of a history: which frames a policy learns from, and which times they have.

A transform sets how often each frame of an episode is observed. In training a dataset applies it to
everything that a sample reads of the past (`data.history_transforms`), and a probe applies the same
object to a running episode.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, ClassVar, cast

import numpy as np
import torch
from torch import Tensor

from mme_vla.config.sections import NonNegative, NonNegativeInt, Range, read_section
from mme_vla.errors import require
from mme_vla.memory.history import FrameScores, History
from mme_vla.registry import HISTORY_TRANSFORMS

Share = Annotated[float, Range(0.0, 1.0)]


class HistoryTransform:
    """Changes nothing. A subclass overrides what it changes; a dataclass, so that its options are
    its fields.

    dial: the option that a probe sets by `name:value`. drops: whether it may leave frames out.
    """

    dial: ClassVar[str | None] = None
    drops: ClassVar[bool] = False

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """How often each of the first `length` frames is observed, int64 [length]; 0 leaves one
        out.

        Args:
            exec_start: the first execution frame, video included.
            rng: randomness for training; None for the reproducible choice that a probe makes, in
                which a frame's number depends on no later frame.
        """
        return np.ones(length, np.int64)

    def perturb(self, rows: Tensor, rng: np.random.Generator | None = None) -> Tensor:
        """Change tokens [n, d] of past frames, or their proprioception and actions, as they are
        read.
        """
        return rows


@HISTORY_TRANSFORMS.register("repeat_frame")
@dataclass(frozen=True)
class RepeatFrame(HistoryTransform):
    """One frame is repeated `frames` times more, as if the robot had paused.

    at: which, from the first execution frame on; None: any frame in training, the first of the
    execution in a probe. p: share of the samples that have a pause. In training it has any length
    from one frame to `frames`.
    """

    frames: NonNegativeInt = 64
    at: NonNegativeInt | None = None
    p: Share = 1.0
    dial: ClassVar = "frames"

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        count = self.frames
        frame = exec_start + (self.at or 0)
        if rng is not None:
            has_pause = rng.random() < self.p
            if self.frames:
                count = int(rng.integers(1, self.frames + 1))
            if self.at is None:
                frame = int(rng.integers(length))
            if not has_pause:
                count = 0
        counts = np.ones(length, np.int64)
        if frame < length:
            counts[frame] += count
        return counts


@HISTORY_TRANSFORMS.register("speed")
@dataclass(frozen=True)
class Speed(HistoryTransform):
    """The past seems to be `factor` times as fast; below 1 it is slower. In training by any factor
    between it and 1.
    """

    factor: Annotated[float, Range(1 / 16, 16.0)] = 2.0
    dial: ClassVar = "factor"
    drops: ClassVar = True

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        factor = self.factor if rng is None else self.factor ** rng.random()
        edges = np.floor(np.arange(length + 1) / factor).astype(np.int64)
        return np.diff(edges)


@HISTORY_TRANSFORMS.register("drop_frames")
@dataclass(frozen=True)
class DropFrames(HistoryTransform):
    """A `share` of the frames is lost: at random in training, evenly spaced in a probe."""

    share: Share = 0.25
    dial: ClassVar = "share"
    drops: ClassVar = True

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        if rng is not None:
            return (rng.random(length) >= self.share).astype(np.int64)
        n_dropped = np.floor(np.arange(length + 1) * self.share)  # of the frames before each
        return 1 - np.diff(n_dropped).astype(np.int64)


@HISTORY_TRANSFORMS.register("noise")
@dataclass(frozen=True)
class Noise(HistoryTransform):
    """Gaussian noise on what is read of the past; `std` is in standard deviations of the numbers
    that are read.
    """

    std: NonNegative = 0.1
    dial: ClassVar = "std"

    def perturb(self, rows: Tensor, rng: np.random.Generator | None = None) -> Tensor:
        if rows.numel() < 2:
            return rows
        if rng is None:
            rng = np.random.default_rng(0)
        noise = torch.from_numpy(rng.standard_normal(tuple(rows.shape), np.float32)).to(rows.device)
        return (rows + self.std * rows.float().std() * noise).to(rows.dtype)


def build_transform(entry: Any) -> HistoryTransform:
    """A transform from its name, or from a mapping with `name` and its options."""
    section: Mapping[str, Any] = {"name": entry} if isinstance(entry, str) else entry
    kind: Any = HISTORY_TRANSFORMS[section["name"]]
    if not is_dataclass(kind):
        return cast(HistoryTransform, HISTORY_TRANSFORMS.build(section))
    options = {key: value for key, value in section.items() if key != "name"}
    read: Any = read_section(kind, options, f"history_transforms.{section['name']}")  # type: ignore[arg-type]
    return cast(HistoryTransform, read)


def build_transforms(entries: Any) -> tuple[HistoryTransform, ...]:
    """The transforms that a configuration lists, in the order in which they act."""
    if entries is None:
        return ()
    is_list = isinstance(entries, Sequence) and not isinstance(entries, str)
    require(
        is_list and all(_names_transform(entry) for entry in entries),
        f"history_transforms={entries}: write a list of names or of mappings with a name, such as"
        " [repeat_frame] or [{name: speed, factor: 2}].",
    )
    return tuple(build_transform(entry) for entry in entries)


def _names_transform(entry: Any) -> bool:
    return isinstance(entry, str) or (isinstance(entry, Mapping) and "name" in entry)


@dataclass(frozen=True)
class FrameMap:
    """The one map from the frames of a transformed episode to those that were recorded.

    real: int64 [n], ascending; the recorded frame of each transformed one, up to the current one.
    exec_start: the first transformed frame of the execution. transforms, rng: they made the map,
    and perturb what is read.
    """

    real: np.ndarray
    exec_start: int
    transforms: Sequence[HistoryTransform] = ()
    rng: np.random.Generator | None = None

    def transformed(self, frames: np.ndarray) -> np.ndarray:
        """The last transformed frame that shows each of these recorded ones, or one before it;
        int64, at least 0.
        """
        last = np.searchsorted(self.real, frames, side="right") - 1
        return np.maximum(last, 0)

    def perturb(self, rows: Tensor) -> Tensor:
        """Change rows [n, d] of past frames by all transforms."""
        for transform in self.transforms:
            rows = transform.perturb(rows, self.rng)
        return rows


def map_frames(
    transforms: Sequence[HistoryTransform],
    length: int,
    exec_start: int,
    rng: np.random.Generator | None = None,
    keep: Sequence[int] | np.ndarray = (),
) -> FrameMap:
    """Apply transforms one after the other to the first `length` frames of an episode.

    Args:
        rng: see `HistoryTransform.repeats`. keep: frames that stay whatever the transforms leave
            out: those at which the policy decides.
    """
    real = np.arange(length)
    retained = np.asarray(keep, np.int64)
    for transform in transforms:
        start = int(np.searchsorted(real, exec_start))
        counts = np.array(transform.repeats(len(real), start, rng), np.int64)
        require(
            counts.shape == real.shape and (counts >= 0).all(),
            f"{type(transform).__name__}.repeats returned {counts.shape} numbers, the least"
            f" {counts.min(initial=0)}: it must return one for each of {len(real)} frames, 0 or"
            " more.",
        )
        last = np.searchsorted(real, retained, side="right") - 1
        counts[last] = np.maximum(counts[last], 1)
        real = np.repeat(real, counts)
    return FrameMap(real, int(np.searchsorted(real, exec_start)), transforms, rng)


class TransformedHistory(History):
    """A history as transforms show it. A frame without tokens is replaced by the newest stored one
    before it.
    """

    def __init__(self, source: History, frames: FrameMap) -> None:
        super().__init__(source.spec, frames.exec_start)
        self._source = source
        self._frames = frames
        self.state_width = source.state_width
        if source.motion is not None:
            self.motion = self._motion

    def __len__(self) -> int:
        return len(self._frames.real)

    @property
    def scores(self) -> FrameScores:
        """The scores of the frames that are left, each at the first time it is shown."""
        scores = self._source.scores
        real = self._frames.real
        first = np.searchsorted(real, scores.frames)
        is_left = np.append(real, -1)[first] == scores.frames
        return FrameScores(first[is_left], scores.values[is_left])

    @property
    def stored_frames(self) -> np.ndarray:
        return np.flatnonzero(np.isin(self._frames.real, self._source.stored_frames))

    def gather(self, indices: np.ndarray) -> Tensor:
        stored = self._source.stored_frames
        real = self._frames.real[indices[:, 0]]
        newest = np.maximum(np.searchsorted(stored, real, side="right") - 1, 0)
        tokens = self._source.gather(np.stack([stored[newest], indices[:, 1]], 1))
        return self._frames.perturb(tokens)

    def _motion(self, frames: np.ndarray) -> Tensor:
        return self._frames.perturb(self._source.motion_rows(self._frames.real[frames]))
