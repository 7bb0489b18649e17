"""`check_task`: is a task of one's own deterministic, solvable by its own demonstration alone, and
complete?
"""

from contextlib import closing
from typing import Any

import numpy as np

from mme_vla.envs.make import make_task
from mme_vla.errors import SceneError, counted

SEEDS = 8
"""Scenes that are built twice: an order of two sub-tasks that no seed decides differs in one of
them.
"""


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
    assert len(first["qpos"]), (
        "the demonstration is a success without one step of the robot: `run` of a sub-task must"
        " move it, and `done` be True only afterwards."
    )
    n_subtasks = counted(first["subtasks"], "sub-task")
    check_standing(task, seed, difficulty, options)
    print(f"{task}: {n_subtasks}, demonstrated with seed {seed}: success")
    assert np.array_equal(first["qpos"], second["qpos"]), (
        "two demonstrations of one seed differ: a draw is not seeded."
    )
    print(f"{task}: a second demonstration moves the robot in the same way")
    check_seeds(task, seed, difficulty, options)
    print(f"{task}: a seed builds one scene, and seed {seed + 1} another")
    check_choices(task, seed, difficulty, options)
    print(f"{task}: every option of choices() can be carried out")


def check_standing(task: str, seed: int, difficulty: str | None, options: dict[str, Any]) -> None:
    """A robot that stands still for a step more than there are sub-tasks does not succeed."""
    with closing(make_task(task, render=False, seed=seed, difficulty=difficulty, **options)) as env:
        env.reset()
        script = env.unwrapped
        for _ in range(len(script.progress.subtasks) + 1):
            env.step(script.reset_action)
        assert not script.success(), (
            "the episode is a success though the robot stands still: `done` of a sub-task must"
            " follow from what the robot does."
        )


def check_seeds(task: str, seed: int, difficulty: str | None, options: dict[str, Any]) -> None:
    """Scene, goal, sub-tasks and options follow from the seed, and differ between seeds."""
    places = []
    for number in range(seed, seed + SEEDS):
        scene, again = (_scene(task, number, difficulty, options) for _ in range(2))
        for name, value in scene.items():
            assert value == again.get(name), (
                f"two scenes of seed {number} differ in {name}: sample every random number from"
                f" `draws`. They are {value} and {again.get(name)}."
            )
        places.append(scene["the places of objects"])
    assert places[0] != places[1], "two seeds built the same scene."


def _scene(
    task: str, seed: int, difficulty: str | None, options: dict[str, Any]
) -> dict[str, list[Any]]:
    """What a seed decides, after a reset."""
    try:
        env = make_task(task, render=False, seed=seed, difficulty=difficulty, **options)
    except SceneError:  # of this seed objects find no place
        return {"the places of objects": []}
    with closing(env):
        env.reset()
        script = env.unwrapped
        subtasks = []
        for subtask in script.progress.subtasks:
            targets = [thing.name for thing in subtask.targets]
            subtasks.append((subtask.text, subtask.grounded_text, subtask.choice, targets))
        return {
            "the places of objects": [np.asarray(x.position).tolist() for x in script.things],
            "goals()": list(script.goals()),
            "subtasks()": subtasks,
            "choices()": [(choice.label, choice.action) for choice in script.choices()],
        }


def check_choices(task: str, seed: int, difficulty: str | None, options: dict[str, Any]) -> None:
    """There are options, one for every letter that a sub-task names, and none raises an error."""
    from mme_vla.envs.robomme.robot.control import PlanningError
    from mme_vla.envs.robomme.robot.demonstrator import Demonstrator

    with closing(make_task(task, render=False, seed=seed, difficulty=difficulty, **options)) as env:
        env.reset()
        script = env.unwrapped
        choices = list(script.choices())
        assert choices, "choices() must give at least one option."
        labels = [choice.label for choice in choices]
        assert len(set(labels)) == len(labels), (
            f"two options of choices() share a letter: {labels}."
        )
        named = {subtask.choice for subtask in script.progress.subtasks if subtask.choice}
        assert named <= set(labels), (
            f"sub-tasks name the options {sorted(named - set(labels))}, which choices() lacks:"
            f" {labels}."
        )
        for choice in choices:
            assert choice.candidates is None or len(choice.candidates), (
                f"option {choice.label!r} of choices() has no candidates: give objects, or None."
            )
            point = None if choice.candidates is None else choice.candidates[0]
            try:
                choice.run(Demonstrator(script, env.step), point)
            except PlanningError:  # from where the option before it has left the robot
                continue
            except Exception as error:
                raise AssertionError(
                    f"option {choice.label!r} of choices() ({choice.action}) raises"
                    f" {type(error).__name__}: {error}"
                ) from error


def _demonstrated(
    task: str, seed: int, difficulty: str | None, options: dict[str, Any]
) -> dict[str, Any]:
    from mme_vla.envs.robomme.recording.recorder import demonstrate
    from mme_vla.envs.robomme.robot.demonstrator import Demonstrator

    with closing(make_task(task, render=False, seed=seed, difficulty=difficulty, **options)) as env:
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
