"""Histories that answer otherwise: of fewer frames, or with other contents. A memory cannot tell them apart."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from mme_vla.memory.history import FrameScores, History

Place = tuple[History, int]
"""A frame of a history."""


class OnlyFrames(History):
    """A history in which some stored frames follow one another as if there had been no others.

    What the memory then chooses is a choice among these; `frames` says which frame each of its numbers stands for.
    """

    def __init__(self, whole: History, frames: np.ndarray) -> None:
        """Take the stored frames `frames` [m], ascending, at least one; the last stands for the current one."""
        every = whole.spec.keep_every
        self._length = len(frames) if every == 1 else max((len(frames) - 1) * every, 1)
        self._kept = whole.spec.kept_frames(self._length)
        self.frames = dict(zip(self._kept.tolist(), frames.tolist(), strict=True))
        earlier = int((frames < whole.exec_start).sum())
        super().__init__(whole.spec, int(self._kept[earlier]) if earlier < len(frames) else self._length)
        self._whole = whole

    def __len__(self) -> int:
        return self._length

    @property
    def scores(self) -> FrameScores:
        rows = {frame: i for i, frame in enumerate(self._whole.scores.frames.tolist())}
        # The first frame is remembered whatever its score, as that of an episode is.
        found = [(mine, rows[its]) for mine, its in self.frames.items() if mine and its in rows]
        values = self._whole.scores.values[[row for _, row in found]]
        return FrameScores(np.array([mine for mine, _ in found], np.int64), values)

    def gather(self, indices: np.ndarray) -> Tensor:
        its = np.array([self.frames[frame] for frame in indices[:, 0].tolist()], np.int64)
        return self._whole.gather(np.stack([its, indices[:, 1]], axis=1))


class Exchanged(History):
    """A history whose frames hold what other frames held, of this episode or another."""

    def __init__(self, whole: History, places: Mapping[int, Place]) -> None:
        super().__init__(whole.spec, whole.exec_start)
        self._whole, self._places = whole, places

    def __len__(self) -> int:
        return len(self._whole)

    @property
    def scores(self) -> FrameScores:
        return self._whole.scores

    def gather(self, indices: np.ndarray) -> Tensor:
        parts = []
        for frame, patch in indices.tolist():
            history, its = self._places.get(frame, (self._whole, frame))
            parts.append((history, [its, patch]))
        rows: list[Tensor | None] = [None] * len(parts)
        for history in dict.fromkeys(history for history, _ in parts):
            at = [i for i, (source, _) in enumerate(parts) if source is history]
            tokens = history.gather(np.array([parts[i][1] for i in at], np.int64))
            for i, row in zip(at, tokens, strict=True):
                rows[i] = row
        found = [row for row in rows if row is not None]
        return torch.stack(found) if found else self._whole.gather(indices)
