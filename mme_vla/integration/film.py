"""Memory as video: one vector, joined to the condition that scales and shifts every block of a
denoising network.
"""

from typing import Any

from torch import Tensor, nn

from mme_vla.errors import check_integer
from mme_vla.integration.base import Integration, required
from mme_vla.registry import INTEGRATIONS
from mme_vla.types import MemoryTokens


class PooledIntegration(Integration):
    """Hands memory over as one vector of `feature_width` numbers; a backbone that reads one
    supports `vector`.
    """

    required_features = frozenset({"vector"})
    feature_width: int

    def feature(self, memory: MemoryTokens | None) -> Tensor:
        """Memory tokens [b, n, d] → [b, feature_width]."""
        raise NotImplementedError


@INTEGRATIONS.register("film")
class FiLM(PooledIntegration):
    """The mean of the memory's tokens, normed and projected."""

    def __init__(self, backbone: Any, width: int = 64) -> None:
        """Build it.

        Args:
            backbone: sizes, which are not used.
            width: of the memory tokens and of the vector.
        """
        super().__init__(backbone)
        check_integer("integration.width", width)
        self.memory_width = width
        self.feature_width = width
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, width)

    def feature(self, memory: MemoryTokens | None) -> Tensor:
        memory = required(memory)
        count = memory.mask.sum(1, keepdim=True).clamp(min=1)
        return self.out(self.norm(memory.tokens.sum(1) / count))
