"""What an episode's recurrence has come to: states that later decisions may continue."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

State = tuple[Tensor, ...]
"""What is carried from frame to frame; each tensor [b, …]."""

KEPT = 4
"""States kept of an episode: replans every quarter, half, three quarters or whole of a stride all continue one."""


@dataclass(eq=False)
class Taken:
    """A state (None before the first frame) and the frames [n] that it has taken, in order."""

    frames: np.ndarray
    state: State | None = None


@dataclass
class RecurrentStream:
    """How far one episode's recurrence has come.

    kept: the last used is the last one. updates: frames taken since the episode began, repeated ones included.
    asked: the step of the last decision. pace: frames from the decision before it to that one.
    """

    kept: list[Taken] = field(default_factory=list)
    updates: int = 0
    asked: int | None = None
    pace: int | None = None

    def decides(self, step: int) -> None:
        """Note that a decision is made at `step`."""
        if self.asked is not None and step > self.asked:
            self.pace = step - self.asked
        self.asked = step

    def continued(self, frames: np.ndarray) -> Taken:
        """The state that has taken the longest beginning of these frames; a fresh one where none has."""
        fitting = [taken for taken in self.kept if np.array_equal(frames[: len(taken.frames)], taken.frames)]
        best = max(fitting, key=lambda taken: len(taken.frames), default=Taken(frames[:0]))
        self.kept = [*(taken for taken in self.kept if taken is not best), best][-KEPT:]
        return best


def pieces(count: int, chunk: int) -> Iterator[int]:
    """How many frames enter together: chunks, and the newest alone.

    A state that was prepared before the newest frame was there has so been through the same steps, to the bit, as one
    that takes them all at once.
    """
    for start in range(0, count - 1, chunk):
        yield min(chunk, count - 1 - start)
    if count:
        yield 1
