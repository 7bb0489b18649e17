"""Helpers of the tests of the four Unmask tasks."""

from collections.abc import Sequence

import numpy as np
import sapien

from mme_vla.envs.scene.articulated import Button
from mme_vla.envs.scene.objects import Container
from mme_vla.envs.scene.placement import CONTAINER_HALF, TRIALS, Draws, Region
from mme_vla.envs.scene.things import Thing
from mme_vla.envs.task import Task


def make(task: type[Task], seed: int, difficulty: str, **settings: object) -> Task:
    """The task in physics alone, reset."""
    env = task(seed=seed, difficulty=difficulty, obs_mode="none", render_backend="none", **settings)
    env.reset()
    return env


def wait(env: Task, steps: int = 1) -> tuple[bool, bool]:
    """Stand still; success and failure of the last step."""
    for _ in range(steps):
        *_, info = env.step(env.reset_action)
    return bool(info["success"]), bool(info["fail"])


def lift(env: Task, container: Thing) -> tuple[bool, bool]:
    """Put a container up in the air and do a step."""
    container.move_to(sapien.Pose([*container.position[:2], 0.25], container.pose.q))
    return wait(env)


def push_down(env: Task, button: Button) -> tuple[bool, bool]:
    """Press a button's cap into its base and do a step, after which it is still down."""
    button.articulation.set_qpos(np.full((1, 1), -0.1, np.float32))
    return wait(env)


def released(env: Task, button: Button) -> None:
    """Let a button come up again."""
    button.restore()
    wait(env)


def skip_place(draws: Draws, region: Region, container: Container) -> float:
    """Read from a stream the trials that end with a container's place, and its turn.

    Returns:
        The turn in radians.
    """
    for _ in range(TRIALS):
        if np.allclose(region.place(draws, CONTAINER_HALF), container.initial_pose.p[:2], atol=1e-6):
            return float(np.deg2rad(90 * draws.uniform()))
    raise AssertionError(f"{container.name} does not stand where one of {TRIALS} trials would put it")


def yaw_of(thing: Thing) -> float:
    """By how much an upside-down thing was turned about its own vertical, radians."""
    _, x, y, _ = thing.initial_pose.q
    return float(2 * np.arctan2(-y, x))


def names(draws: Draws) -> list[str]:
    """Read the shuffled colours of the cubes from a stream."""
    return [("red", "green", "blue")[i] for i in draws.permutation(3)]


def under(things: Sequence[Thing], containers: Sequence[Thing]) -> bool:
    """Whether each thing lies under the container of the same index."""
    pairs = zip(things, containers, strict=True)
    return all(np.linalg.norm(a.position[:2] - b.position[:2]) < 2e-3 and a.position[2] < 0.02 for a, b in pairs)


def texts(env: Task) -> list[tuple[str, str, str]]:
    """Text, grounded text and choice of every sub-task."""
    return [(step.text, step.grounded_text, step.choice) for step in env.progress.subtasks]
