"""Action spaces: what they make of an action, and what they refuse."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

sapien = pytest.importorskip(
    "sapien", reason="the simulator is not installed: uv sync --inexact --extra sim"
)

from mme_vla.envs.grounding import project  # noqa: E402
from mme_vla.envs.spaces import SPACES, UnreachableError  # noqa: E402
from mme_vla.envs.subtasks import Choice  # noqa: E402
from mme_vla.errors import UserError  # noqa: E402

JOINTS = [0.1, 0.2, 0.3, -1.5, 0.1, 1.5, 0.7]
POSE = [0.1, 0.0, 0.2, np.pi, 0.0, 0.0]


class Hand:
    """A fake demonstrator, which keeps the calls."""

    def __init__(self, env: Any, step: Callable[[np.ndarray], None], reachable: bool) -> None:
        self.env = env
        self.step = step
        self.done: list[Any] = []
        self.arm = SimpleNamespace(ik=lambda pose, qpos: np.arange(7.0) if reachable else None)

    def move_to(self, pose: Any, gripper: float | None = None) -> None:
        self.done.append(np.round(pose.p.astype(np.float64), 6).tolist())

    def open(self) -> None:
        self.done.append("open")

    def close(self) -> None:
        self.done.append("close")


class Cube:
    def __init__(self, *position: float) -> None:
        self.position = np.array(position)


def control(stick: bool = False, reachable: bool = True) -> tuple[Any, list]:
    steps: list[np.ndarray] = []
    cubes = [Cube(0.0, -0.1, 0.02), Cube(0.0, 0.1, 0.02)]
    choices = [
        Choice("a", "pick up the cube", lambda demo, thing: demo.done.append(thing), cubes),
        Choice("b", "press the button", lambda demo, thing: demo.done.append("pressed")),
    ]
    task = SimpleNamespace(
        stick=stick, qpos=np.zeros(7 if stick else 9), choices=lambda: choices, cubes=cubes
    )
    return Hand(task, steps.append, reachable), steps


@pytest.mark.parametrize(
    ("name", "stick", "action", "step"),
    [
        ("joint_angle", False, [*JOINTS, -1.0], [*JOINTS, -1.0]),
        ("joint_angle", True, JOINTS, JOINTS),
        ("joint_angle", True, [*JOINTS, -1.0], JOINTS),
        ("joint_angle", True, [*JOINTS, -1.0, 3.0], JOINTS),
        ("ee_pose", False, [*POSE, 1.0], [0, 1, 2, 3, 4, 5, 6, 1]),
        ("ee_pose", True, POSE, [0, 1, 2, 3, 4, 5, 6]),
    ],
)
def test_joints_and_poses_are_one_step(
    name: str, stick: bool, action: list[float], step: list[float]
) -> None:
    hand, steps = control(stick)
    SPACES[name].act(hand, action)
    np.testing.assert_array_equal(steps, [step])


@pytest.mark.parametrize(
    ("stick", "gripper", "expected"),
    [
        (False, -1.0, ["close"]),
        (False, 1.0, ["open"]),
        (False, 0.3, []),
        (False, -0.99, []),
        (True, -1.0, []),
    ],
)
def test_a_waypoint_moves_a_gripper_only_at_exactly_one(
    stick: bool, gripper: float, expected: list[str]
) -> None:
    hand, _ = control(stick)
    SPACES["waypoint"].act(hand, [*POSE, gripper])
    assert hand.done == [[0.1, 0.0, 0.2], *expected]


@pytest.mark.parametrize(
    ("name", "stick", "action", "words"),
    [
        ("joint_angle", False, JOINTS, r"expected 8"),
        ("joint_angle", False, [*JOINTS, 0.0, 0.0], r"expected 8"),
        ("joint_angle", True, JOINTS[:6], r"expected at least 7"),
        ("joint_angle", False, [*JOINTS, np.nan], r"not finite"),
        ("joint_angle", False, [*JOINTS, np.inf], r"not finite"),
        ("joint_angle", False, [[*JOINTS, 1.0]], r"shape \(1, 8\)"),
        ("joint_angle", False, "left", r"not made of numbers"),
        ("joint_angle", False, None, r"shape|not finite|numbers"),
        ("ee_pose", False, POSE, r"expected 7"),
        ("ee_pose", True, POSE[:5], r"expected at least 6"),
        ("waypoint", False, [*POSE[:5], np.nan, 1.0], r"not finite"),
        ("multi_choice", False, "a", r"no choice"),
        ("multi_choice", False, {"point": [1, 2]}, r"no choice"),
        ("multi_choice", False, {"choice": "A"}, r"needs a point"),
        ("multi_choice", False, {"choice": "A", "point": []}, r"needs a point"),
        ("multi_choice", False, {"choice": "A", "point": [1]}, r"expected 2"),
        ("multi_choice", False, {"choice": "A", "point": [np.nan, 2]}, r"not finite"),
    ],
)
def test_malformed_actions_are_refused_without_a_step(
    name: str, stick: bool, action: Any, words: str
) -> None:
    hand, steps = control(stick)
    with pytest.raises(UserError, match=words):
        SPACES[name].act(hand, action)
    assert not steps
    assert not hand.done


def test_an_unreachable_pose_says_so() -> None:
    hand, steps = control(reachable=False)
    with pytest.raises(UnreachableError, match="IK failed"):
        SPACES["ee_pose"].act(hand, [*POSE, 1.0])
    assert not steps


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("label", ["A", "a"])
def test_a_choice_takes_the_object_nearest_to_the_point(index: int, label: str) -> None:
    hand, _ = control()
    expected = hand.env.cubes[index]
    SPACES["multi_choice"].act(hand, {"choice": label, "point": project(expected.position) + 3})
    assert hand.done == [expected]


def test_a_choice_without_an_object_needs_no_point() -> None:
    hand, _ = control()
    SPACES["multi_choice"].act(hand, {"choice": "B", "point": []})
    assert hand.done == ["pressed"]


def test_an_unknown_choice_takes_no_step_and_warns() -> None:
    hand, steps = control()
    with pytest.warns(UserWarning, match="Unknown choice 'Z'.*Known: a, b"):
        SPACES["multi_choice"].act(hand, {"choice": "Z"})
    assert not steps
    assert not hand.done


@pytest.mark.parametrize("stick", [False, True])
@pytest.mark.parametrize("name", ["joint_angle", "ee_pose", "waypoint"])
def test_sampled_actions_have_the_size_of_the_space(name: str, stick: bool) -> None:
    hand, steps = control(stick)
    SPACES[name].act(hand, SPACES[name].space(stick).sample())
    assert len(steps) + len(hand.done) >= 1
