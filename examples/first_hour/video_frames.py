"""A memory of one's own: frames of the conditioning video alone, evenly spaced."""

from collections.abc import Sequence

import numpy as np

from mme_vla import History, PerceptualMemory, StorageSpec, register
from mme_vla.memory.base import all_patches


@register("memory", "video_frames")
class VideoFrames(PerceptualMemory):
    """budget / grid² frames of the video. What happens later is not stored."""

    def __init__(self, d_vision: int, width: int, budget: int = 4, grid: int = 1) -> None:
        super().__init__(d_vision, width, budget, StorageSpec(grid))
        self.frames = budget // grid**2

    def frames_at(self, step: int, exec_start: int) -> np.ndarray:
        last = min(step, max(exec_start - 1, 0))
        return np.unique(np.linspace(0, last, self.frames).astype(np.int64))

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        return all_patches(self.frames_at(step, history.exec_start), self.storage.grid)

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return np.unique(np.concatenate([self.frames_at(int(step), exec_start) for step in steps]))
