"""A memory of one's own: the most recent frames, `spacing` steps apart."""

import numpy as np

from mme_vla import History, PerceptualMemory, StorageSpec, register
from mme_vla.memory.base import all_patches


@register("memory", "last_frames")
class LastFrames(PerceptualMemory):
    """budget / grid² frames back from the current one."""

    def __init__(
        self, d_vision: int, width: int, budget: int = 512, grid: int = 4, spacing: int = 2
    ) -> None:
        super().__init__(d_vision, width, budget, StorageSpec(grid))
        self.frames, self.spacing = budget // grid**2, spacing

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        frames = np.arange(step, -1, -self.spacing)[: self.frames][::-1]
        return all_patches(frames, self.storage.grid)
