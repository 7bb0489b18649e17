"""Kinematics and motion plans: the same poses, steps and joint targets as in the official
recordings.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulator is not installed")

import sapien
from scipy.spatial.transform import Rotation

from helpers.env_scenes import Scene, recorded
from mme_vla.envs.robomme.robot.control import LIMITS
from mme_vla.envs.robomme.robot.kinematics import Arm, pose_distance
from mme_vla.envs.robomme.robot.planning import (
    CONTROL_STEP,
    Obstacles,
    plan_free,
    plan_screw,
    sample_path,
    twist_of,
)
from mme_vla.envs.robomme.scene.stage import RESET_QPOS

EPISODES = [("PickXtimes", 8), ("VideoUnmask", 4), ("PatternLock", 8)]
# Where planned motions begin in the recordings, and how many steps they take.
MOTIONS = [
    (
        "PickXtimes",
        8,
        [
            (6, 57),
            (69, 33),
            (108, 36),
            (144, 36),
            (180, 26),
            (212, 26),
            (238, 28),
            (272, 33),
            (305, 27),
        ],
    ),
    ("VideoUnmask", 4, [(78, 43), (121, 25), (152, 24), (182, 15), (203, 27), (236, 27)]),
    ("PatternLock", 8, [(32, 4), (70, 4), (106, 4), (144, 4)]),
]


@pytest.fixture(scope="module")
def arms() -> Iterator[dict[bool, Arm]]:
    """The kinematic models, keyed by whether the robot holds a stick."""
    scenes = {stick: Scene(lambda _: None, stick=stick) for stick in (False, True)}
    yield {stick: Arm(scene.agent) for stick, scene in scenes.items()}
    for scene in scenes.values():
        scene.close()


def pose(numbers: np.ndarray) -> sapien.Pose:
    return sapien.Pose(numbers[:3], np.roll(Rotation.from_euler("xyz", numbers[3:6]).as_quat(), 1))


@pytest.mark.parametrize(("task", "episode"), EPISODES)
def test_forward_kinematics_gives_the_recorded_poses(
    arms: dict[bool, Arm], h5_folder: Path, task: str, episode: int
) -> None:
    arm = arms[task == "PatternLock"]
    joints = recorded(h5_folder, task, episode, "action/joint_action")[::5]
    poses = recorded(h5_folder, task, episode, "action/eef_action")[::5]
    assert (
        max(pose_distance(arm.forward(q), pose(p)) for q, p in zip(joints, poses, strict=True))
        < 3e-6
    )


@pytest.mark.parametrize(("task", "episode"), EPISODES)
def test_inverse_kinematics_follows_the_recorded_poses(
    arms: dict[bool, Arm], h5_folder: Path, task: str, episode: int
) -> None:
    arm = arms[task == "PatternLock"]
    joints = recorded(h5_folder, task, episode, "action/joint_action")[:, :7]
    states = recorded(h5_folder, task, episode, "obs/joint_state")
    poses = recorded(h5_folder, task, episode, "action/eef_action")
    for k in range(1, len(joints), 10):
        solution = arm.ik(pose(poses[k]), states[k - 1])
        assert solution is not None
        assert pose_distance(arm.forward(solution), pose(poses[k])) < 1e-4
        # A seven-joint arm has a choice; from a state close by it is nearly the recorded one.
        assert np.abs(solution - joints[k]).max() < 0.01


def test_inverse_kinematics_refuses_what_is_out_of_reach(arms: dict[bool, Arm]) -> None:
    assert arms[False].ik(sapien.Pose([1.0, 0, 0.3], [0, 1, 0, 0]), np.zeros(7)) is None


def test_inverse_kinematics_tries_other_starts_within_the_limits(arms: dict[bool, Arm]) -> None:
    arm = arms[False]
    target = arm.forward(np.array([0.5, 0.4, 0.3, -1.8, 0.2, 2.2, 1.0]))
    solution = arm.ik(target, arm.upper)
    assert solution is not None and arm.within_limits(solution)
    np.testing.assert_array_equal(solution, arm.ik(target, arm.upper))


def test_the_jacobian_is_the_derivative_of_the_pose(arms: dict[bool, Arm]) -> None:
    arm, q, step = arms[False], np.array([0.1, 0.3, -0.2, -1.9, 0.1, 2.1, 0.6]), 5e-3
    jacobian = arm.jacobian(q)
    for i, nudge in enumerate(step * np.eye(7)):
        ahead, behind = arm.transform(q + nudge), arm.transform(q - nudge)
        twist = twist_of(ahead @ np.linalg.inv(behind))
        assert twist is not None and np.linalg.norm(twist[3:]) > 0
        np.testing.assert_allclose(twist / (2 * step), jacobian[:, i], atol=1e-3)


@pytest.mark.parametrize(("task", "episode", "motions"), MOTIONS)
def test_screw_plans_are_the_recorded_ones(
    arms: dict[bool, Arm], h5_folder: Path, task: str, episode: int, motions: list[tuple[int, int]]
) -> None:
    stick = task == "PatternLock"
    joints = recorded(h5_folder, task, episode, "action/joint_action")[:, :7]
    states = recorded(h5_folder, task, episode, "obs/joint_state")
    waypoints = recorded(h5_folder, task, episode, "action/waypoint_action")
    for start, steps in motions:
        plan = plan_screw(arms[stick], states[start - 1], pose(waypoints[start]), *LIMITS[stick])
        assert plan is not None and len(plan) == steps
        np.testing.assert_allclose(plan, joints[start : start + steps], atol=1e-5)


def test_plans_keep_the_limits_and_end_at_the_target(arms: dict[bool, Arm]) -> None:
    arm, start = arms[False], RESET_QPOS.astype(np.float64)
    target = sapien.Pose(
        [-0.1, 0.2, 0.1], np.roll(Rotation.from_euler("xyz", [np.pi, 0, 0.5]).as_quat(), 1)
    )
    # A screw is followed in steps, which add up to a little less than exact.
    for plan, exactness in (
        (plan_screw(arm, start, target), 0.03),
        (plan_free(arm, start, target), 1e-4),
    ):
        assert plan is not None
        np.testing.assert_array_equal(plan[0], start)
        assert pose_distance(arm.forward(plan[-1]), target) < exactness
        # The number of rows is rounded down: they are up to this far apart.
        spacing = CONTROL_STEP * (len(plan) + 1) / (len(plan) - 1)
        speed = np.diff(plan, axis=0) / spacing
        assert 0.7 < np.abs(speed).max() < 0.9
        assert 0.7 < np.abs(np.diff(speed, axis=0) / spacing).max() < 0.95


def test_there_is_no_screw_for_half_a_rotation_or_out_of_reach(arms: dict[bool, Arm]) -> None:
    arm, start = arms[False], RESET_QPOS.astype(np.float64)
    here = arm.forward(start)
    half_rotation = sapien.Pose(here.p, [0, 0, 1, 0])
    assert plan_screw(arm, start, half_rotation) is None
    assert plan_screw(arm, start, sapien.Pose([0.5, 0, 0.3], here.q)) is None


def test_orientations_that_hardly_differ_are_left_alone() -> None:
    displacement = np.eye(4)
    displacement[:3, :3] = Rotation.from_euler("z", 0.005).as_matrix()
    displacement[:3, 3] = [0.1, 0.2, 0.3]
    np.testing.assert_allclose(twist_of(displacement), [0.1, 0.2, 0.3, 0, 0, 0])
    displacement[:3, :3] = Rotation.from_euler("z", 0.006).as_matrix()
    np.testing.assert_allclose(twist_of(displacement)[3:], [0, 0, 0.006], rtol=1e-6)


def test_sampling_goes_around_what_is_in_the_way(arms: dict[bool, Arm]) -> None:
    arm = arms[False]
    start, goal = (
        np.array([-2.8, -0.1, -1.8, -0.2, 2.3, 3.6, 0.6]),
        np.array([0.1, 1.2, 0.9, -2.3, 2.5, 1.6, 1.6]),
    )
    obstacles = Obstacles(arm, [start, goal])
    assert (
        obstacles.clear(start)
        and obstacles.clear(goal)
        and not obstacles.clear_between(start, goal)
    )
    path = sample_path(arm, start, goal, seed=0)
    assert path is not None
    np.testing.assert_array_equal(path[0], start)
    np.testing.assert_array_equal(path[-1], goal)
    assert all(obstacles.clear_between(a, b) for a, b in itertools.pairwise(path))
    np.testing.assert_array_equal(path, sample_path(arm, start, goal, seed=0))
