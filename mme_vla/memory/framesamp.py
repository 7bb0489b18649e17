"""FrameSamp: whole frames, evenly spaced over video and execution alike (paper, section 4.2)."""

from typing import Any

import numpy as np

from mme_vla.memory.base import FrameMemory, PerceptualMemory
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.sizes import LEAST_FRAMES, budget_frames
from mme_vla.registry import MEMORIES


def evenly_spaced_frames(last: int, count: int) -> np.ndarray:
    """Numbers 0 … `last`: all of them while they fit in `count`, else `count` evenly spaced ones,
    both ends included. With a `count` of 1 the last.
    """
    if last < count:
        return np.arange(last + 1)
    if count == 1:
        return np.array([last])
    return np.linspace(0, last, count).astype(np.int64)


def evenly_spaced_stored_frames(storage: StorageSpec, step: int, count: int) -> np.ndarray:
    """At most `count` of the stored frames up to `step`, evenly spaced among them, both ends
    included.
    """
    stored = storage.stored_frames(step + 1)
    return stored[evenly_spaced_frames(len(stored) - 1, count)]


@MEMORIES.register("framesamp")
class FrameSamp(FrameMemory, PerceptualMemory):
    """budget / grid² frames of grid×grid tokens each: 32 frames of 16 tokens as released."""

    lazy = False  # along an episode most frames are selected

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 512,
        grid: int = 4,
        pooling: str = "mean",
        every: int = 1,
        **encoder: Any,
    ):
        """See `PerceptualMemory`; `grid` is the side of a remembered frame's token grid.

        Args:
            every: frames 0 and k·every − 1 can be remembered; the others are neither rendered nor
                encoded. 1: all.
        """
        frames = budget_frames(budget, grid, LEAST_FRAMES["framesamp"])
        super().__init__(d_vision, width, budget, StorageSpec(grid, pooling, every), **encoder)
        self.frames = frames

    def selected_frames(self, step: int, exec_start: int = 0) -> np.ndarray:
        """The frames remembered at `step`: evenly spaced among those that are stored, wherever the
        execution starts.
        """
        return evenly_spaced_stored_frames(self.storage, step, self.frames)
