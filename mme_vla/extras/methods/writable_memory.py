"""A capability that the episodes of some policies have beside `Episode`: probes check for it with
`isinstance`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

from torch import Tensor

if TYPE_CHECKING:
    from mme_vla.policy.episode import Episode


@dataclass(frozen=True)
class MemoryEntries:
    """One store of a writable memory.

    entries: (time, content) in the order they are read.
    now: the current time, in the unit of these times.
    """

    name: str
    entries: tuple[tuple[int, Tensor], ...]
    now: int


@runtime_checkable
class WritableMemory(Protocol):
    """An episode whose memory entries can be read and replaced, as probes do."""

    @property
    def memory_clock(self) -> str | None:
        """Unit of the entries' times (`frames`); None if entries only have an order."""
        ...

    def writable_memory(self) -> tuple[MemoryEntries, ...]:
        """All stores."""
        ...

    def with_entries(self, stores: Sequence[Sequence[tuple[int, Tensor]]]) -> Self:
        """Copy this episode with other entries in its stores, for one chunk."""
        ...

    def resume_from(self, twin: "Episode") -> None:
        """Continue after a chunk that was sampled for a copy by `with_entries`, with this episode's
        own entries.
        """
        ...
