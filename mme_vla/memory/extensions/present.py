"""Present: the current frame's tokens alone, as if they were memory.

A control: a policy with it has the parameters and the updates of one with a memory, and no past.
"""

from typing import Any

import numpy as np

from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import FrameMemory, PerceptualMemory
from mme_vla.memory.history import StorageSpec
from mme_vla.registry import MEMORIES


@MEMORIES.register("present")
class Present(FrameMemory, PerceptualMemory):
    """grid² tokens of the current frame."""

    def __init__(
        self,
        d_vision: int,
        width: int,
        grid: int = 4,
        pooling: str = "mean",
        budget: int | None = None,
        **encoder: Any,
    ) -> None:
        """See `PerceptualMemory`.

        Args:
            grid, pooling: the current frame is grid×grid tokens.
            budget: maximum number of memory tokens, at least grid²; None for grid².
        """
        check_sizes("memory", grid=grid)
        is_enough = budget is None or budget >= grid**2
        require(
            is_enough,
            f"memory.budget={budget} does not hold the {grid}×{grid} tokens of a frame: {grid**2}.",
        )
        super().__init__(d_vision, width, grid**2, StorageSpec(grid, pooling), **encoder)

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        return np.array([step])
