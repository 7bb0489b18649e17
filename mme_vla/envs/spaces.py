"""The four action spaces: each turns one action of a policy into control steps of the robot.

| name | action | control steps |
|---|---|---|
| `joint_angle` | seven joint targets, gripper | one |
| `ee_pose` | x, y, z, roll, pitch, yaw, gripper | one, by inverse kinematics |
| `waypoint` | the same | a planned motion, then the gripper |
| `multi_choice` | `{"choice": "A", "point": [y, x]}` | the whole option |

Positions in metres and angles in radians, in the world; gripper -1 closed, +1 open. The robots that
hold a stick need no gripper number.
"""

import warnings
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
import sapien
from scipy.spatial.transform import Rotation

from mme_vla.embodiment.robomme import ARM_JOINTS, POSE, SIDE
from mme_vla.envs.grounding import project
from mme_vla.envs.robomme.robot.control import GRIPPER_STEPS
from mme_vla.errors import UserError, did_you_mean, require

if TYPE_CHECKING:
    from mme_vla.envs.robomme.robot.demonstrator import Demonstrator


class UnreachableError(RuntimeError):
    """A pose that no joint angles reach from where the arm stands."""


class ActionSpace(ABC):
    """One way to command the robot."""

    name: ClassVar[str]

    width: ClassVar[int] = len(POSE)
    """Numbers of an action besides the gripper's."""

    def space(self, stick: bool) -> gymnasium.Space:
        """The Gymnasium space of actions."""
        return gymnasium.spaces.Box(-np.inf, np.inf, (self.width + (not stick),), np.float32)

    @abstractmethod
    def act(self, robot: "Demonstrator", action: Any) -> None:
        """Do the control steps of one action.

        Raises:
            UserError: a malformed action.
            UnreachableError: inverse kinematics found no joint angles.
            PlanningError: no motion to the pose was found.
        """


class JointAngle(ActionSpace):
    """Absolute joint targets; the stick takes the first seven of at least seven numbers."""

    name = "joint_angle"
    width = ARM_JOINTS

    def act(self, robot: "Demonstrator", action: Any) -> None:
        stick = robot.env.stick
        width = self.width + (not stick)
        numbers = _numbers(action, width, "seven joint angles and the gripper", longer=stick)
        robot.step(numbers[:width])


class EndEffectorPose(ActionSpace):
    """An absolute pose of the tool, reached in one control step from inverse kinematics at the
    present joints.
    """

    name = "ee_pose"

    def act(self, robot: "Demonstrator", action: Any) -> None:
        stick = robot.env.stick
        numbers = _pose_numbers(action, stick)
        joints = robot.arm.ik(_pose(numbers), robot.env.qpos)
        if joints is None:
            raise UnreachableError(
                f"IK failed: no joint angles reach the pose {np.round(numbers[:6], 4).tolist()}."
            )
        robot.step(joints if stick else np.append(joints, numbers[6]))


class Waypoint(ActionSpace):
    """An absolute pose of the tool, reached by a planned motion; then the gripper closes at -1 or
    opens at +1.
    """

    name = "waypoint"

    def act(self, robot: "Demonstrator", action: Any) -> None:
        stick = robot.env.stick
        numbers = _pose_numbers(action, stick)
        grip = None
        if not stick:  # any other number leaves the gripper as it is
            grip = {-1.0: robot.close, 1.0: robot.open}.get(numbers[6])
        if grip is not None:
            robot.and_then = GRIPPER_STEPS
        try:
            robot.move_to(_pose(numbers))
        finally:
            robot.and_then = 0
        if grip is not None:
            grip()


class MultiChoice(ActionSpace):
    """One of the task's options by its letter, with a pixel [y, x] of the front image where it
    needs an object.
    """

    name = "multi_choice"

    def space(self, stick: bool) -> gymnasium.Space:
        point = gymnasium.spaces.Box(0, SIDE, (2,), np.float64)
        return gymnasium.spaces.Dict({"choice": gymnasium.spaces.Text(1), "point": point})

    def act(self, robot: "Demonstrator", action: Any) -> None:
        is_choice = isinstance(action, dict) and isinstance(action.get("choice"), str)
        require(
            is_choice,
            f'Action {action!r} is no choice; expected {{"choice": "A", "point": [y, x]}}.',
        )
        label = action["choice"].strip().lower()
        choices = {choice.label: choice for choice in robot.env.choices()}
        if label not in choices:
            # As in the benchmark, an unknown letter makes no step.
            warnings.warn(
                f"Unknown choice {action['choice']!r}: no step. {did_you_mean(label, choices)}",
                stacklevel=2,
            )
            return
        choice = choices[label]
        if choice.candidates is None:
            choice.run(robot, None)
            return
        point = action.get("point")
        require(
            point is not None and len(point),
            f"Choice {label!r} ({choice.action}) needs a point: the pixel [y, x] of the object"
            " meant.",
        )
        pixel = _numbers(point, 2, "a pixel's row and column")

        nearest = min(
            choice.candidates,
            key=lambda thing: float(np.linalg.norm(project(thing.position) - pixel)),
        )
        choice.run(robot, nearest)


SPACES: dict[str, ActionSpace] = {
    space.name: space for space in (JointAngle(), EndEffectorPose(), Waypoint(), MultiChoice())
}


def _numbers(action: Any, size: int, meaning: str, longer: bool = False) -> np.ndarray:
    """The action as float64, checked: `size` finite numbers, or more where `longer` allows it."""
    try:
        numbers = np.asarray(action, np.float64)
    except (TypeError, ValueError):
        raise UserError(
            f"Action {action!r} is not made of numbers; expected {size}: {meaning}."
        ) from None
    if longer:
        fits = numbers.ndim == 1 and len(numbers) >= size
        expected = f"at least {size}"
    else:
        fits = numbers.shape == (size,)
        expected = str(size)
    require(fits, f"Action has shape {numbers.shape}; expected {expected} numbers: {meaning}.")
    require(
        np.isfinite(numbers).all(), f"Action {numbers.tolist()} holds numbers that are not finite."
    )
    return numbers


def _pose_numbers(action: Any, stick: bool) -> np.ndarray:
    if stick:
        return _numbers(action, len(POSE), ", ".join(POSE), longer=True)
    return _numbers(action, len(POSE) + 1, f"{', '.join(POSE)} and the gripper")


def _pose(numbers: np.ndarray) -> sapien.Pose:
    rotation = Rotation.from_euler("xyz", numbers[3:6])
    return sapien.Pose(numbers[:3], rotation.as_quat(scalar_first=True))
