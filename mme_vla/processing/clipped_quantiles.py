"""Normalisation by quantiles, clipped: how OpenVLA's family scales states and actions."""

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError

EPSILON = 1e-8


@dataclass(frozen=True)
class ClippedQuantiles:
    """Maps [q01, q99] to [−1, 1] and clips; a number that never moved becomes 0.

    low, high: the quantiles [d]. scaled: [d] bool; the others pass as they are. still: [d] bool; never moved.
    """

    low: np.ndarray
    high: np.ndarray
    scaled: np.ndarray
    still: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    @classmethod
    def of(cls, stats: Any, scaled: np.ndarray | None = None) -> Self:
        """Of statistics with `q01` and `q99` [d], and `min` and `max` where they were kept.

        scaled: which numbers are scaled; by default all.
        """
        low, high = np.asarray(stats.q01, np.float64), np.asarray(stats.q99, np.float64)
        least, most = getattr(stats, "min", None), getattr(stats, "max", None)
        ends = (low, high) if least is None or most is None else (np.asarray(least), np.asarray(most))
        every = np.ones(len(low), bool) if scaled is None else np.asarray(scaled, bool)
        return cls(low, high, every, ends[0] == ends[1])

    def normalize(self, x: Tensor) -> Tensor:
        """Scale x [..., d]: clip(2 (x − q01) / (q99 − q01 + ε) − 1, ±1), and 0 where nothing ever moved."""
        low, span, scaled, still = self._on(x)
        y = (2 * (x - low) / span - 1).clamp(-1, 1)
        return torch.where(scaled, torch.where(still, torch.zeros_like(y), y), x)

    def unnormalize(self, y: Tensor) -> Tensor:
        """Scale y [..., d] back: ½ (y + 1) (q99 − q01 + ε) + q01; nothing is clipped."""
        low, span, scaled, _ = self._on(y)
        return torch.where(scaled, (y + 1) / 2 * span + low, y)

    def zero(self) -> np.ndarray:
        """What 0 becomes [d], not clipped: the padding of actions that are differences."""
        y = 2 * (0 - self.low) / (self.high - self.low + EPSILON) - 1
        return np.where(self.scaled, np.where(self.still, 0.0, y), 0.0)

    def _on(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        if not x.is_floating_point() or x.shape[-1] != len(self.low):
            raise UserError(
                f"Statistics of {len(self.low)} numbers do not fit values {x.dtype} of shape {list(x.shape)}."
            )
        still = self.still if len(self.still) else np.zeros(len(self.low), bool)
        scaled, motionless = (torch.from_numpy(flag).to(x.device) for flag in (self.scaled, still))
        return x.new_tensor(self.low), x.new_tensor(self.high - self.low + EPSILON), scaled, motionless
