"""What the two perceptual memories share: one selected token in, one memory token out (paper, section 4.2)."""

from mme_vla.memory.base import Memory
from mme_vla.memory.encoder import FeatureEncoder
from mme_vla.memory.history import StorageSpec
from mme_vla.types import HistoryTokens, MemoryTokens


class PerceptualMemory(Memory):
    """Selected tokens, right-padded to the budget and encoded one by one; subclasses choose."""

    timed = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int,
        storage: StorageSpec,
        position_dim: int | None = None,
        position_hidden: int | None = None,
    ) -> None:
        """Build the encoder.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            budget: most memory tokens. storage: what is kept of each frame.
            position_dim, position_hidden: widths of the position features and their layer; None follows `d_vision`.
        """
        super().__init__()
        self.budget = self.capacity = budget
        self.storage = storage
        self.encoder = FeatureEncoder(d_vision, width, position_dim, position_hidden)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        tokens = self.encoder(history.features, history.positions, history.mask)
        return MemoryTokens(tokens, history.mask, ages=history.ages)
