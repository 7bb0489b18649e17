"""A memory without training: keys and values of the last prefixes, which the actions read beside
the current ones.
"""

from collections.abc import Sequence

from mme_vla import Integration, MemoryTokens, register
from mme_vla.backbone.layers import PI05_VISIBILITY
from mme_vla.memory.base import CacheEntry, CacheMemory
from mme_vla.types import KeysValues

VISIBILITY = {**PI05_VISIBILITY, "action": {*PI05_VISIBILITY["action"], "cache"}}


@register("memory", "fifo")
class Fifo(CacheMemory):
    """Keys and values of the last `chunks` prefixes: first in, first out."""

    def __init__(self, d_vision: int, width: int, chunks: int = 4) -> None:
        super().__init__()
        self.chunks = chunks

    def write(self, entries: Sequence[CacheEntry], new: CacheEntry) -> Sequence[CacheEntry]:
        return [*entries, new][-self.chunks :]


@register("integration", "beside_prefix")
class BesidePrefix(Integration):
    """The actions attend to stored keys and values as they do to the prefix. The
    prefix does not.
    """

    visibility = VISIBILITY

    def past(self, memory: MemoryTokens | None) -> KeysValues | None:
        return None if memory is None else memory.cache
