"""Memories that read whole frames, chosen by where the episode stands alone."""

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from mme_vla.memory.base import Memory, every_one, whole_frames
from mme_vla.memory.history import History


class WholeFrames(Memory):
    """A subclass says which frames; all tokens of these are selected, and as many as there are."""

    @abstractmethod
    def chosen(self, step: int, exec_start: int) -> np.ndarray:
        """The frames that are read at `step` of an episode whose execution begins at `exec_start`; int64, ascending."""

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return every_one([self.chosen(int(step), exec_start) for step in steps])

    def select(self, history: History, step: int, rng: np.random.Generator | None = None) -> np.ndarray:
        return whole_frames(self.chosen(step, history.exec_start), self.storage.grid)

    def padded_length(self, count: int) -> int:
        return count
