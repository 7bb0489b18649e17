"""What the stick is shown to do: go to a target, straight or around an obstacle."""

from typing import Literal

import numpy as np
import sapien

from mme_vla.envs.robot.control import CLOSE, PlanningError, RobotControl
from mme_vla.envs.robot.gripper_skills import GripperPrimitives
from mme_vla.envs.robot.peg_skills import PegPrimitives
from mme_vla.envs.scene.things import Thing

STICK_Z = 0.07
"""Height of the tip while it moves from target to target, metres."""
ARC_OFFSET = 0.2
"""How far the control point of an arc lies beside the middle of its chord, metres."""
ARC_SAMPLES, ARC_HOLD = 45, 5


class StickPrimitives(RobotControl):
    """The primitives of tasks in which a stick is moved over targets."""

    def stick_to(self, target: Thing, store: bool = False) -> None:
        """Move the tip over a target, in a straight line and then once more to be exact.

        Args:
            target: where to.
            store: remember the joint angles reached, as the place where the execution starts.
        """
        pose = self.at([*target.position[:2], STICK_Z])
        self.move_to(pose)
        self.move_to(pose, CLOSE)
        if store:
            self.env.stored_qpos = np.array(self.env.qpos, np.float64)

    def stick_arc(self, target: Thing, direction: Literal["clockwise", "counterclockwise"]) -> None:
        """Move the tip over a target along an arc, one point of it a control step.

        Raises:
            PlanningError: a point of the arc is out of reach; nothing has moved.
        """
        here = self.env.tcp_pose
        poses = [self.at(point, here.q) for point in arc(here.p, target.position, direction)]
        targets, joints = [], self.env.qpos
        for pose in poses:
            solution = self.arm.ik(pose, joints)
            if solution is None:
                raise PlanningError(f"The arc to {target.name} leaves the arm's reach at {pose.p.tolist()}.")
            targets.append(solution)
            joints = solution
        middle = len(poses) // 2
        targets += [targets[-1]] * ARC_HOLD
        self._half(poses[middle], targets[:middle])
        self._half(poses[-1], targets[middle:])

    def _half(self, waypoint: sapien.Pose, targets: list[np.ndarray]) -> None:
        self.announce(waypoint, CLOSE)
        self.follow(targets)


def arc(start: np.ndarray, end: np.ndarray, direction: Literal["clockwise", "counterclockwise"]) -> np.ndarray:
    """Points of a quadratic Bezier curve between two places at the stick's height.

    Args:
        start: [2] or [3]. end: likewise, metres.
        direction: the side on which the curve leaves the chord; clockwise: to the left of the way.

    Returns:
        Points [45, 3], both ends included.
    """
    a, b = np.asarray(start, float)[:2], np.asarray(end, float)[:2]
    way = b - a
    left = np.array([-way[1], way[0]]) / np.linalg.norm(way)
    control = (a + b) / 2 + ARC_OFFSET * (left if direction == "clockwise" else -left)
    t = np.linspace(0, 1, ARC_SAMPLES)[:, None]
    points = (1 - t) ** 2 * a + 2 * t * (1 - t) * control + t**2 * b
    return np.column_stack([points, np.full(ARC_SAMPLES, STICK_Z)])


__all__ = ["Demonstrator", "PlanningError"]


class Demonstrator(GripperPrimitives, PegPrimitives, StickPrimitives):
    """Performs the primitives that demonstrations and multi-choice options are made of.

    Motions are planned from where the arm is and carried out without looking; the same scene gives the same steps.
    Waypoints are announced before the motion that leads there.

    Example:
        >>> demonstrator = Demonstrator(env, env.step)  # doctest: +SKIP
        >>> demonstrator.pick(env.cubes[0])  # doctest: +SKIP
    """
