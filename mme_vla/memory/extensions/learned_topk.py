"""Learned top-k: a small network says which of many stored tokens are worth a place; the action
loss teaches it.

After the selectors that were put into forks of the released code
(easonyu0203/robomme_policy_learning at 17c564cc, read and not copied): evenly spaced candidates,
two self-attention blocks with a few registers over them, one score a token, the k best kept, and a
sigmoid around the k-th best score for the gradient (straight-through). Three choices differ. There
is no noise on the scores, so that an update stays a function of the seed and the step. So that a
token which is not kept can still show that it would have been worth it, what is left over is
averaged, weighted by the same sigmoid, into one last token. And the selection is flat, in one
stage. Kept tokens are handed over in the order of time, so that their slots say little: take
`integration.memory_position=time`, as `configs/model/learned_topk_*` do.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import require
from mme_vla.memory.base import FeatureEncoder, MemoryModule, all_patches, union_frames
from mme_vla.memory.extensions.attending import ReadingBlock, heads_of, rows_at
from mme_vla.memory.framesamp import evenly_spaced_stored_frames
from mme_vla.memory.history import History, StorageSpec
from mme_vla.memory.recurrent import default_hidden
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens

LOWEST = -1e4  # below any score: padding
EPS = 1e-4


@MEMORIES.register("learned_topk")
class LearnedTopK(MemoryModule):
    """The budget − 1 best tokens of `pool` evenly spaced frames, in the order of time, and one for
    all the others.
    """

    timed = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 256,
        *,
        pool: int = 64,
        every: int = 1,
        grid: int = 4,
        pooling: str = "mean",
        temperature: float = 1.0,
        layers: int = 2,
        registers: int = 4,
        hidden: int | None = None,
        heads: int | None = None,
        **encoder: Any,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            budget: memory tokens. pool: frames whose tokens compete for them.
            every: frames 0 and k·every − 1 can compete; the others are neither rendered nor
                encoded. 1: all.
            grid, pooling: a frame is grid×grid tokens.
            temperature: how far from the k-th best a score may be to be learned from; scores have
                variance 1.
            layers, registers, hidden, heads: of the network that scores; its width is by default a
                quarter of `d_vision`, at least 64.
            encoder: `position_dim`, `position_hidden` and `positions` of both `FeatureEncoder`s.
        """
        super().__init__()
        require(
            2 <= budget <= pool * grid**2,
            f"memory.budget={budget} must lie between 2 and the {pool * grid**2} tokens of"
            f" memory.pool={pool} frames of {grid}×{grid}: what it does not hold is chosen from.",
        )
        require(
            temperature > 0 and layers >= 1 and registers >= 0,
            f"memory.temperature={temperature}, memory.layers={layers},"
            f" memory.registers={registers}: the first must be positive, the second at least 1, the"
            " third at least 0.",
        )
        hidden = default_hidden(d_vision, hidden)
        heads = heads_of(hidden, heads)
        self.budget, self.pool, self.temperature = budget, pool, temperature
        self.storage = StorageSpec(grid, pooling, every)
        self.capacity = pool * grid**2
        self.judge = FeatureEncoder(d_vision, hidden, **encoder)
        self.registers = nn.Parameter(torch.randn(registers, hidden) * hidden**-0.5)
        self.layers = nn.ModuleList(ReadingBlock(hidden, heads) for _ in range(layers))
        self.norm, self.score = nn.LayerNorm(hidden), nn.Linear(hidden, 1)
        self.encoder = FeatureEncoder(d_vision, width, **encoder)

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return union_frames([self.selected_frames(int(step)) for step in steps])

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """The candidates: which of them are kept is `forward`'s matter."""
        return all_patches(self.selected_frames(step), self.storage.grid)

    def selected_frames(self, step: int) -> np.ndarray:
        """The frames whose tokens compete at `step`."""
        return evenly_spaced_stored_frames(self.storage, step, self.pool)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        selected, soft = self.keep(self.scores(history), history.mask)
        mask = rows_at(history.mask, selected)
        # One in the forward pass; in the backward pass what the sigmoid says.
        worth = rows_at(soft, selected)
        worth = worth + (1 - worth).detach()
        best = self.encoder(
            rows_at(history.features, selected), rows_at(history.positions, selected), mask
        )
        best = best * worth[..., None].to(best.dtype)
        left = soft * history.mask.scatter(1, selected, torch.zeros_like(mask))
        share = left / left.sum(1, keepdim=True).clamp(min=EPS)
        remainder = self._remainder(history, share).to(best.dtype)
        remainder_mask = left.sum(1, keepdim=True) > EPS
        ages = history.ages
        if ages is not None:
            ages = torch.cat(
                [rows_at(ages, selected), (ages * share.detach()).sum(1, keepdim=True)], 1
            )
        return MemoryTokens(
            torch.cat([best, remainder], 1), torch.cat([mask, remainder_mask], 1), ages=ages
        )

    def scores(self, history: HistoryTokens) -> Tensor:
        """What each candidate is worth, [b, n] float32, with mean 0 and variance 1 over a sample's
        candidates.
        """
        x = self.judge(history.features, history.positions, history.mask)
        registers = self.registers.to(x.dtype).expand(len(x), -1, -1)
        x = torch.cat([x, registers], 1)
        key_mask = nn.functional.pad(history.mask, (0, registers.shape[1]), value=True)
        key_mask = key_mask[:, None, :].expand(-1, x.shape[1], -1)
        for layer in self.layers:
            x = layer(x, x, key_mask)
        score = self.score(self.norm(x[:, : history.mask.shape[1]]))[..., 0].float()
        counted = history.mask.float()
        count = counted.sum(1, keepdim=True).clamp(min=1)
        centred = (score - (score * counted).sum(1, keepdim=True) / count) * counted
        return centred * ((centred.square().sum(1, keepdim=True) / count) + EPS).rsqrt()

    def keep(self, scores: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Which candidates are kept, and how surely.

        Args:
            scores: [b, n]. mask: [b, n] bool, False on padding.

        Returns:
            kept [b, budget − 1], ascending, padding last of all; and [b, n] in [0, 1], ½ at the
            border.
        """
        count = self.budget - 1
        best, order = scores.masked_fill(~mask, LOWEST).topk(count + 1, dim=1)
        border = (best[:, -2:].sum(1, keepdim=True) / 2).detach()
        soft = torch.sigmoid((scores - border) / self.temperature) * mask
        return order[:, :count].sort(1).values, soft

    def _remainder(self, history: HistoryTokens, share: Tensor) -> Tensor:
        """One token [b, 1, d] for what is not kept: the mean of its features and of its places, by
        share [b, n].
        """
        features = (history.features.float() * share[..., None]).sum(1, keepdim=True)
        places = self.encoder.places(history.positions) * share[..., None]
        return self.encoder.encode(features, places.sum(1, keepdim=True))
