"""Episodes of policies whose memory stores keys and values: written once a chunk, after the chunk
stands.
"""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from torch import Tensor

from mme_vla.memory.base import CacheEntry, CacheMemory
from mme_vla.policy.capabilities import MemoryEntries
from mme_vla.policy.episode import Episode
from mme_vla.types import KeysValues


class CachingEpisode(Episode):
    """An episode with stored keys and values, which a probe can read and replace
    (`WritableMemory`).

    cache: what the next chunk reads, oldest first. made: what the backbone made of the last chunk's
    prefix. staged: what is stored once that chunk stands. A chunk that fails or is sampled again
    replaces both, and writes nothing.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.cache: tuple[CacheEntry, ...] = ()
        self.made: CacheEntry | None = None
        self.staged: tuple[CacheEntry, ...] = ()

    def acted(self, chunk: np.ndarray, notes: Mapping[str, str] | None = None) -> None:
        super().acted(chunk, notes)
        self.cache, self.made = self.staged, None

    @property
    def memory_clock(self) -> str | None:
        return "frames"

    def writable_memory(self) -> tuple[MemoryEntries, ...]:
        return (MemoryEntries("cache", self.cache, max(self.n_observed_frames - 1, 0)),)

    def with_entries(self, stores: Sequence[Sequence[tuple[int, Tensor]]]) -> Self:
        twin = copy.copy(self)
        twin.cache = tuple(stores[0])
        return twin

    def resume_from(self, twin: Episode) -> None:
        assert isinstance(twin, CachingEpisode) and twin.made is not None
        memory = self._memory
        assert isinstance(memory, CacheMemory)
        self.made, self.staged = twin.made, tuple(memory.write(self.cache, twin.made))


def stack_caches(episodes: Sequence[Episode]) -> KeysValues | None:
    """Stored keys and values of running episodes, padded to one length; None before the first chunk
    of all.
    """
    caches = [episode.cache for episode in episodes if isinstance(episode, CachingEpisode)]
    return KeysValues.stack([[values for _, values in cache] for cache in caches])


def stage_writes(memory: CacheMemory, episodes: Sequence[Episode], made: KeysValues) -> None:
    """Prepare what each episode stores once its chunk stands."""
    for row, episode in enumerate(episodes):
        assert isinstance(episode, CachingEpisode)
        episode.made = episode.n_observed_frames - 1, made.entry(row).clone()
        episode.staged = tuple(memory.write(episode.cache, episode.made))
