"""Helpers of the tests of tasks: scenes, fakes of fingers and tool, and the stream of random numbers."""

from collections.abc import Sequence

import numpy as np
import pytest
import sapien

from mme_vla.envs.recording.recorder import demonstrate
from mme_vla.envs.robot.demonstrator import Demonstrator
from mme_vla.envs.scene.articulated import Button
from mme_vla.envs.scene.objects import Container, Cube, Disc, H
from mme_vla.envs.scene.placement import CONTAINER_HALF, TRIALS, Draws, Region
from mme_vla.envs.scene.things import Thing
from mme_vla.envs.task import Task

Flags = tuple[bool, bool]
"""Success and failure after a step or an evaluation."""
COLOURS = ("red", "blue", "green")


def make(task: type[Task], seed: int, difficulty: str, **settings: object) -> Task:
    """The task in physics alone, reset."""
    env = task(seed=seed, difficulty=difficulty, obs_mode="none", render_backend="none", **settings)
    env.reset()
    return env


def wait(env: Task, steps: int = 1) -> Flags:
    """Stand still; success and failure of the last step."""
    for _ in range(steps):
        *_, info = env.step(env.reset_action)
    return bool(info["success"]), bool(info["fail"])


def go_to(env: Task, text: str) -> None:
    """Go to the first sub-task of the execution that has this text."""
    env.progress.index = next(i for i, s in enumerate(env.progress.subtasks) if s.text == text and not s.video)


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


def read_button(stream: Draws, button: Button, centre: tuple[float, float], widths: tuple[float, float]) -> None:
    """Read a button's place from a stream and compare."""
    offset = (stream.uniforms(2).numpy() - 0.5) * widths
    np.testing.assert_allclose(button.pose.p[:2], np.array(centre) + offset, atol=1e-6)


def read_cube(stream: Draws, region: Region, cube: Cube) -> None:
    """Read from a stream the trials that end with a cube's place and turn."""
    for _ in range(TRIALS):
        xy, yaw = region.place(stream, H), 2 * np.pi * stream.uniform()
        if np.allclose(xy, cube.initial_pose.p[:2], atol=1e-6):
            w, _, _, z = cube.initial_pose.q
            assert np.cos(yaw - 2 * np.arctan2(z, w)) == pytest.approx(1, abs=1e-6)
            return
    raise AssertionError(f"{cube.name} does not stand where one of {TRIALS} trials would put it")


def read_disc(stream: Draws, region: Region, disc: Disc) -> None:
    """Read from a stream the trials that end with a target's place."""
    for _ in range(TRIALS):
        if np.allclose(region.place(stream, disc.radius), disc.initial_pose.p[:2], atol=1e-6):
            return
    raise AssertionError(f"{disc.name} does not lie where one of {TRIALS} trials would put it")


def least_distance(things: Sequence[Thing]) -> float:
    """Between the centres of any two, metres."""
    places = np.array([thing.initial_pose.p[:2] for thing in things])
    distances = np.linalg.norm(places[:, None] - places, axis=-1)
    return float(distances[np.triu_indices(len(things), 1)].min(initial=np.inf))


def steps_of_demonstration(env: Task) -> int | None:
    """Demonstrate a task that was just reset; the control steps it took, None if it failed."""
    done = demonstrate(env, Demonstrator(env, lambda action: env.step(np.asarray(action, np.float32))))
    return env.steps_done if done else None


class Tip:
    """A fake tool centre point; an evaluation is a step."""

    def __init__(self, env: Task, monkeypatch: pytest.MonkeyPatch) -> None:
        self._env, self._place = env, [0.4, 0.4, 0.07]
        monkeypatch.setattr(type(env), "tcp_pose", property(lambda _: sapien.Pose(self._place)))

    def put(self, place: Thing | Sequence[float], z: float = 0.07, aside: Sequence[float] = (0, 0)) -> Flags:
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
