"""What an episode shows and needs later: the one vocabulary of every environment.

A fact has a name and a value, the frames that show it, the frames at which a decision depends on
it, and the frame at which another fact replaced it. Frames are counted from the first of the
conditioning video.
"""

import csv
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mme_vla.utils import write_atomically
from mme_vla.utils.validation import validated

if TYPE_CHECKING:
    from mme_vla.envs.subtasks import Progress

KEY_POSE = 16
"""Frames after the end of a sub-task in which its result is visible, before the arm has left."""
COLUMNS = ("episode", "task", "fact", "value", "from", "to", "needed", "changed")
"""Of the table beside a recording."""


@dataclass(frozen=True)
class Fact:
    """Something that frames of an episode show and that it needs later.

    name: of the fact; one that is shown again after a gap has two entries.
    value: what a scene with another value of this fact would have differently.
    frames: the first and the last frame that show it.
    needed: frames at which a decision begins that depends on it, ascending.
    changed: the first frame that shows a fact which replaces it, or moves what it is about; None
        where there is none.
    """

    name: str
    value: str
    frames: tuple[int, int]
    needed: tuple[int, ...] = ()
    changed: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """The fact in plain values."""
        return {
            "name": self.name,
            "value": self.value,
            "frames": list(self.frames),
            "needed": list(self.needed),
            "changed": self.changed,
        }


def read_facts(values: object, file: str) -> list[Fact]:
    """The facts in a file, of each of which it has what `to_dict` returned.

    Raises:
        UserError: they are none.
    """
    where = f"{file}: facts"
    return validated(list[Fact], values, where, where, strict=True)


@dataclass(frozen=True)
class Candidates:
    """What the robot's next motion can go to, where the facts so far decide which is correct.

    places: [n, d], in metres or any unit of the environment.
    correct: indices of the places that the facts name.
    """

    places: Sequence[Sequence[float]]
    correct: Sequence[int]


@dataclass(frozen=True)
class VisibleFact:
    """A fact that the current frame shows.

    subjects: names of what it is about.
    replaces: what earlier facts said about any of these does not hold any more.
    """

    value: str
    subjects: Set[str] = frozenset()
    replaces: bool = False


class FactLog:
    """The facts of a running episode, made from what each of its frames shows."""

    def __init__(self) -> None:
        self.facts: list[Fact] = []
        self._subjects: list[Set[str]] = []
        self.n_frames = 0

    def add(self, visible: Mapping[str, VisibleFact], decides: bool = False) -> None:
        """Add the next frame.

        Args:
            visible: name → what the frame shows of that fact.
            decides: a decision begins here that depends on all facts so far.
        """
        frame = self.n_frames
        for name, current in visible.items():
            if self._extend(name, current.value):
                continue
            if current.replaces:
                for i, fact in enumerate(self.facts):
                    if fact.changed is None and self._subjects[i] & current.subjects:
                        self.facts[i] = replace(fact, changed=frame)
            self.facts.append(Fact(name, current.value, (frame, frame)))
            self._subjects.append(current.subjects)
        if decides:
            self.facts = [replace(fact, needed=(*fact.needed, frame)) for fact in self.facts]
        self.n_frames += 1

    def _extend(self, name: str, value: str) -> bool:
        """Add the frame to the fact that the frame before showed; whether it did."""
        for i, fact in enumerate(self.facts):
            first, last = fact.frames
            if (fact.name, fact.value, last) == (name, value, self.n_frames - 1):
                self.facts[i] = replace(fact, frames=(first, self.n_frames))
                return True
        return False


class TaskFacts:
    """The facts of a running RoboMME task, from its script and the simulator.

    Args:
        task: has been reset; it is read at each frame.
    """

    def __init__(self, task: Any) -> None:
        self._task = task
        self._log = FactLog()
        self._ended: dict[int, int] = {}  # number of a sub-task → the first frame after its end
        self._begun = -1  # the newest sub-task of the execution that has begun

    @property
    def facts(self) -> Sequence[Fact]:
        """Those of all frames so far."""
        return self._log.facts

    def add(self, in_video: bool) -> None:
        """Add the next frame, which belongs to the conditioning video or to the execution."""
        progress: Progress = self._task.progress
        for i in range(len(self._ended), progress.index):
            self._ended[i] = self._log.n_frames
        recent = {}
        for i, ended in self._ended.items():
            subtask = progress.subtasks[i]
            # Once the execution begins, the arm is elsewhere than at the end of the video.
            is_visible = subtask.video <= in_video
            if self._log.n_frames - ended < KEY_POSE and is_visible:
                recent[i] = subtask
        # A decision depends on memory where a sub-task begins that fails if something is forgotten.
        decides = False
        current = progress.current
        if current is not None and not in_video and progress.index > self._begun:
            self._begun = progress.index
            decides = bool(current.operation)
        self._log.add(self._task.visible_facts(recent), decides)


def write_facts(path: Path, episodes: Iterable[tuple[int, str, Sequence[Fact]]]) -> None:
    """Write the table of a recording as CSV, one row a fact, with `COLUMNS`.

    Args:
        path: of the table, which appears whole.
        episodes: of each its number in the recording, its task and its facts.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for number, task, facts in episodes:
            for fact in facts:
                needed = " ".join(map(str, fact.needed))
                changed = "" if fact.changed is None else fact.changed
                table.writerow([number, task, fact.name, fact.value, *fact.frames, needed, changed])
