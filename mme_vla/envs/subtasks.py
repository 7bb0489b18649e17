"""The ordered list of sub-tasks an episode consists of, and the pointer that walks over it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mme_vla.envs.robot.stick_skills import Demonstrator
    from mme_vla.envs.scene.things import Thing


ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def ordinal(index: int) -> str:
    """Return `first` for 0, `second` for 1, and so on; figures from `11th` on."""
    if index < len(ORDINALS):
        return ORDINALS[index]
    count = index + 1
    teens = 10 < count % 100 < 14
    return f"{count}{'th' if teens else {1: 'st', 2: 'nd', 3: 'rd'}.get(count % 10, 'th')}"


def number(count: int) -> str:
    """Return `one` for 1, `two` for 2, and so on; figures from 11 on."""
    return NUMBERS[count] if count < len(NUMBERS) else str(count)


NO_RECORD = "NO RECORD"
"""Text of the stretches that belong to no sub-task: their frames are neither stored nor shown."""
COMPLETED = "All tasks completed"
OPERATIONS = ("which", "where", "how many", "order", "how")
"""What a sub-task can ask of memory."""


@dataclass(frozen=True, eq=False)
class SubTask:
    """One step of an episode: what is said, when it is done, when it has failed, and how it is demonstrated."""

    text: str
    """Without coordinates."""
    done: Callable[[], bool]
    run: Callable[["Demonstrator"], None]
    """Demonstrates the sub-task."""
    grounded: str = ""
    """With a `<>` for each target's pixel; empty: the same as `text`."""
    failed: Callable[[], bool] | None = None
    targets: Sequence["Thing"] = ()
    """The objects whose pixels fill the `<>`, in order; several may stand for one place if there is one `<>`."""
    choice: str = ""
    """Letter of the multi-choice option that does this; empty where there is none."""
    video: bool = False
    """Belongs to the conditioning video."""
    pick: bool = False
    """A grasp from the table: what a recovery demonstration may fail once."""
    operation: str | Callable[[], str] = ""
    """Of `OPERATIONS`, what is mistaken where this fails; empty for a motion. Asked at the moment of the failure."""

    @property
    def grounded_text(self) -> str:
        """The text with places for coordinates."""
        return self.grounded or self.text


class Progress:
    """Which sub-task an episode is at.

    At every evaluation, once a step after the physics: first the present sub-task's failure, then, if there was none,
    its completion, upon which the pointer moves on by exactly one.
    """

    def __init__(self, subtasks: Sequence[SubTask], latch_failure: bool) -> None:
        self.subtasks = list(subtasks)
        self.index = 0
        self.planned = 0
        """The demonstrator's view of the pointer: moves only when a sub-task's routine has ended."""
        self.failed = False
        self.mistaken = ""
        """What the last failure was a mistake of: one of `OPERATIONS`, or empty."""
        self._latch = latch_failure

    def update(self, failed: bool = False) -> None:
        """Evaluate once; `failed` is what the task itself, whatever the sub-task, says of failure."""
        if not self._latch:
            self.failed = False
        if self.succeeded:  # and stays so, whatever happens next
            return
        now, before = self.subtasks[self.index], self.failed
        self.failed = self.failed or failed or (now.failed is not None and now.failed())
        if self.failed and not before:
            self.mistaken = now.operation if isinstance(now.operation, str) else now.operation()
        if not self.failed and now.done():
            self.index += 1

    @property
    def current(self) -> SubTask | None:
        """The sub-task the pointer is at; None when all are done."""
        return None if self.succeeded else self.subtasks[self.index]

    @property
    def to_come(self) -> Sequence[SubTask]:
        """The sub-tasks that are not done, the current one first."""
        return self.subtasks[self.index :]

    @property
    def displayed(self) -> SubTask:
        """The sub-task whose text is reported online: the current one, and at the end the last one."""
        return self.subtasks[min(self.index, len(self.subtasks) - 1)]

    @property
    def demonstrated(self) -> SubTask:
        """The sub-task the demonstrator is at; at the end the last one."""
        return self.subtasks[min(self.planned, len(self.subtasks) - 1)]

    @property
    def succeeded(self) -> bool:
        """Whether every sub-task is done."""
        return self.index >= len(self.subtasks)
