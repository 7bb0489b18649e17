"""Learned top-k: a small network scores many stored tokens and keeps the best; the action loss
trains it.

After the selectors that were put into forks of the released code
(easonyu0203/robomme_policy_learning at 17c564cc, read and not copied): evenly spaced candidates,
two self-attention blocks with a few registers over them, one score a token, the k best kept, and a
sigmoid around the k-th best score for the gradient (straight-through). Three choices differ. There
is no noise on the scores, so that an update stays a function of the seed and the step. The tokens
that are not kept are averaged, weighted by the same sigmoid, into one last token, so that they get
a gradient too. And the selection is flat, in one stage. Kept tokens are returned in the order of
time, so that their slots say little: take `integration.memory_position=time`, as
`configs/model/learned_topk_*` do.
"""

from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import require
from mme_vla.memory.base import (
    FeatureEncoder,
    FrameMemory,
    take_options,
)
from mme_vla.memory.extensions.attending import ReaderOptions, ReadingBlock, rows_at
from mme_vla.memory.framesamp import evenly_spaced_stored_frames
from mme_vla.memory.history import StorageSpec
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens

LOWEST = -1e4  # below any score: padding
EPS = 1e-4


@MEMORIES.register("learned_topk")
class LearnedTopK(FrameMemory):
    """The budget − 1 best tokens of `pool` evenly spaced frames, in the order of time, and one for
    all the others.
    """

    option_types: ClassVar[tuple[type, ...]] = (ReaderOptions, FeatureEncoder)
    timed = True
    lazy = False  # along an episode most frames compete

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
        registers: int = 4,
        **options: Any,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token.
            width: of a memory token, given by the integration.
            budget: memory tokens.
            pool: frames whose tokens compete for them.
            every: frames 0 and k·every − 1 can compete; the others are neither rendered nor
                encoded. 1: all.
            grid, pooling: a frame is grid×grid tokens.
            temperature: how far from the k-th best a score may be to be learned from; scores have
                variance 1.
            registers: learned tokens that the network that scores reads beside the candidates.
            options: `ReaderOptions` of that network; `position_dim`, `position_hidden` and
                `positions` of both `FeatureEncoder`s.
        """
        super().__init__()
        require(
            2 <= budget <= pool * grid**2,
            f"memory.budget={budget} must lie between 2 and the {pool * grid**2} tokens of"
            f" memory.pool={pool} frames of {grid}×{grid}, which compete for it.",
        )
        require(temperature > 0, f"memory.temperature={temperature}: must be greater than 0.")
        require(registers >= 0, f"memory.registers={registers}: must be at least 0.")
        scorer = take_options(ReaderOptions, options)
        hidden, heads = scorer.sizes(d_vision)
        self.budget = budget
        self.capacity = pool * grid**2
        self.storage = StorageSpec(grid, pooling, every)
        self.pool = pool
        self.temperature = temperature
        self.judge = FeatureEncoder(d_vision, hidden, **options)
        self.registers = nn.Parameter(torch.randn(registers, hidden) * hidden**-0.5)
        self.layers = nn.ModuleList(ReadingBlock(hidden, heads) for _ in range(scorer.layers))
        self.norm = nn.LayerNorm(hidden)
        self.score = nn.Linear(hidden, 1)
        self.encoder = FeatureEncoder(d_vision, width, **options)

    def selected_frames(self, step: int, exec_start: int = 0) -> np.ndarray:
        """The frames whose tokens compete at `step`; `forward` keeps some of the tokens."""
        return evenly_spaced_stored_frames(self.storage, step, self.pool)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        selected, soft = self.keep(self.scores(history), history.mask)
        # The best tokens.
        mask = rows_at(history.mask, selected)
        features = rows_at(history.features, selected)
        positions = rows_at(history.positions, selected)
        best = self.encoder(features, positions, mask)
        # The weight is 1 in the forward pass, and the sigmoid in the backward pass.
        weight = rows_at(soft, selected)
        weight = weight + (1 - weight).detach()
        best = best * weight[..., None].to(best.dtype)
        # One token for all the others: the means of their features and position features.
        others = soft * history.mask.scatter(1, selected, torch.zeros_like(mask))
        total = others.sum(1, keepdim=True)
        share = others / total.clamp(min=EPS)
        mean = (history.features.float() * share[..., None]).sum(1, keepdim=True)
        embedded = self.encoder.embed_positions(history.positions) * share[..., None]
        remainder = self.encoder.encode(mean, embedded.sum(1, keepdim=True)).to(best.dtype)
        ages = history.ages
        if ages is not None:
            mean_age = (ages * share.detach()).sum(1, keepdim=True)
            ages = torch.cat([rows_at(ages, selected), mean_age], 1)
        return MemoryTokens(
            tokens=torch.cat([best, remainder], 1),
            mask=torch.cat([mask, total > EPS], 1),
            ages=ages,
        )

    def scores(self, history: HistoryTokens) -> Tensor:
        """The score of each candidate, [b, n] float32, with mean 0 and variance 1 over a sample's
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
        valid = history.mask.float()
        count = valid.sum(1, keepdim=True).clamp(min=1)
        mean = (score * valid).sum(1, keepdim=True) / count
        centred = (score - mean) * valid
        variance = centred.square().sum(1, keepdim=True) / count
        return centred * (variance + EPS).rsqrt()

    def keep(self, scores: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Choose the candidates that are kept.

        Args:
            scores: [b, n].
            mask: [b, n] bool, False on padding.

        Returns:
            Their indices [b, budget − 1], ascending, padding last of all; and a soft choice [b, n]
            in [0, 1], ½ at the border.
        """
        count = self.budget - 1
        best, order = scores.masked_fill(~mask, LOWEST).topk(count + 1, dim=1)
        border = (best[:, -2:].sum(1, keepdim=True) / 2).detach()
        soft = torch.sigmoid((scores - border) / self.temperature) * mask
        return order[:, :count].sort(1).values, soft
