"""What a policy remembers at one moment, entry by entry, whatever its memory is made of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Entry:
    """One thing that is remembered: a frame's tokens, a moment in a bank.

    time: when it was, in frames of what the policy was shown (in moments, for banks that count those). content: what
    stands there; only the channel it came from knows how to read it.
    """

    time: int
    content: Any


@dataclass(frozen=True)
class Remembered:
    """The entries of one store, in the order they are read; None where an intervention took one away.

    now: the current moment, on the clock of the entries' times. name: which store, for policies that have several.
    """

    entries: tuple[Entry | None, ...]
    now: int
    name: str = "memory"

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def held(self) -> list[int]:
        """Slots that hold something."""
        return [slot for slot, entry in enumerate(self.entries) if entry is not None]

    def age(self, slot: int) -> int:
        """How long ago an entry was; 0 for a slot that holds nothing."""
        entry = self.entries[slot]
        return 0 if entry is None else self.now - entry.time

    def without(self, slots: Sequence[int]) -> "Remembered":
        """The same with these slots empty."""
        gone = set(slots)
        return replace(self, entries=tuple(None if i in gone else entry for i, entry in enumerate(self.entries)))

    def rearranged(self, slots: Sequence[int], contents: Sequence[Any]) -> "Remembered":
        """The same with other contents at these slots; times stay."""
        new = list(self.entries)
        for slot, content in zip(slots, contents, strict=True):
            entry = new[slot]
            if entry is not None:
                new[slot] = replace(entry, content=content)
        return replace(self, entries=tuple(new))

    def changed(self, other: "Remembered") -> list[int]:
        """Ages of the entries that are otherwise in `other`: taken away, of another content, or at another time."""
        pairs = enumerate(zip(self.entries, other.entries, strict=True))
        return [self.age(slot) for slot, (mine, its) in pairs if mine is not its and mine is not None]


def same_progress(slots: Sequence[int], count: int) -> np.ndarray:
    """For each of some slots in a row, the slot of another store of `count` entries that stands as far along."""
    return np.linspace(0, max(count - 1, 0), max(len(slots), 1)).round().astype(int)[: len(slots)]
