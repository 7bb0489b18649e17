"""Helpers of the tests of tasks with cubes and a button: a hand that needs no fingers, and the stream of draws."""

from collections.abc import Sequence

import numpy as np
import pytest
import sapien

from helpers.env_unmask import wait
from mme_vla.envs.recording.recorder import demonstrate
from mme_vla.envs.robot.demonstrator import Demonstrator
from mme_vla.envs.scene.articulated import Button
from mme_vla.envs.scene.objects import Cube, Disc, H
from mme_vla.envs.scene.placement import TRIALS, Draws, Region
from mme_vla.envs.scene.things import Thing
from mme_vla.envs.task import Task

Flags = tuple[bool, bool]
"""Success and failure after a step."""
COLOURS = ("red", "blue", "green")


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
