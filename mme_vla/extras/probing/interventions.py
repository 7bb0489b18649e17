"""What a probe changes in a policy's frames, memory or subgoal: each a small class with a dial.

One of your own is a class registered with `register("intervention", name)` in a module that
`plugins` names.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np
from torch import Tensor

from mme_vla.config.sections import NonNegativeInt, PositiveInt
from mme_vla.errors import UserError
from mme_vla.extras.probing.channels import Remembered, same_progress
from mme_vla.extras.probing.feed import Feed
from mme_vla.memory.history import History
from mme_vla.memory.transforms import HistoryTransform, RepeatFrame
from mme_vla.registry import INTERVENTIONS

NEEDS = {
    "entries": "something remembered that the probe can reach",
    "choice": "a memory that chooses among stored frames",
    "clock": "entries that have a time",
    "pauses": "a memory that sees frames at which nothing is decided",
    "subgoal": "a policy that reads subgoals",
    "recordings": "recorded episodes to take from: name them with recordings=…",
    "boundaries": (
        "sub-tasks whose beginnings are told: by recordings with subgoals, in closed loop by"
        " env=mme_vla"
    ),
}
"""What an intervention can need, for messages."""


def _nothing(name: str) -> Remembered:
    raise UserError(f"No other episode has a {name} to take from.")


@dataclass(frozen=True)
class Moment:
    """What an intervention may know of the current step.

    rng: of this episode, this step and this intervention alone. now: the current frame, as
    observed. stored: stored frames up to now, ascending. boundaries: frames at which a sub-task
    began. subgoals: earlier ones, the current one last. donor: the store of a name of another
    episode that is as far along. donor_subgoal: the subgoal there. weigh: for each slot of a store,
    by how much the chunk changes without it.
    """

    rng: np.random.Generator
    now: int = 0
    stored: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    boundaries: Sequence[int] = ()
    subgoals: Sequence[str | None] = ()
    donor: Callable[[str], Remembered] = _nothing
    donor_subgoal: str | None = None
    weigh: Callable[[Remembered], np.ndarray] | None = None


class Intervention:
    """Changes nothing. A subclass overrides what it changes; a dataclass, so that its options are
    its fields.

    dial: the option that `name:value` sets. needs: of `NEEDS`, without which it is refused.
    """

    dial: ClassVar[str | None] = None
    needs: ClassVar[frozenset[str]] = frozenset()

    def feed(self, feed: Feed) -> Feed:
        """What the policy observes."""
        return feed

    def only(self, moment: Moment) -> np.ndarray | None:
        """The stored frames that may be remembered, ascending, at least one; None for all."""
        return None

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        """What is remembered instead."""
        return store

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        """The subgoal that the policy reads instead."""
        return subgoal


@INTERVENTIONS.register("shuffle")
@dataclass(frozen=True)
class Shuffle(Intervention):
    """The contents of all entries change places; their times and slots stay where they are."""

    needs: ClassVar = frozenset({"entries"})

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        slots = store.occupied
        order = moment.rng.permutation(slots)
        return store.rearranged(slots, [_content(store, int(slot)) for slot in order])


@INTERVENTIONS.register("drop")
@dataclass(frozen=True)
class Drop(Intervention):
    """Some entries are taken away; the others keep slot and time.

    count: how many; None takes all. which: the `oldest`, the `newest`, at `random`, or the most
    `used`, those whose absence changes the chunk most (an attention that any integration has).
    """

    count: PositiveInt | None = 1
    which: Literal["oldest", "newest", "random", "used"] = "random"
    dial: ClassVar = "count"
    needs: ClassVar = frozenset({"entries"})

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        slots = store.occupied
        most = len(slots) if self.count is None else min(self.count, len(slots))
        return store.without(_ranked(store, self.which, moment)[:most])


@INTERVENTIONS.register("swap")
@dataclass(frozen=True)
class Swap(Intervention):
    """Entries hold what an entry of another recorded episode holds that is as far along; times
    stay.

    count: how many, at random; None swaps all.
    """

    count: PositiveInt | None = None
    dial: ClassVar = "count"
    needs: ClassVar = frozenset({"entries", "recordings"})

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        occupied, donor = store.occupied, moment.donor(store.name)
        if not donor.occupied or not occupied:
            return store
        # Paired over all entries, so that a part of them is swapped as it would be among all.
        their = dict(
            zip(
                occupied,
                np.array(donor.occupied)[same_progress(occupied, len(donor.occupied))].tolist(),
                strict=True,
            )
        )
        count = len(occupied) if self.count is None else min(self.count, len(occupied))
        slots = sorted(moment.rng.permutation(occupied)[:count].tolist())
        return store.rearranged(slots, [_content(donor, their[slot]) for slot in slots])


@INTERVENTIONS.register("delay")
@dataclass(frozen=True)
class Delay(Intervention):
    """All entries seem to be from `frames` later, the current one too: a clock that runs ahead.
    Negative: behind.

    Of banks that count chunks, so many chunks.
    """

    frames: int = 64
    dial: ClassVar = "frames"
    needs: ClassVar = frozenset({"entries", "clock"})

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        shifted = [
            None if e is None else replace(e, time=e.time + self.frames) for e in store.entries
        ]
        return replace(store, entries=tuple(shifted))


@INTERVENTIONS.register("recent")
@dataclass(frozen=True)
class Recent(Intervention):
    """The memory chooses among the last `frames` frames alone, at the times at which they were."""

    frames: PositiveInt = 64
    dial: ClassVar = "frames"
    needs: ClassVar = frozenset({"entries", "choice"})

    def only(self, moment: Moment) -> np.ndarray | None:
        inside = moment.stored[moment.stored > moment.now - self.frames]
        return inside if len(inside) else moment.stored[-1:]


@INTERVENTIONS.register("oracle")
@dataclass(frozen=True)
class Oracle(Intervention):
    """The memory chooses among the frames at which a sub-task began, the last of the video and the
    newest.
    """

    needs: ClassVar = frozenset({"entries", "choice", "boundaries"})

    def only(self, moment: Moment) -> np.ndarray | None:
        past = [frame for frame in moment.boundaries if frame <= moment.now]
        at = np.searchsorted(moment.stored, past, side="right") - 1
        return moment.stored[np.unique(np.append(np.maximum(at, 0), len(moment.stored) - 1))]


@INTERVENTIONS.register("pause")
@dataclass(frozen=True)
class Pause(Intervention):
    """One frame is repeated `frames` times more: `repeat_frame`. `at`: which, from the first
    execution frame on.
    """

    frames: NonNegativeInt = 64
    at: NonNegativeInt = 0
    dial: ClassVar = "frames"
    needs: ClassVar = frozenset({"pauses"})

    def feed(self, feed: Feed) -> Feed:
        return replace(feed, transforms=(*feed.transforms, RepeatFrame(self.frames, self.at)))


@dataclass(frozen=True)
class Transform(Intervention):
    """A history transform (`mme_vla.memory.transforms`), as training applies it, on the frames of a
    running episode.
    """

    transform: HistoryTransform

    @property
    def dial(self) -> str | None:  # type: ignore[override]
        return self.transform.dial

    @property
    def needs(self) -> frozenset[str]:  # type: ignore[override]
        changes = type(self.transform).perturb is not HistoryTransform.perturb
        return frozenset({"entries"} if changes else {"pauses"})

    def feed(self, feed: Feed) -> Feed:
        return replace(feed, transforms=(*feed.transforms, self.transform))

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        if "entries" not in self.needs:
            return store
        slots = store.occupied
        views: dict[int, _Perturbed] = {}
        contents: list[Any] = []
        for content in (_content(store, slot) for slot in slots):
            if isinstance(content, Tensor):
                rows = self.transform.perturb(content.reshape(-1, content.shape[-1]), moment.rng)
                contents.append(rows.reshape(content.shape))
            else:  # a frame of a history
                view, frame = content
                contents.append(
                    (
                        views.setdefault(id(view), _Perturbed(view, self.transform, moment.rng)),
                        frame,
                    )
                )
        return store.rearranged(slots, contents)


class _Perturbed(History):
    """A history whose tokens a transform perturbs as they are gathered."""

    def __init__(
        self, source: History, transform: HistoryTransform, rng: np.random.Generator
    ) -> None:
        super().__init__(source.spec, source.exec_start)
        self._source, self._transform, self._rng = source, transform, rng

    def __len__(self) -> int:
        return len(self._source)

    def gather(self, indices: np.ndarray) -> Tensor:
        return self._transform.perturb(self._source.gather(indices), self._rng)


@INTERVENTIONS.register("distract")
@dataclass(frozen=True)
class Distract(Intervention):
    """So many unrelated recorded episodes are seen first, as if they were part of the video."""

    sessions: NonNegativeInt = 1
    dial: ClassVar = "sessions"
    needs: ClassVar = frozenset({"recordings"})

    def feed(self, feed: Feed) -> Feed:
        return replace(feed, sessions=feed.sessions + self.sessions)


@INTERVENTIONS.register("nodemo")
@dataclass(frozen=True)
class NoDemo(Intervention):
    """The conditioning video is not shown."""

    def feed(self, feed: Feed) -> Feed:
        return replace(feed, video=False)


def _content(store: Remembered, slot: int) -> Any:
    entry = store.entries[slot]
    assert entry is not None
    return entry.content


def _ranked(store: Remembered, which: str, moment: Moment) -> list[int]:
    """Slots that hold something, those to be taken first at the beginning."""
    slots = store.occupied

    def used() -> list[int]:
        if moment.weigh is None:
            raise UserError("drop.which=used needs a policy to ask, and here is none.")
        weights = moment.weigh(store)
        return sorted(slots, key=lambda slot: -weights[slot])

    orders: Mapping[str, Callable[[], list[int]]] = {
        "oldest": lambda: sorted(slots, key=lambda slot: -store.age(slot)),
        "newest": lambda: sorted(slots, key=store.age),
        "random": lambda: moment.rng.permutation(slots).tolist(),
        "used": used,
    }
    return orders[which]()


_ORDINALS = (
    "first",
    "second",
    "third",
    "fourth",
    "fifth",
    "sixth",
    "seventh",
    "eighth",
    "ninth",
    "tenth",
)
_NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
# points are read, and left alone
_COUNT = re.compile(rf"<[^>]*>|\b(?:{'|'.join((*_ORDINALS, *_NUMBERS))}|\d+)\b")


@INTERVENTIONS.register("subgoal_swap")
@dataclass(frozen=True)
class SubgoalSwap(Intervention):
    """The subgoal of another recorded episode that is as far along."""

    needs: ClassVar = frozenset({"subgoal", "recordings"})

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        return subgoal if moment.donor_subgoal is None else moment.donor_subgoal


@INTERVENTIONS.register("subgoal_delay")
@dataclass(frozen=True)
class SubgoalDelay(Intervention):
    """The subgoal of `decisions` chunks ago; the first one until then."""

    decisions: PositiveInt = 2
    dial: ClassVar = "decisions"
    needs: ClassVar = frozenset({"subgoal"})

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        return (
            moment.subgoals[max(len(moment.subgoals) - 1 - self.decisions, 0)]
            if moment.subgoals
            else subgoal
        )


@INTERVENTIONS.register("subgoal_count")
@dataclass(frozen=True)
class SubgoalCount(Intervention):
    """Every count in the subgoal is wrong by `by`: `for the first time` becomes
    `for the second time`.
    """

    by: int = 1
    dial: ClassVar = "by"
    needs: ClassVar = frozenset({"subgoal"})

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        return None if subgoal is None else _COUNT.sub(self._wrong, subgoal)

    def _wrong(self, match: re.Match[str]) -> str:
        word = match[0]
        for words in (_ORDINALS, _NUMBERS):
            if word in words:
                return words[(words.index(word) + self.by) % len(words)]
        return str(max(int(word) + self.by, 0)) if word.isdigit() else word
