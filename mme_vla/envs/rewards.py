"""Rewards, which the benchmark has none of: what an episode has earned so far, and so what a step adds to it."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from mme_vla.errors import UserError, did_you_mean

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
    """How a reward counts.

    Raises:
        UserError: no such reward.
    """
    if reward not in REWARDS:
        raise UserError(f"Unknown reward {reward!r}. {did_you_mean(str(reward), REWARDS)}")
    return REWARDS[reward]
