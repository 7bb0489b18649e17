"""Helpers of the tests of tasks: scenes, and fakes of fingers and tool."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import sapien

from mme_vla.envs import metadata
from mme_vla.envs.make import load_tasks
from mme_vla.envs.robomme.recording.recorder import demonstrate
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.articulated import Button
from mme_vla.envs.robomme.scene.objects import H
from mme_vla.envs.robomme.scene.things import Thing
from mme_vla.envs.task import Task
from mme_vla.registry import TASKS

Flags = tuple[bool, bool]
"""Success and failure after a step or an evaluation."""
COLOURS = ("red", "blue", "green")


def make(task: type[Task], seed: int, difficulty: str, **settings: object) -> Task:
    """The task in physics alone, reset."""
    env = task(seed=seed, difficulty=difficulty, obs_mode="none", render_backend="none", **settings)
    env.reset()
    return env


def built(task: str, episode: int = 1, **settings: Any) -> Any:
    """The scene of an episode of the test split in physics alone, reset."""
    load_tasks(task)
    spec = metadata.episode(task, "test", episode)
    return make(TASKS[task], spec.seed, spec.difficulty, **settings)


def wait(env: Task, steps: int = 1) -> Flags:
    """Stand still; success and failure of the last step."""
    for _ in range(steps):
        *_, info = env.step(env.reset_action)
    return bool(info["success"]), bool(info["fail"])


def touches(env: Task) -> bool:
    """Whether anything pressed on the robot in the last physics step."""
    robot = {link._objs[0] for link in env.agent.robot.links}
    for contact in env.scene.px.get_contacts():
        one, other = (body in robot for body in contact.bodies)
        pressed = any(np.any(point.impulse) for point in contact.points)
        if one != other and pressed:
            return True
    return False


def go_to(env: Task, text: str) -> None:
    """Go to the first sub-task of the execution that has this text."""
    env.progress.index = next(
        i for i, s in enumerate(env.progress.subtasks) if s.text == text and not s.video
    )


def lift(env: Task, container: Thing) -> Flags:
    """Put a container up in the air and do a step."""
    container.move_to(sapien.Pose([*container.position[:2], 0.25], container.pose.q))
    return wait(env)


def push_down(env: Task, button: Button) -> Flags:
    """Press a button's cap into its base and do a step, after which it is still down."""
    button.articulation.set_qpos(np.full((1, 1), -0.1, np.float32))
    return wait(env)


def released(env: Task, button: Button) -> None:
    """Let a button come up again."""
    button.restore()
    wait(env)


def under(things: Sequence[Thing], containers: Sequence[Thing]) -> bool:
    """Whether each thing lies under the container of the same index."""
    pairs = zip(things, containers, strict=True)
    return all(
        np.linalg.norm(a.position[:2] - b.position[:2]) < 2e-3 and a.position[2] < 0.02
        for a, b in pairs
    )


class Hand:
    """Counts as grasping whatever it was told to carry, and puts it where it is told."""

    def __init__(self, env: Task, monkeypatch: pytest.MonkeyPatch) -> None:
        self._env, self._grasped = env, None
        monkeypatch.setattr(env, "is_grasping", lambda thing: thing is self._grasped)

    def carry(self, thing: Thing, over: Thing | None = None, z: float = 0.2) -> Flags:
        """Hold a thing in the air, by default above its place, for a step."""
        self._grasped = thing
        place = thing.position if over is None else over.position
        thing.move_to(sapien.Pose([*place[:2], z], thing.initial_pose.q))
        return wait(self._env)

    def release(self, place: Sequence[float] | None = None) -> Flags:
        """Let go of the thing on the table, by default where it stood at first."""
        thing, self._grasped = self._grasped, None
        assert thing is not None
        xy = thing.initial_pose.p[:2] if place is None else place[:2]
        thing.move_to(sapien.Pose([*xy, H], thing.initial_pose.q))
        return wait(self._env)


def steps_of_demonstration(env: Task) -> int | None:
    """Demonstrate a task that was just reset; the control steps it took, None if it failed."""
    done = demonstrate(
        env, Demonstrator(env, lambda action: env.step(np.asarray(action, np.float32)))
    )
    return env.steps_done if done else None


class Tip:
    """A fake tool centre point; an evaluation is a step."""

    def __init__(self, env: Task, monkeypatch: pytest.MonkeyPatch) -> None:
        self._env, self._place = env, [0.4, 0.4, 0.07]
        monkeypatch.setattr(type(env), "tcp_pose", property(lambda _: sapien.Pose(self._place)))

    def put(
        self, place: Thing | Sequence[float], z: float = 0.07, aside: Sequence[float] = (0, 0)
    ) -> Flags:
        """Be at a place, or beside it by some metres in x and y, and evaluate."""
        xy = np.asarray(place.position if isinstance(place, Thing) else place)[:2] + aside
        self._place = [*xy, z]
        info = self._env.evaluate()
        return bool(info["success"]), bool(info["fail"])

    def back_to_start(self, first: Thing) -> None:
        """What the demonstrator does after the video, with an arm that never left home."""
        self._env.after_video, self._env.stored_qpos = True, self._env.qpos
        self.put((0.4, 0.4))
        self.put(first)


class Ear:
    """A demonstrator that only notes where it was asked to go."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def stick_to(self, target: Thing) -> None:
        self.calls.append((target,))

    def stick_arc(self, target: Thing, direction: str) -> None:
        self.calls.append((target, direction))
