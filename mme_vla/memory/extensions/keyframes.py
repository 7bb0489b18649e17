"""Keyframes: a write head predicts at which frames a sub-task begins, and these frames are kept
whole (EventVLA).

After EventVLA, whose head predicts keyframes from the hidden state of an action chunk, keeps those
that are certain enough beside a few anchors, and suppresses neighbours. A memory here is computed
before the language model, so the head reads the mean of a frame's tokens and its difference from
the stored frame before it. Its labels are the sub-tasks or the facts of the dataset: a stored frame
is a keyframe where one has begun since the stored frame before it. Without labels the action loss
alone trains it, through a straight-through sigmoid as in `learned_topk`.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import FrameMemory, PerceptualMemory
from mme_vla.memory.extensions.attending import by_frame, rows_at
from mme_vla.memory.framesamp import evenly_spaced_stored_frames
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import default_hidden, full_precision, linear
from mme_vla.memory.sizes import LEAST_FRAMES, budget_frames
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens, ReadsLabels

LARGE = 1e4  # beyond any score


@MEMORIES.register("keyframes")
class Keyframes(FrameMemory, PerceptualMemory, ReadsLabels):
    """The first frame, the newest stored one, and `budget / grid² − 2` that the head is most
    certain of.
    """

    lazy = False  # along an episode the head reads most frames

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 256,
        *,
        grid: int = 4,
        pooling: str = "mean",
        every: int = 8,
        pool: int = 80,
        hidden: int | None = None,
        label: str = "subtask_index",
        **encoder: Any,
    ) -> None:
        """See `PerceptualMemory`.

        Args:
            grid, pooling: a frame is grid×grid tokens.
            every: frames 0 and k·every − 1 can be kept.
            pool: most of them that the head reads, evenly spaced.
            hidden: width of the head; None is a quarter of `d_vision`, at least 64.
            label: a label that changes at keyframes: `subtask_index`, `fact_index` or a column.
        """
        check_sizes("memory", every=every, pool=pool)
        frames = budget_frames(budget, grid, LEAST_FRAMES["keyframes"])
        require(
            frames <= pool,
            f"memory.pool={pool}: the frames of memory.budget={budget} are {frames}, so at least"
            " that.",
        )
        super().__init__(d_vision, width, budget, StorageSpec(grid, pooling, every), **encoder)
        hidden = default_hidden(d_vision, hidden)
        self.capacity = pool * grid**2
        self.frames = frames
        self.pool = pool
        self.reads_labels = (label,)
        self.read = nn.Linear(2 * d_vision, hidden)
        self.write = nn.Linear(hidden, 1)

    def selected_frames(self, step: int, exec_start: int = 0) -> np.ndarray:
        """The frames that the head reads at `step`, ascending, the newest stored one among them;
        `forward` keeps some of them.
        """
        return evenly_spaced_stored_frames(self.storage, step, self.pool)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        patches = self.storage.grid**2
        valid = by_frame(history.mask, patches)[..., 0]
        scores = self.scores(history.features)
        top_frames = self.top_frames(scores, valid)
        patch = torch.arange(patches, device=top_frames.device)
        indices = (top_frames[..., None] * patches + patch).flatten(1)
        mask = rows_at(history.mask, indices)
        features = rows_at(history.features, indices)
        positions = rows_at(history.positions, indices)
        tokens = self.encoder(features, positions, mask)
        # The weight is 1 in the forward pass, and the sigmoid in the backward pass.
        weight = rows_at(scores, top_frames).sigmoid()
        weight = (weight + (1 - weight).detach()).repeat_interleave(patches, 1)
        tokens = tokens * weight[..., None].to(tokens.dtype)
        ages = None if history.ages is None else rows_at(history.ages, indices)
        losses = {}
        (name,) = self.reads_labels
        if name in history.labels:
            label = by_frame(history.labels[name], patches)[..., 0]
            losses["write"] = write_loss(scores, label, valid)
        return MemoryTokens(tokens, mask, ages=ages, losses=losses)

    def scores(self, features: Tensor) -> Tensor:
        """Logits [b, t] float32: whether a frame is a keyframe; features [b,
        t·p, d].
        """
        with full_precision(features):
            means = by_frame(features.float(), self.storage.grid**2).mean(2)
            change = torch.diff(means, dim=1, prepend=means[:, :1])
            hidden = functional.silu(linear(self.read, torch.cat([means, change], -1)))
            return linear(self.write, hidden)[..., 0]

    def top_frames(self, scores: Tensor, valid: Tensor) -> Tensor:
        """Which frames are kept: int64 [b, frames], ascending, padding last.

        Highest scores first, those lower than a neighbour's after all others. The first frame and
        the newest in any case.
        """
        ranks = scores.detach().masked_fill(~valid, -2 * LARGE)
        highest = functional.max_pool1d(ranks[:, None], kernel_size=3, stride=1, padding=1)[:, 0]
        ranks = ranks - LARGE * (ranks < highest)
        newest = (valid.sum(1, keepdim=True) - 1).clamp(min=0)
        ends = torch.cat([torch.zeros_like(newest), newest], 1)
        ranks = ranks.scatter(1, ends, LARGE)
        return ranks.topk(self.frames, dim=1).indices.sort(1).values


def write_loss(scores: Tensor, label: Tensor, valid: Tensor) -> Tensor:
    """Cross-entropy [b] of logits [b, t], the mean over keyframes and that over other frames
    counting alike.

    Args:
        label: changes at keyframes, such as the number of each frame's sub-task, [b, t].
        valid: bool [b, t].
    """
    begins = torch.diff(label, dim=1, prepend=label[:, :1]).ne(0)
    losses = functional.binary_cross_entropy_with_logits(
        scores, begins.to(scores.dtype), reduction="none"
    )
    is_keyframe = begins & valid
    is_other = ~begins & valid
    keyframe_loss = (losses * is_keyframe).sum(1) / is_keyframe.sum(1).clamp(min=1)
    other_loss = (losses * is_other).sum(1) / is_other.sum(1).clamp(min=1)
    return (keyframe_loss + other_loss) / 2
