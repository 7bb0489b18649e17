"""`Scheduler`: the order of policy calls for the server and for rollouts.

Episodes bring frames, which are read in pieces, and then wait for actions, sampled for many at
once. One round reads the new frames of episodes with at most one piece left, then samples one batch
of actions, then reads pieces of long videos for as long as the round took so far, at least one.
Episodes that replan at the same time share a batch, and long and short readers each get half of the
time. When nothing waits, a round prepares a part of a later batch.
"""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol
from weakref import WeakKeyDictionary


class Reading(Protocol):
    """Frames that are being read into memory."""

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
    """Sample actions for these, in one batch."""

    batch: list[A]


@dataclass(frozen=True)
class Prepare[L]:
    """Prepare a part of this one's next chunk; add it to `Scheduler.later` again if
    more remains.
    """

    work: L


class Scheduler[R: Reading, A, L]:
    """Collects what waits; `next_steps` yields the next round, step by step.

    Args:
        max_batch: most episodes in a batch.
    """

    def __init__(self, max_batch: int) -> None:
        self.max_batch = max_batch
        self.reading: deque[R] = deque()
        self.acting: deque[A] = deque()
        self.later: WeakKeyDictionary[L, None] = WeakKeyDictionary()
        """Episodes that execute a chunk, whose next one may be prepared meanwhile."""

    def __bool__(self) -> bool:
        return bool(self.reading or self.acting or self.later)

    def next_steps(self) -> Iterator[Read[R] | Act[A] | Prepare[L]]:
        """The steps of one round. What arrives meanwhile may still join its batch."""
        begun = time.perf_counter()
        for short in [work for work in self.reading if work.pieces <= 1]:
            yield from self._piece(short)
        batch: list[A] = []
        while self.acting and len(batch) < self.max_batch:
            batch.append(self.acting.popleft())
        if batch:
            yield Act(batch)
        until = 2 * time.perf_counter() - begun
        while long := next((work for work in self.reading if work.pieces > 1), None):
            yield from self._piece(long)
            if time.perf_counter() > until:
                break
        if self.reading or self.acting:
            return
        work = next(iter(self.later), None)
        if work is not None:
            del self.later[work]
            yield Prepare(work)

    def _piece(self, work: R) -> Iterator[Read[R]]:
        self.reading.remove(work)
        yield Read(work)
        if work.pieces:
            self.reading.append(work)  # behind the others
