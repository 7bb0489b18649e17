"""A small encoder and a small memory, so that tests of the data need no network."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.memory.base import MemoryModule
from mme_vla.memory.history import FrameScorer, History, StorageSpec
from mme_vla.types import HistoryTokens, MemoryTokens

WIDTH = 6


def encode(frames: np.ndarray, grid: int = 2) -> Tensor:
    """Mean colour of every cell, projected by a fixed random matrix: [n, grid², WIDTH] float32."""
    n, height, width, _ = frames.shape
    cells = torch.from_numpy(frames.astype(np.float32)).view(
        n, grid, height // grid, grid, width // grid, 3
    )
    colours = cells.mean(dim=(2, 4)).reshape(n, grid**2, 3) / 255
    return colours @ torch.randn(3, WIDTH, generator=torch.Generator().manual_seed(0))


class MeanBrightness(FrameScorer):
    """Scores every third frame by its cells' brightness."""

    def __call__(self, frame_index: int, frame: np.ndarray) -> np.ndarray | None:
        half = frame.shape[0] // 2
        cells = frame.reshape(2, half, 2, half, 3).mean(axis=(1, 3, 4))
        return cells.reshape(-1).astype(np.float32) if frame_index % 3 == 0 else None


class LastFrames(MemoryModule):
    """Remembers the newest kept frames, the brighter of them first in line where there
    are scores.
    """

    def __init__(self, frames: int = 3, keep_every: int = 1, scored: bool = False) -> None:
        super().__init__()
        self.budget = self.capacity = 4 * frames
        self.frames = frames
        self.storage = StorageSpec(2, keep_every=keep_every, scorer="brightness" if scored else "")

    def make_scorer(self) -> FrameScorer | None:
        return MeanBrightness() if self.storage.scorer else None

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        candidates = self.storage.stored_frames(step + 1)
        if self.storage.scorer:
            scores = history.scores.until(step)
            bright = scores.frames[np.argsort(-scores.values.mean(1), kind="stable")]
            candidates = np.sort(np.intersect1d(candidates, bright)[: self.frames])
        frames = (
            candidates[-self.frames :]
            if rng is None
            else np.sort(rng.permutation(candidates)[: self.frames])
        )
        return np.stack([np.repeat(frames, 4), np.tile(np.arange(4), len(frames))], axis=1)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        return MemoryTokens(history.features, history.mask)


def same(a: Any, b: Any) -> bool:
    """Whether two items (dictionaries, structs, tensors, weights of modules, …) are equal to the
    last bit.
    """
    if isinstance(a, nn.Module):
        return same(a.state_dict(), b.state_dict())
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, HistoryTokens):
        return all(torch.equal(x, y) for x, y in zip(a.tensors(), b.tensors(), strict=True))
    return torch.equal(a, b) if isinstance(a, Tensor) else a == b
