"""The sub-tasks of an episode, the pointer that walks over them, the options of multi-choice, and
the scores.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from mme_vla.embodiment.action_space import Option
from mme_vla.errors import brief, require
from mme_vla.registry import REWARDS
from mme_vla.utils.validation import validated

if TYPE_CHECKING:
    from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
    from mme_vla.envs.robomme.scene.things import Thing


ORDINALS = (
    "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth",
)  # fmt: skip
NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def ordinal(index: int) -> str:
    """Return `first` for 0, `second` for 1, and so on; figures from `11th` on."""
    if index < len(ORDINALS):
        return ORDINALS[index]
    count = index + 1
    ending = "th"
    if not 10 < count % 100 < 14:
        ending = {1: "st", 2: "nd", 3: "rd"}.get(count % 10, "th")
    return f"{count}{ending}"


def number(count: int) -> str:
    """Return `one` for 1, `two` for 2, and so on; figures from 11 on."""
    return NUMBERS[count] if count < len(NUMBERS) else str(count)


NO_RECORD = "NO RECORD"
"""Text of the stretches that belong to no sub-task: their frames are neither stored nor shown."""
COMPLETED = "All tasks completed"
OPERATIONS = ("which", "where", "how many", "order", "how")
"""What a sub-task can require of memory."""


@dataclass(frozen=True, eq=False)
class SubTask:
    """One step of an episode: its text, when it is done, when it has failed, and how it is
    demonstrated.
    """

    text: str
    """Without coordinates."""
    done: Callable[[], bool]
    run: Callable[["Demonstrator"], None]
    """Demonstrates the sub-task."""
    grounded: str = ""
    """With a `<>` for each target's pixel; empty: the same as `text`."""
    failed: Callable[[], bool] | None = None
    targets: Sequence["Thing"] = ()
    """The objects whose pixels fill the `<>`, in order; a single `<>` takes all of
    them together.
    """
    choice: str = ""
    """Letter of the multi-choice option that does this; empty where there is none."""
    video: bool = False
    """Belongs to the conditioning video."""
    pick: bool = False
    """A grasp from the table: what a recovery demonstration may fail once."""
    operation: str | Callable[[], str] = ""
    """Of `OPERATIONS`, what is mistaken where this fails; empty for a motion. A function is called
    at the failure.
    """

    @property
    def grounded_text(self) -> str:
        """The text with places for coordinates."""
        return self.grounded or self.text


@dataclass(frozen=True)
class Choice:
    """One option of the multi-choice action space: its letter (lower case), its text, and its
    motion.
    """

    label: str
    action: str
    run: Callable[["Demonstrator", Any], None]
    """Gets the object the point chose, or None where the option needs no point."""
    candidates: Sequence["Thing"] | None = None
    """Objects a point may choose among; an option with candidates needs a point."""

    @property
    def needs_point(self) -> bool:
        """Whether a pixel of the front image must come with the choice."""
        return self.candidates is not None

    @property
    def option(self) -> Option:
        """What a policy is told of it."""
        return Option(self.label, self.action, self.needs_point)


class Progress:
    """Which sub-task an episode is at.

    At every evaluation, once a step after the physics: first the present sub-task's failure, then,
    if there was none, its completion, upon which the pointer moves on by exactly one.
    """

    def __init__(self, subtasks: Sequence[SubTask], latch_failure: bool) -> None:
        self.subtasks = list(subtasks)
        self.index = 0
        self.planned = 0
        """The demonstrator's view of the pointer: moves only when a sub-task's routine
        has ended.
        """
        self.failed = False
        self.mistaken = ""
        """What the last failure was a mistake of: one of `OPERATIONS`, or empty."""
        self._latch = latch_failure

    def update(self, failed: bool = False) -> None:
        """Evaluate once; `failed` is what the task itself, whatever the sub-task, says
        of failure.
        """
        if not self._latch:
            self.failed = False
        if self.succeeded:  # and stays so, whatever happens next
            return
        subtask = self.subtasks[self.index]
        had_failed = self.failed
        self.failed = had_failed or failed or (subtask.failed is not None and subtask.failed())
        if self.failed and not had_failed:
            operation = subtask.operation
            self.mistaken = operation if isinstance(operation, str) else operation()
        if not self.failed and subtask.done():
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
        """The sub-task whose text is reported online: the current one, and at the end
        the last one.
        """
        return self.subtasks[min(self.index, len(self.subtasks) - 1)]

    @property
    def demonstrated(self) -> SubTask:
        """The sub-task the demonstrator is at; at the end the last one."""
        return self.subtasks[min(self.planned, len(self.subtasks) - 1)]

    @property
    def succeeded(self) -> bool:
        """Whether every sub-task is done."""
        return self.index >= len(self.subtasks)


# A reward is a function `(progress, success) -> float`: the return so far. A step's reward is what
# it adds.


@REWARDS.register("none")
def no_reward(progress: Progress, success: bool) -> float:
    """Always 0, as in the benchmark."""
    return 0.0


@REWARDS.register("sparse")
def success_reward(progress: Progress, success: bool) -> float:
    """1 with the step that succeeds."""
    return float(success)


@REWARDS.register("subtask")
def subtask_reward(progress: Progress, success: bool) -> float:
    """The share of the execution's sub-tasks that are done; those of the conditioning video do not
    count.
    """
    execution = [i for i, subtask in enumerate(progress.subtasks) if not subtask.video]
    return sum(i < progress.index for i in execution) / len(execution)


MOTION = "motion"
BROKEN = ("wrong", "stuck")


@dataclass(frozen=True)
class ProcessScore:
    """How far an episode came.

    done, of: sub-tasks of the execution that are done, and how many there are.
    broke: `wrong`, where the environment saw the wrong thing done; `stuck`, where the time ran out;
        empty on success.
    operation: what the wrong thing was a mistake of: one of `OPERATIONS`, or a motion (a slip, or
        another object than the goal names). Empty for `stuck`, whose cause is unknown.
    subtask: the text of the one that was not done.
    """

    done: int
    of: int
    broke: str = ""
    operation: str = ""
    subtask: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for records."""
        return asdict(self)

    @classmethod
    def from_dict(cls, value: Any) -> "ProcessScore":
        """Read what `to_dict` made."""
        where = "record.process"
        score = validated(cls, value, where, where, strict=True)
        kinds = {"broke": BROKEN, "operation": (MOTION, *OPERATIONS)}
        for name, known in kinds.items():
            word = getattr(score, name)
            require(
                word in ("", *known),
                f"{where}.{name}={brief(word)} must be empty or one of {', '.join(known)}.",
            )
        return score


def process_score(progress: Progress, status: str) -> ProcessScore:
    """The score of an episode that ended with this status."""
    execution = [subtask for subtask in progress.subtasks if not subtask.video]
    done = max(progress.index - (len(progress.subtasks) - len(execution)), 0)
    if status == "success":
        return ProcessScore(len(execution), len(execution))
    text = progress.displayed.text
    if status == "fail":
        return ProcessScore(done, len(execution), "wrong", progress.mistaken or MOTION, text)
    return ProcessScore(done, len(execution), "stuck", "", text)
