"""A whole demonstration: every sub-task of a task in turn, as the official data were recorded."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mme_vla.envs.robot.demonstrator import Demonstrator

if TYPE_CHECKING:
    from mme_vla.envs.subtasks import SubTask
    from mme_vla.envs.task import Task


def demonstrate(env: "Task", demonstrator: Demonstrator, subtasks: Sequence["SubTask"] | None = None) -> bool:
    """Perform the sub-tasks of a task that has just been reset, evaluating before and after each one.

    The demonstrator's view of where the episode stands, `env.progress.planned`, moves at these evaluations only. In a
    recovery demonstration the drawn pick of the execution fails once first.

    Args:
        env: the task; while this runs, `env.recording` is set.
        demonstrator: of the same task. Its steps are where frames are taken, its waypoints where they are noted.
        subtasks: what to perform; by default all of the task's.

    Returns:
        Whether the task succeeded.

    Raises:
        PlanningError: a motion could not be planned.
    """
    subtasks = env.progress.subtasks if subtasks is None else subtasks
    picks = [subtask for subtask in subtasks if subtask.pick and not subtask.video]
    recording, env.recording = env.recording, True
    try:
        ended = _ended(env)
        for subtask in subtasks:
            if ended or _ended(env):
                break
            if env.recovery and env.failed_pick is not None and subtask in picks:
                failing = picks.index(subtask) == env.failed_pick
                demonstrator.fail_next_pick = env.recovery if failing else None
            subtask.run(demonstrator)
            ended = _ended(env)
    finally:
        env.recording = recording
    return env.success() and not env.progress.failed


def _ended(env: "Task") -> bool:
    """Evaluate once, as a recorder does between sub-tasks; whether the episode is over."""
    env.evaluate()
    env.progress.planned = env.progress.index
    return env.progress.succeeded or env.progress.failed
