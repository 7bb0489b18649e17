"""Pyramid: windows over the past, each with a greater stride than the one after it, and the first
frame (RTP).

After the temporal pyramid of RTP, whose code is not public: 12 frames one apart, then frames four
apart, then eight apart, and an anchor at the reset. The token of a frame has its time, not its
place among the kept ones: frame numbers in the position features, and frames back from now in
attention (`integration.memory_position=time`, as in `configs/model/pyramid_*`). Our own choices are
the strides, and that they count from the episode's first frame. A frame that has been dropped then
never returns, so the memory could be held in a store of this size.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import FrameMemory, PerceptualMemory
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.sizes import budget_frames
from mme_vla.registry import MEMORIES


@MEMORIES.register("pyramid")
class Pyramid(FrameMemory, PerceptualMemory):
    """`budget / grid²` frames: the first, and as many as the windows of all strides hold."""

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 512,
        *,
        grid: int = 4,
        pooling: str = "mean",
        strides: Sequence[int] = (2, 8, 32, 128),
        **encoder: Any,
    ) -> None:
        """See `PerceptualMemory`.

        Args:
            grid, pooling: a frame is grid×grid tokens.
            strides: frames between two of a window, from the newest window to the oldest; each
                divides the next one. All windows hold equally many frames, the newest ones one more
                where that does not come out even.
        """
        strides = list(strides)
        check_sizes("memory", **{f"strides.{i}": stride for i, stride in enumerate(strides)})
        require(
            len(strides) > 0 and all(a < b and b % a == 0 for a, b in pairwise(strides)),
            f"memory.strides={strides}: each must be a multiple of the one before it, and greater,"
            " as in [2, 8, 32].",
        )
        frames = budget_frames(budget, grid, at_least=len(strides) + 1)
        super().__init__(d_vision, width, budget, StorageSpec(grid, pooling, strides[0]), **encoder)
        self.strides = strides
        self.sizes = [len(part) for part in np.array_split(np.arange(frames - 1), len(strides))]

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        """The frames kept at `step`, ascending: frame 0, and k·stride − 1 within the window of each
        stride.
        """
        windows = [np.zeros(1, np.int64)]
        newest = step
        for stride, size in zip(self.strides, self.sizes, strict=True):
            oldest = newest - stride * size
            frames = np.arange(max(oldest + 1, 0), newest + 1)
            windows.append(frames[(frames + 1) % stride == 0])
            newest = oldest
        return np.unique(np.concatenate(windows))
