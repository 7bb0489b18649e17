"""Episodes that write a memory of their own, beside any `Memory`: what others may look at in it, and exchange."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

from torch import Tensor

if TYPE_CHECKING:
    from mme_vla.policy.episode import Episode


@dataclass(frozen=True)
class Written:
    """One store of what was written.

    entries: (time, content) in the order they are read. now: the current moment, on the clock of these times.
    """

    name: str
    entries: tuple[tuple[int, Tensor], ...]
    now: int


@runtime_checkable
class Writes(Protocol):
    """What such an episode offers; a probe asks for no more."""

    @property
    def written_clock(self) -> str | None:
        """What the times of entries count (`moments`); None where entries have an order alone."""
        ...

    def written(self) -> tuple[Written, ...]:
        """All stores."""
        ...

    def as_if_written(self, stores: Sequence[Sequence[tuple[int, Tensor]]]) -> Self:
        """This episode with other entries in its stores, for one chunk; it stays as it is itself."""
        ...

    def go_on_from(self, twin: "Episode") -> None:
        """Go on from a chunk that was chosen for an episode of `as_if_written`, with one's own entries."""
        ...
