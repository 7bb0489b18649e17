"""RoboMME's Panda in joint space, and what the benchmark takes and gives."""

from collections.abc import Mapping, Sequence
from string import ascii_uppercase
from typing import Any

import numpy as np

from mme_vla.embodiment.action_space import MIDDLE, ActionSpace
from mme_vla.embodiment.robot import Camera, Embodiment, State
from mme_vla.errors import UserError, require

ARM_JOINTS = 7
POSE = ("x", "y", "z", "roll", "pitch", "yaw")
"""Of the tool, in the world: metres and radians."""
CAMERAS = ("front", "wrist")
"""What the benchmark's environments show."""
SIDE = 256
"""Of the benchmark's images, in pixels; points of subgoals and choices are pixels of its front
image.
"""
LETTERS = "abcdefgh"
"""Of the options that a task can offer."""

CHOICE_SPACE = ActionSpace(
    width=len(LETTERS) + 2,
    choice=tuple(range(len(LETTERS))),
    point=(len(LETTERS), len(LETTERS) + 1),
    frames=None,
)
"""Of the benchmark's choices as numbers: eight letters of which one is 1, then y and x."""

ROBOMME_JOINT = Embodiment(
    name="robomme_joint",
    cameras=(Camera("front", "image", "all"), Camera("wrist", "wrist_image", "colour")),
    memory_camera="front",
    state=State(ARM_JOINTS + 1, ("state",)),
    action=ActionSpace(
        width=ARM_JOINTS + 1,
        key=("actions",),
        space="joint_angle",
        names=(*(f"joint {i}" for i in range(1, ARM_JOINTS + 1)), "gripper"),
        units=(*["rad"] * ARM_JOINTS, "−1 closed · 1 open"),
        relative=tuple(range(ARM_JOINTS)),
        horizon=20,
        execute=16,
    ),
    fps=20.0,
    conditioning_video=True,
)
"""The same as `configs/embodiment/robomme_joint.yaml`, for Python that reads no YAML."""


def embodiment_of(config: Mapping[str, Any]) -> Embodiment:
    """The robot of a policy's configuration.

    Raises:
        UserError: the section `embodiment` is missing or cannot be read, or the backbone has other
            sizes.
    """
    robot = Embodiment.from_dict(config.get("embodiment"))
    backbone = config.get("backbone", {})
    if {"action_dim", "horizon"} <= set(backbone):
        robot.check_network(backbone["action_dim"], backbone["horizon"])
    return robot


def benchmark_action(
    space: ActionSpace, action: np.ndarray, stick: bool = False, pose: np.ndarray | None = None
) -> np.ndarray | dict[str, Any]:
    """What an environment of the benchmark takes for an action [w] of a policy.

    Args:
        stick: its robot holds a stick, and takes no command of the gripper, which is an action's
            last number.
        pose: of the tool now [6], for actions that are differences to it.

    Returns:
        The numbers; or `{"choice": "A", "point": [y, x]}`, in pixels of the front image.
    """
    if space.of_pose and pose is not None:
        action = space.beside_pose(action, pose)
    if space.choice:
        letter = ascii_uppercase[int(np.argmax(action[list(space.choice)]))]
        point = [float(share) * SIDE for share in action[list(space.point)]]
        return {"choice": letter, "point": point}
    # A policy may return more numbers than the robot has.
    width = space.width - 1 if stick else space.width
    return action[:width]


def choice_action(space: ActionSpace, choice: Mapping[str, Any]) -> np.ndarray:
    """A choice as an action [w] float32 of a policy: the inverse of `benchmark_action`.

    Args:
        choice: `{"choice": "A", "point": [y, x]}`, in pixels of the front image; `point` is absent,
            None or empty for a choice that needs none.
    """
    action = np.zeros(space.width, np.float32)
    action[space.choice[ascii_uppercase.index(str(choice["choice"]).upper())]] = 1
    if space.point:
        point = choice.get("point") or ()
        action[list(space.point)] = np.divide(point, SIDE) if len(point) else MIDDLE
    return action


def benchmark_state(
    joints: Sequence[float] | np.ndarray, fingers: Sequence[float] | np.ndarray
) -> np.ndarray:
    """The state [8] float32 that RoboMME's robots have for a policy: the arm's joint angles and the
    first finger.
    """
    arm = np.asarray(joints, np.float32)[:ARM_JOINTS]
    gripper = np.asarray(fingers, np.float32)[:1]
    return np.concatenate([arm, gripper])


def check_benchmark(robot: Embodiment, spaces: Sequence[str]) -> None:
    """Make sure that a robot can take part in the benchmark."""
    require(
        robot.action.space in spaces,
        f"The robot {robot.name!r} cannot be evaluated on the benchmark: its action space is "
        f"{robot.action.space!r}, not one of {', '.join(spaces)} (embodiment.action.space).",
    )
    other = [name for name in robot.camera_names if name not in CAMERAS]
    difference = None
    if other:
        difference = f"the cameras {', '.join(other)}"
    elif robot.state.width != ROBOMME_JOINT.state.width:
        difference = f"a state of {robot.state.width} numbers"
    if difference is not None:
        raise UserError(
            f"The robot {robot.name!r} cannot be evaluated on the benchmark: it has {difference},"
            f" and the benchmark gives the cameras {', '.join(CAMERAS)} and"
            f" {ROBOMME_JOINT.state.width} numbers."
        )
