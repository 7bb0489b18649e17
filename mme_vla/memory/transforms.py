"""Transforms of a history: which frames a policy learns from, and at which times it takes them to
be.

One object says how often each frame of an episode is observed. In training a dataset applies it to
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
        """Tokens [n, d] of past frames, or what the robot felt and did at them, as
        they are read.
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
        counts = np.ones(length, np.int64)
        count, place = self.frames, exec_start + (self.at or 0)
        if rng is not None:
            selection, count = (
                rng.random() < self.p,
                int(rng.integers(1, self.frames + 1)) if self.frames else 0,
            )
            place = int(rng.integers(length)) if self.at is None else place
            count = count if selection else 0
        if place < length:
            counts[place] += count
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
        return 1 - np.diff(np.floor(np.arange(length + 1) * self.share)).astype(np.int64)


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
        rng = np.random.default_rng(0) if rng is None else rng
        noise = torch.from_numpy(rng.standard_normal(tuple(rows.shape), np.float32)).to(rows.device)
        return (rows + self.std * rows.float().std() * noise).to(rows.dtype)


def build_transform(entry: Any) -> HistoryTransform:
    """A transform from its name, or from a mapping with `name` and its options."""
    section: Mapping[str, Any] = {"name": entry} if isinstance(entry, str) else entry
    kind: Any = HISTORY_TRANSFORMS[section["name"]]
    if not is_dataclass(kind):
        made: HistoryTransform = HISTORY_TRANSFORMS.build(section)
        return made
    options = {key: value for key, value in section.items() if key != "name"}
    read: Any = read_section(kind, options, f"history_transforms.{section['name']}")  # type: ignore[arg-type]
    return cast(HistoryTransform, read)


def build_transforms(entries: Any) -> tuple[HistoryTransform, ...]:
    """The transforms that a configuration lists, in the order in which they act."""
    require(
        entries is None
        or (
            isinstance(entries, Sequence)
            and not isinstance(entries, str)
            and all(isinstance(e, str) or (isinstance(e, Mapping) and "name" in e) for e in entries)
        ),
        f"history_transforms={entries}: write a list of names or of mappings with a name, such as"
        " [repeat_frame] or [{name: speed, factor: 2}].",
    )
    return tuple(build_transform(entry) for entry in entries or ())


@dataclass(frozen=True)
class FrameMap:
    """The one map from the frames of a transformed episode to those that were recorded.

    real: int64 [n], ascending; the recorded frame of each transformed one, up to the current one.
    exec_start: the first transformed frame of the execution. transforms, rng: what made it, and
    perturbs what is read.
    """

    real: np.ndarray
    exec_start: int
    transforms: Sequence[HistoryTransform] = ()
    rng: np.random.Generator | None = None

    def transformed(self, frames: np.ndarray) -> np.ndarray:
        """The last transformed frame that shows each of these recorded ones, or one before it;
        int64, at least 0.
        """
        return np.maximum(np.searchsorted(self.real, frames, side="right") - 1, 0)

    def perturb(self, rows: Tensor) -> Tensor:
        """What is read of the past, as the transforms change it."""
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
    real, retained = np.arange(length), np.asarray(keep, np.int64)
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
        self._source, self._frames = source, frames
        self.state_width = source.state_width
        if source.motion is not None:
            self.motion = self._motion

    def __len__(self) -> int:
        return len(self._frames.real)

    @property
    def scores(self) -> FrameScores:
        """The scores of the frames that are left, each at the first time it is shown."""
        scores, real = self._source.scores, self._frames.real
        at = np.searchsorted(real, scores.frames)
        there = (at < len(real)) & (real[np.minimum(at, len(real) - 1)] == scores.frames)
        return FrameScores(at[there], scores.values[there])

    @property
    def stored_frames(self) -> np.ndarray:
        return np.flatnonzero(np.isin(self._frames.real, self._source.stored_frames))

    def gather(self, indices: np.ndarray) -> Tensor:
        stored = self._source.stored_frames
        real = self._frames.real[indices[:, 0]]
        places = np.maximum(np.searchsorted(stored, real, side="right") - 1, 0)
        return self._frames.perturb(
            self._source.gather(np.stack([stored[places], indices[:, 1]], 1))
        )

    def _motion(self, frames: np.ndarray) -> Tensor:
        return self._frames.perturb(self._source.motion_rows(self._frames.real[frames]))
