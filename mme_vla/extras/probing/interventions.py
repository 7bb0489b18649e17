"""The perturbations of what a policy remembers, of its subgoal, and of which episodes it is shown.

Each is a small class with a dial; the base class and the others are in `memory/perturbation.py`.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np
from torch import Tensor

from mme_vla.config.sections import NonNegativeInt, PositiveInt
from mme_vla.errors import UserError, counted
from mme_vla.extras.probing.channels import Remembered
from mme_vla.extras.probing.recordings import Recording
from mme_vla.memory.history import DerivedHistory, History
from mme_vla.memory.perturbation import Perturbation
from mme_vla.registry import PERTURBATIONS

NEEDS = {
    "entries": "something remembered that the probe can reach",
    "choice": "a memory that chooses among stored frames",
    "clock": "entries that have a time",
    "pauses": "a memory that sees frames at which nothing is decided",
    "subgoal": "a policy that reads subgoals",
    "recordings": "recorded episodes to take from: name them with recordings=…",
    "stream": "a robot without depth",
    "goals": "recorded episodes with several goals",
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

    rng: of this episode, this step and this intervention alone.
    now: the current frame, as observed.
    stored: stored frames up to now, ascending.
    boundaries: frames at which a sub-task began.
    subgoals: earlier ones, the current one last.
    donor: the store of a name of another episode that is as far along.
    donor_subgoal: the subgoal there.
    weigh: for each slot of a store, by how much the chunk changes without it.
    exec_start: the first execution frame; of a video that is not over, the frame after it.
    donor_recording: another recorded episode.
    donor_goal: the goal of one that has another goal.
    """

    rng: np.random.Generator
    now: int = 0
    stored: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    boundaries: Sequence[int] = ()
    subgoals: Sequence[str | None] = ()
    donor: Callable[[str], Remembered] = _nothing
    donor_subgoal: str | None = None
    weigh: Callable[[Remembered], np.ndarray] | None = None
    exec_start: int = 0
    donor_recording: Recording | None = None
    donor_goal: str | None = None


@PERTURBATIONS.register("shuffle")
@dataclass(frozen=True)
class Shuffle(Perturbation):
    """The contents of all entries change places; their times and slots stay where they are."""

    needs: ClassVar = frozenset({"entries"})

    @property
    def meaning(self) -> str:
        return "what is remembered changes places, the times stay"

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        slots = store.occupied
        order = moment.rng.permutation(slots)
        return store.rearranged(slots, [_content(store, int(slot)) for slot in order])


@PERTURBATIONS.register("drop")
@dataclass(frozen=True)
class Drop(Perturbation):
    """Some entries are taken away; the others keep their time, and their slot where each is read by
    itself (`channels.without_gaps`): a recurrent memory reads on as if it had not read them.

    count: how many; None takes all.
    which: the `oldest`, the `newest`, at `random`, or the most `used`, those whose absence changes
        the chunk most (an attention that any integration has).
    """

    count: PositiveInt | None = 1
    which: Literal["oldest", "newest", "random", "used"] = "random"
    dial: ClassVar = "count"
    needs: ClassVar = frozenset({"entries"})

    @property
    def meaning(self) -> str:
        if self.count is None:
            return "everything remembered is removed"
        entries = "entry" if self.count == 1 else "entries"
        kind = "most used" if self.which == "used" else self.which
        return f"{self.count} {entries} removed: {kind}"

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        slots = store.occupied
        if self.which == "oldest":
            slots = sorted(slots, key=lambda slot: -store.age(slot))
        elif self.which == "newest":
            slots = sorted(slots, key=store.age)
        elif self.which == "random":
            slots = moment.rng.permutation(slots).tolist()
        elif moment.weigh is None:
            raise UserError("drop.which=used needs a policy to ask, and here is none.")
        else:
            weights = moment.weigh(store)
            slots = sorted(slots, key=lambda slot: -weights[slot])
        return store.without(slots[: self.count])


@PERTURBATIONS.register("swap")
@dataclass(frozen=True)
class Swap(Perturbation):
    """Entries hold what an entry of another recorded episode holds that is as far along; times
    stay.

    count: how many, at random; None swaps all.
    """

    count: PositiveInt | None = None
    dial: ClassVar = "count"
    needs: ClassVar = frozenset({"entries", "recordings"})

    @property
    def meaning(self) -> str:
        if self.count is None:
            return "what is remembered is of another episode, the times stay"
        return f"of what is remembered, {self.count} at random is of another episode"

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        occupied = store.occupied
        donor = moment.donor(store.name)
        if not donor.occupied or not occupied:
            return store
        # Each is paired with what stands as far along the donor, over all entries, so that a part
        # of them is swapped as it would be among all.
        pairs = np.linspace(0, len(donor.occupied) - 1, len(occupied)).round().astype(int).tolist()
        slot_of_donor = {slot: donor.occupied[at] for slot, at in zip(occupied, pairs, strict=True)}
        slots = sorted(moment.rng.permutation(occupied)[: self.count].tolist())
        contents = [_content(donor, slot_of_donor[slot]) for slot in slots]
        return store.rearranged(slots, contents)


@PERTURBATIONS.register("delay")
@dataclass(frozen=True)
class Delay(Perturbation):
    """The clock runs `frames` ahead: all entries seem to be from later, and the current frame too,
    so that ages stay. Negative: behind.

    Of banks that count chunks, so many chunks.
    """

    frames: int = 64
    dial: ClassVar = "frames"
    needs: ClassVar = frozenset({"entries", "clock"})

    @property
    def meaning(self) -> str:
        direction = "earlier" if self.frames < 0 else "later"
        frames = counted(abs(self.frames), "frame")
        return f"every entry seems to be {frames} {direction} than it was"

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        shifted = list(store.entries)
        for slot in store.occupied:
            entry = shifted[slot]
            assert entry is not None
            shifted[slot] = replace(entry, time=entry.time + self.frames)
        return replace(store, entries=tuple(shifted), now=store.now + self.frames)


@PERTURBATIONS.register("recent")
@dataclass(frozen=True)
class Recent(Perturbation):
    """The memory chooses among the last `frames` frames alone, at the times at which they were."""

    frames: PositiveInt = 64
    dial: ClassVar = "frames"
    needs: ClassVar = frozenset({"entries", "choice"})

    @property
    def meaning(self) -> str:
        if self.frames == 1:
            return "only the last frame can be remembered"
        return f"only the last {self.frames} frames can be remembered"

    def only(self, moment: Moment) -> np.ndarray | None:
        inside = moment.stored[moment.stored > moment.now - self.frames]
        return inside if len(inside) else moment.stored[-1:]


@PERTURBATIONS.register("oracle")
@dataclass(frozen=True)
class Oracle(Perturbation):
    """The memory chooses among the frames at which a sub-task began, the last of the video and the
    newest.
    """

    needs: ClassVar = frozenset({"entries", "choice", "boundaries"})

    @property
    def meaning(self) -> str:
        return "only the frames where sub-tasks begin can be remembered"

    def only(self, moment: Moment) -> np.ndarray | None:
        past = [frame for frame in moment.boundaries if frame <= moment.now]
        at = np.searchsorted(moment.stored, past, side="right") - 1
        return moment.stored[np.unique(np.append(np.maximum(at, 0), len(moment.stored) - 1))]


@PERTURBATIONS.register("distract")
@dataclass(frozen=True)
class Distract(Perturbation):
    """So many unrelated recorded episodes are seen first, as if they were part of the video."""

    sessions: NonNegativeInt = 1
    dial: ClassVar = "sessions"
    needs: ClassVar = frozenset({"recordings"})

    @property
    def meaning(self) -> str:
        others = "another episode" if self.sessions == 1 else f"{self.sessions} other episodes"
        return f"{others} first, as if part of this one"

    @property
    def n_sessions(self) -> int:
        return self.sessions


@PERTURBATIONS.register("nodemo")
@dataclass(frozen=True)
class NoDemo(Perturbation):
    """The conditioning video is not shown."""

    shows_video: ClassVar = False

    @property
    def meaning(self) -> str:
        return "the video before the episode is not shown"


class _Perturbed(DerivedHistory):
    """A history whose tokens, proprioception and actions are perturbed as they are read."""

    def __init__(
        self, source: History, perturbation: Perturbation, rng: np.random.Generator
    ) -> None:
        super().__init__(source)
        self._perturbation = perturbation
        self._rng = rng
        if source.motion is not None:
            self.motion = self._motion

    def _motion(self, frames: np.ndarray) -> Tensor:
        return self._perturbation.perturb(self._source.motion_rows(frames), self._rng)

    def gather(self, indices: np.ndarray) -> Tensor:
        return self._perturbation.perturb(self._source.gather(indices), self._rng)


def perturb_store(
    store: Remembered, perturbation: Perturbation, rng: np.random.Generator
) -> Remembered:
    """The store with the contents of all entries perturbed (`Perturbation.perturb`)."""
    slots = store.occupied
    views: dict[int, _Perturbed] = {}
    contents: list[Any] = []
    for slot in slots:
        content = _content(store, slot)
        if isinstance(content, Tensor):
            rows = perturbation.perturb(content.reshape(-1, content.shape[-1]), rng)
            contents.append(rows.reshape(content.shape))
        else:
            view, frame = content  # a frame of a history
            if id(view) not in views:
                views[id(view)] = _Perturbed(view, perturbation, rng)
            contents.append((views[id(view)], frame))
    return store.rearranged(slots, contents)


def _content(store: Remembered, slot: int) -> Any:
    entry = store.entries[slot]
    assert entry is not None
    return entry.content


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


@PERTURBATIONS.register("subgoal_swap")
@dataclass(frozen=True)
class SubgoalSwap(Perturbation):
    """The subgoal of another recorded episode that is as far along."""

    needs: ClassVar = frozenset({"subgoal", "recordings"})

    @property
    def meaning(self) -> str:
        return "the subgoal is that of another episode"

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        return subgoal if moment.donor_subgoal is None else moment.donor_subgoal


@PERTURBATIONS.register("subgoal_delay")
@dataclass(frozen=True)
class SubgoalDelay(Perturbation):
    """The subgoal of `decisions` chunks ago; the first one until then."""

    decisions: PositiveInt = 2
    dial: ClassVar = "decisions"
    needs: ClassVar = frozenset({"subgoal"})

    @property
    def meaning(self) -> str:
        return f"the subgoal is the one of {counted(self.decisions, 'chunk')} ago"

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        if not moment.subgoals:
            return subgoal
        return moment.subgoals[max(len(moment.subgoals) - 1 - self.decisions, 0)]


@PERTURBATIONS.register("subgoal_count")
@dataclass(frozen=True)
class SubgoalCount(Perturbation):
    """Every count in the subgoal is wrong by `by`: `for the first time` becomes
    `for the second time`.
    """

    by: int = 1
    dial: ClassVar = "by"
    needs: ClassVar = frozenset({"subgoal"})

    @property
    def meaning(self) -> str:
        return f"every count in the subgoal is wrong by {self.by}"

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        return None if subgoal is None else _COUNT.sub(self._wrong, subgoal)

    def _wrong(self, match: re.Match[str]) -> str:
        word = match[0]
        for words in (_ORDINALS, _NUMBERS):
            if word in words:
                return words[(words.index(word) + self.by) % len(words)]
        return str(max(int(word) + self.by, 0)) if word.isdigit() else word
