"""A memory that only names frames: those of SimpleMemVLA's window, for
`mme-vla record memory=… frames=choices`.
"""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from mme_vla import register
from mme_vla.extras.methods.simplememvla.video import Window
from mme_vla.memory.base import MemoryModule, union_frames
from mme_vla.memory.history import History, StorageSpec
from mme_vla.types import HistoryTokens, MemoryTokens


@register("memory", "video_window")
class VideoWindow(MemoryModule):
    """Reads the frames that a `Window` shows; it makes no tokens."""

    def __init__(
        self, d_vision: int, width: int, seconds: float = 60, fps: float = 2, native_fps: float = 20
    ) -> None:
        """Take the window's settings; `d_vision` and `width` are not used."""
        super().__init__()
        self.window = Window(seconds, fps, native_fps)
        self.budget, self.capacity, self.storage = 1, 1, StorageSpec(1)

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return union_frames([np.unique(self.window.frames(int(step))) for step in steps])

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        return np.array([[step, 0]])

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        tokens: Tensor = history.features
        return MemoryTokens(tokens, history.mask)
