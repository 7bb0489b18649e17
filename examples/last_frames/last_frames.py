"""A memory of one's own: the most recent frames, `spacing` steps apart."""

import numpy as np

from mme_vla.memory.history import History, StorageSpec
from mme_vla.memory.perceptual import PerceptualMemory
from mme_vla.registry import MEMORIES


@MEMORIES.register("last_frames")
class LastFrames(PerceptualMemory):
    """budget / grid² frames back from the current one."""

    def __init__(self, d_vision: int, width: int, budget: int = 512, grid: int = 4, spacing: int = 2) -> None:
        super().__init__(d_vision, width, budget, StorageSpec(grid))
        self.frames, self.spacing = budget // grid**2, spacing

    def select(self, history: History, step: int, rng: np.random.Generator | None = None) -> np.ndarray:
        frames = np.arange(step, -1, -self.spacing)[: self.frames][::-1]
        patches = np.arange(self.storage.grid**2)
        return np.stack(np.meshgrid(frames, patches, indexing="ij"), axis=-1).reshape(-1, 2)
