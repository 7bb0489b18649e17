"""Where the chain of an episode's sub-tasks broke, and at what: an operation of memory, or a motion."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from mme_vla.envs.subtasks import OPERATIONS, Progress
from mme_vla.errors import UserError, brief, did_you_mean

if TYPE_CHECKING:
    from mme_vla.envs.subtasks import Progress


Earned = Callable[["Progress", bool], float]
"""Gets where the episode is, and whether it has succeeded."""


def _nothing(progress: "Progress", success: bool) -> float:
    return 0.0


def _success(progress: "Progress", success: bool) -> float:
    return float(success)


def _subtasks(progress: "Progress", success: bool) -> float:
    """The share of the execution's sub-tasks that are done; those of the conditioning video do not count."""
    mine = [i for i, subtask in enumerate(progress.subtasks) if not subtask.video]
    return sum(i < progress.index for i in mine) / len(mine)


REWARDS: dict[str, Earned] = {"none": _nothing, "sparse": _success, "subtask": _subtasks}
"""What an episode has earned, 0 to 1: always nothing, as in the benchmark; 1 for success; a share for each sub-task."""


def earned_by(reward: str) -> Earned:
    """How a reward counts."""
    if reward not in REWARDS:
        raise UserError(f"Unknown reward {reward!r}. {did_you_mean(str(reward), REWARDS)}")
    return REWARDS[reward]


MOTION = "motion"
BROKEN = ("wrong", "stuck")


@dataclass(frozen=True)
class ProcessScore:
    """How far an episode came.

    done, of: sub-tasks of the execution that are done, and how many there are.
    broke: `wrong`, where the environment saw the wrong thing done; `stuck`, where the time ran out; empty on success.
    operation: what the wrong thing was a mistake of: one of `OPERATIONS`, or a motion (a slip, or another object than
        the goal names). Of who is stuck nobody can tell whether they forgot or failed; then it is empty.
    subtask: the text of the one that was not done.
    """

    done: int
    of: int
    broke: str = ""
    operation: str = ""
    subtask: str = ""

    @property
    def forgot(self) -> bool:
        """Whether an operation of memory broke the chain."""
        return self.operation in OPERATIONS

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for records."""
        return asdict(self)

    @classmethod
    def from_dict(cls, value: Any) -> "ProcessScore":
        """Read what `to_dict` made."""
        try:
            score = cls(**value)
        except TypeError:
            score = None
        known = (MOTION, "", *OPERATIONS)
        if score is None or score.operation not in known or score.broke not in (*BROKEN, ""):
            raise UserError(f"process={brief(value)} of a record is no process score.")
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
