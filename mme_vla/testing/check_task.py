"""`check_task`: is a task of one's own deterministic, solvable by its own demonstration, and
complete?
"""

from typing import Any

import numpy as np

from mme_vla.envs.make import make_task
from mme_vla.errors import counted


def check_task(task: str, seed: int = 1, difficulty: str | None = None, **options: Any) -> None:
    """Run every check on the task that is registered under `task`, and print a line for each that
    passed.

    Nothing is rendered.

    Args:
        task: the key in `TASKS`.
        seed, difficulty: of the scene.
        options: the task's own keywords.
    """
    first, second = (_demonstrated(task, seed, difficulty, options) for _ in range(2))
    assert first["goal"], "goals() must give at least one wording."
    assert all(isinstance(goal, str) and goal for goal in first["goal"]), (
        "every wording of the goal is a text."
    )
    assert first["subtasks"] > 0, "subtasks() must give at least one sub-task."
    assert first["success"], (
        f"the task's own sub-tasks, demonstrated with seed {seed}, do not end in success."
    )
    n_subtasks = counted(first["subtasks"], "sub-task")
    print(f"{task}: {n_subtasks}, demonstrated with seed {seed}: success")
    assert np.array_equal(first["qpos"], second["qpos"]), (
        "two demonstrations of one seed differ: a draw is not seeded."
    )
    print(f"{task}: a second demonstration moves the robot in the same way")
    other = _scene(task, seed + 1, difficulty, options)
    same = _scene(task, seed, difficulty, options)
    assert np.array_equal(same, _scene(task, seed, difficulty, options)), (
        "one seed built two different scenes."
    )
    assert same.shape != other.shape or not np.array_equal(same, other), (
        "two seeds built the same scene."
    )
    print(f"{task}: a seed builds one scene, and seed {seed + 1} another")


def _scene(task: str, seed: int, difficulty: str | None, options: dict[str, Any]) -> np.ndarray:
    """Where every object stands after a reset [things, 3]."""
    env = make_task(task, render=False, seed=seed, difficulty=difficulty, **options)
    try:
        env.reset()
        return np.array([thing.position for thing in env.unwrapped.things])
    finally:
        env.close()


def _demonstrated(
    task: str, seed: int, difficulty: str | None, options: dict[str, Any]
) -> dict[str, Any]:
    from mme_vla.envs.robomme.recording.recorder import demonstrate
    from mme_vla.envs.robomme.robot.demonstrator import Demonstrator

    env = make_task(task, render=False, seed=seed, difficulty=difficulty, **options)
    try:
        env.reset()
        track: list[np.ndarray] = []
        script = env.unwrapped
        script.on_frame = lambda info: track.append(script.qpos)
        done = demonstrate(script, Demonstrator(script, env.step))
        return {
            "goal": script.goals(),
            "subtasks": len(script.progress.subtasks),
            "success": bool(done),
            "qpos": np.array(track),
        }
    finally:
        env.close()
