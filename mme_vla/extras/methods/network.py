"""What policies of prior methods share: memory tokens of a selection, and the kind of processor."""

from mme_vla.errors import UserError
from mme_vla.memory.base import encode_selection
from mme_vla.policy.network import NetworkPolicy
from mme_vla.speed import Recomputes
from mme_vla.types import HistoryTokens, MemoryTokens


class MethodPolicy(NetworkPolicy, Recomputes):
    """A policy of one network that may take a memory, can recompute activations, and has no
    `MMEModel`.
    """

    def encode_memory(self, history: HistoryTokens | None) -> MemoryTokens | None:
        """Encode selections into memory tokens; None without memory or selections."""
        if self.memory is None or history is None:
            return None
        with self.autocast():
            return encode_selection(self.memory, history)


def processor_for[P](kind: type[P], processor: object, names: str) -> P | None:
    """The processor, which must be of the kind that a policy needs; `names` are those of its
    configurations.
    """
    if processor is None or isinstance(processor, kind):
        return processor
    raise UserError(f"This policy needs its own processor: set processor={names}.")
