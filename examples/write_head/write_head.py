"""A memory with a learned write head: it learns which frames begin a sub-task, and weighs their
tokens by it.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla import History, HistoryTokens, MemoryTokens, PerceptualMemory, StorageSpec, register
from mme_vla.memory.base import all_patches
from mme_vla.types import ReadsLabels

LABEL = "subtask_boundary"


@register("memory", "write_head")
class WriteHead(PerceptualMemory, ReadsLabels):
    """The most recent frames, `spacing` steps apart, each token times its write probability."""

    reads_labels = (LABEL,)

    def __init__(
        self, d_vision: int, width: int, budget: int = 256, grid: int = 4, spacing: int = 4
    ) -> None:
        super().__init__(d_vision, width, budget, StorageSpec(grid))
        self.frames, self.spacing = budget // grid**2, spacing
        self.write = nn.Linear(d_vision, 1)

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        frames = np.arange(step, -1, -self.spacing)[: self.frames][::-1]
        return all_patches(frames, self.storage.grid)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        memory = super().forward(history)
        scores = self.write(history.features.to(self.write.weight.dtype))[..., 0]
        tokens = memory.tokens * scores.sigmoid()[..., None]
        losses = {"write": self.write_loss(scores, history)} if LABEL in history.labels else {}
        return replace(memory, tokens=tokens, losses=losses)

    def write_loss(self, scores: Tensor, history: HistoryTokens) -> Tensor:
        """Binary cross-entropy [b] of the scores [b, n], the mean over valid tokens."""
        labels = history.labels[LABEL]
        losses = nn.functional.binary_cross_entropy_with_logits(
            scores.float(), labels, reduction="none"
        )
        counted = history.mask.float()
        return (losses * counted).sum(1) / torch.clamp(counted.sum(1), min=1)
