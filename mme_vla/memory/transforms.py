"""Recorded episodes as perturbations show them: which frames, at which times.

A perturbation sets how often each frame of an episode is observed (`memory/perturbation.py`). In
training a dataset applies it to everything that a sample reads of the past
(`data.history_transforms`), and a probe applies the same object to a running episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from mme_vla.errors import require
from mme_vla.memory.history import DerivedHistory, FrameScores, History
from mme_vla.memory.perturbation import Perturbation


@dataclass(frozen=True)
class FrameMap:
    """The one map from the frames of an episode as it is shown to those that were recorded.

    Without transforms each frame is itself.

    real: int64 [n], ascending; the recorded frame of each transformed one, up to the current one.
    exec_start: the first transformed frame of the execution.
    transforms, rng: they made the map, and perturb what is read.
    """

    real: np.ndarray
    exec_start: int
    transforms: Sequence[Perturbation] = ()
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
    transforms: Sequence[Perturbation],
    length: int,
    exec_start: int,
    rng: np.random.Generator | None = None,
    keep: Sequence[int] | np.ndarray = (),
) -> FrameMap:
    """Apply transforms one after the other to the first `length` frames of an episode.

    Args:
        rng: see `Perturbation.repeats`.
        keep: frames that stay whatever the transforms leave out: those at which the policy decides.
    """
    real = np.arange(length)
    retained = np.asarray(keep, np.int64)
    for transform in transforms:
        start = int(np.searchsorted(real, exec_start))
        repeats = np.asarray(transform.repeats(len(real), start, rng))
        counts = repeats.astype(np.int64)
        require(
            counts.shape == real.shape and (counts >= 0).all() and (counts == repeats).all(),
            f"{type(transform).__name__}.repeats returned {repeats.shape} numbers, the least"
            f" {repeats.min(initial=0)}: it must return a whole number, 0 or more, for each of"
            f" {len(real)} frames.",
        )
        last = np.searchsorted(real, retained, side="right") - 1
        counts[last] = np.maximum(counts[last], 1)
        real = np.repeat(real, counts)
    return FrameMap(real, int(np.searchsorted(real, exec_start)), transforms, rng)


class TransformedHistory(DerivedHistory):
    """A history as transforms show it. A frame without tokens is replaced by the newest stored one
    before it.
    """

    def __init__(self, source: History, frames: FrameMap) -> None:
        super().__init__(source)
        self.exec_start = frames.exec_start
        self._frames = frames
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
        stored = self._source.newest_stored(self._frames.real[indices[:, 0]])
        tokens = self._source.gather(np.stack([stored, indices[:, 1]], 1))
        return self._frames.perturb(tokens)

    def _motion(self, frames: np.ndarray) -> Tensor:
        return self._frames.perturb(self._source.motion_rows(self._frames.real[frames]))
