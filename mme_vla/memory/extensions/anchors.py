"""Anchors: the first frame and the last ones, the floor that a memory has to exceed.

After the anchors of EventVLA, which keeps frame 0 and two frames of the last second beside its
keyframes. It does not decide what to write, so memories that do are compared with it.
"""

from typing import Any

import numpy as np

from mme_vla.errors import check_sizes
from mme_vla.memory.base import FrameMemory, PerceptualMemory
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import check_every, recurrent_frames
from mme_vla.memory.sizes import LEAST_FRAMES, budget_frames
from mme_vla.registry import MEMORIES


@MEMORIES.register("anchors")
class Anchors(FrameMemory, PerceptualMemory):
    """The first frame, and `budget / grid² − 1` frames back from the current one."""

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 48,
        *,
        grid: int = 4,
        pooling: str = "mean",
        spacing: int = 1,
        every: int = 1,
        **encoder: Any,
    ) -> None:
        """See `PerceptualMemory`.

        Args:
            budget: memory tokens; 48 hold the first frame and the last two.
            grid, pooling: a frame is grid×grid tokens.
            spacing, every: frames between two of the last ones, of which the current frame is one,
                and how they are counted (`recurrent_frames`).
        """
        check_sizes("memory", spacing=spacing)
        check_every(every, spacing, "spacing")
        frames = budget_frames(budget, grid, LEAST_FRAMES["anchors"])
        super().__init__(d_vision, width, budget, StorageSpec(grid, pooling), **encoder)
        self.recent = frames - 1
        self.spacing = spacing
        self.every = every

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        """Frame 0 and the last ones, ascending."""
        recent = recurrent_frames(step, 0, self.recent, stride=self.spacing, every=self.every)
        return np.union1d([0], recent)
