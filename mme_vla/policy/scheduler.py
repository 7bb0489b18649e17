"""Who has the policy when: one order of work for the policy server and for rollouts.

Episodes bring frames, which are read in pieces, and then wait for actions, chosen for many at once. A turn is: the new
frames of everyone who has only a piece left, then one batch of whoever waits for actions, then pieces of long videos
for as long as the rest of the turn took, at least one. So whoever replans at the same time travels together, and those
with a thousand frames and those with few each get half of the machine while there are both. Where nobody waits, a piece
is done of what a later batch will need.
"""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol
from weakref import WeakKeyDictionary


class Reading(Protocol):
    """Frames on their way into memory."""

    @property
    def pieces(self) -> int:
        """Pieces still to be read."""
        ...


@dataclass(frozen=True)
class Read[R]:
    """Read one piece of this."""

    work: R


@dataclass(frozen=True)
class Act[A]:
    """Choose actions for these, in one batch."""

    batch: list[A]


@dataclass(frozen=True)
class Prepare[L]:
    """Do a piece of what this will need when it acts next; whoever does it says where more is left (`Turns.later`)."""

    work: L


class Scheduler[R: Reading, A, L]:
    """Collects who waits; `turn` says what is to be done next, and the caller does it before asking on.

    Args:
        max_batch: most that act together.
    """

    def __init__(self, max_batch: int) -> None:
        self.max_batch = max_batch
        self.reading: deque[R] = deque()
        self.acting: deque[A] = deque()
        self.later: WeakKeyDictionary[L, None] = WeakKeyDictionary()
        """Who has acted and will again, each once; whoever is gone is not kept for it."""

    def __bool__(self) -> bool:
        """Whether there is anything to do."""
        return bool(self.reading or self.acting or self.later)

    def next_steps(self) -> Iterator[Read[R] | Act[A] | Prepare[L]]:
        """The steps of one turn. Who comes in the meantime may be in its batch already."""
        begun = time.perf_counter()
        for short in [work for work in self.reading if work.pieces <= 1]:
            yield from self._piece(short)
        batch = [self.acting.popleft() for _ in range(min(len(self.acting), self.max_batch))]
        if batch:
            yield Act(batch)
        until = 2 * time.perf_counter() - begun
        while long := next((work for work in self.reading if work.pieces > 1), None):
            yield from self._piece(long)
            if time.perf_counter() > until:
                break
        if not (self.reading or self.acting) and (work := next(iter(self.later), None)) is not None:
            del self.later[work]
            yield Prepare(work)

    def _piece(self, work: R) -> Iterator[Read[R]]:
        self.reading.remove(work)
        yield Read(work)
        if work.pieces:
            self.reading.append(work)  # behind the others
