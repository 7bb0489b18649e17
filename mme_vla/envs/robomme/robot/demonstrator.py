"""The demonstrator: primitives for the gripper, for cubes and pegs, and for the stick, in one
class.
"""

from typing import Literal

import numpy as np
import sapien

from mme_vla.envs.robomme.robot.control import CLOSE, OPEN, PlanningError
from mme_vla.envs.robomme.robot.gripper_skills import GripperPrimitives, pointing_down, turned
from mme_vla.envs.robomme.robot.robots import ROBOT_BASE
from mme_vla.envs.robomme.scene.articulated import Peg
from mme_vla.envs.robomme.scene.objects import H
from mme_vla.envs.robomme.scene.things import Thing

PegEnd = Literal["head", "tail"]
BEHIND = 0.05
"""Where a push begins: how far behind the cube, metres."""
HOOK_BACK, HOOK_ASIDE, HOOK_STOP = 0.1, 0.1, 0.03
"""Where a hook begins behind and beside the cube, and how far before the goal it ends, metres."""
ABOVE_PEG, ABOVE_DRAG, PEG_DRAGGED, PEG_ON_TABLE = 0.2, 0.12, 0.04, 0.015
"""Heights of the tool over a peg, likewise before it drags one, while it does, and where it lets
one go, metres.
"""
TIP = 0.012
"""From the middle of a peg's end to where it is taken to be dragged, metres."""
INSERT_START, INSERT_NEAR, INSERT_PAST, INSERT_RAISED = 0.2, 0.15, 0.05, 0.15
"""Stations of an insertion, along the hole from where the end is in the box's middle, and the first
one's height.
"""


STICK_Z = 0.07
"""Height of the tip of the stick while it moves from target to target, metres."""
ARC_OFFSET = 0.2
"""How far the control point of an arc lies beside the middle of its chord, metres."""
ARC_SAMPLES, ARC_HOLD = 45, 5


class Demonstrator(GripperPrimitives):
    """Performs the primitives that demonstrations and multi-choice options are made of.

    Motions are planned from where the arm is and carried out without looking; the same scene gives
    the same steps. Waypoints are announced before the motion that leads there.

    Example:
        >>> demonstrator = Demonstrator(env, env.step)  # doctest: +SKIP
        >>> demonstrator.pick(env.cubes[0])  # doctest: +SKIP
    """

    # Cubes on the table, and pegs -----------------------------------------------------------------

    _reversed = False
    """The peg was grasped half a turn about the tool's approach axis from its own frame."""

    def push(self, cube: Thing, goal: Thing) -> None:
        """Push a cube to a goal with closed fingers, then open them."""
        way, z = _direction(cube, goal), cube.position[2]
        # The gripper never looks back to the robot: for a push towards it, it is turned by half a
        # turn.
        forward = way if goal.position[0] >= cube.position[0] else -way
        q = pointing_down(forward)
        self.open()
        self.move_to(self.at([*(cube.position[:2] - BEHIND * way), z], q), CLOSE)
        self.close()
        end = self.at([*(goal.position[:2] - H * way), z], q)
        self.move_to(end, CLOSE)
        self.announce(end, OPEN)
        self.open()

    def hook(self, cube: Thing, goal: Thing) -> None:
        """Draw a cube to a goal with a peg that is held by its tail, then let go.

        Where the cube stands to the left of the goal, the gripper passes it on the right of the way
        and the peg reaches to the left, otherwise the other way round.
        """
        side = 1 if cube.position[1] > goal.position[1] else -1
        way, z = _direction(cube, goal), cube.position[2]
        lateral = side * np.array([-way[1], way[0]])
        aside = HOOK_ASIDE * lateral
        forward = -lateral if self._reversed else lateral
        q = pointing_down(forward)
        start = self.at([*(cube.position[:2] - HOOK_BACK * way - aside), z], q)
        self.move_to(start, CLOSE)
        self.move_to(start)
        self.close()
        end = self.at([*(goal.position[:2] - HOOK_STOP * way - aside), z], q)
        self.move_to(end, CLOSE)
        self.announce(end, OPEN)
        self.open()

    def grasp_peg(self, peg: Peg, end: PegEnd, flip: bool = False) -> None:
        """Grasp a peg by one of its ends and lift it.

        Args:
            flip: hold the hand the other way round.
        """
        self.open()
        grasp = _peg_grasp(getattr(peg, end), flip)
        # RoboMME-OOD turns a grasp by half a turn if its x axis points towards the robot's base.
        forward = grasp.to_transformation_matrix()[:2, 0]
        looks_back = forward @ (grasp.p[:2] - np.array(ROBOT_BASE[:2])) < 0
        self._reversed = bool(self.env.tier and looks_back)
        if self._reversed:
            grasp = sapien.Pose(grasp.p, turned(grasp.q, "z", np.pi))
        self.move_to(self.at([*grasp.p[:2], ABOVE_PEG], grasp.q), OPEN)
        self.move_to(grasp, CLOSE)
        self.close()
        self.move_to(self.at([*grasp.p[:2], ABOVE_PEG], grasp.q), CLOSE)
        self.close()

    def insert_peg(self, peg: Peg, grasped_end: PegEnd, side: int, box: Thing) -> None:
        """Put the free end of a held peg into the hole of a box, as the benchmark's demonstrator
        does.

        Held by its tail and inserted from the right, the peg stops short of the hole, now and then
        too short; `insert_peg_fully` makes up for that.

        Args:
            grasped_end: the end that is held; the other one goes in.
            side: +1 from the right (smaller y) as the robot sees it, -1 from the left.
            box: its hole runs along its x axis, which points to the left.
        """
        head_first = grasped_end == "tail"
        free = peg.head if head_first else peg.tail
        outward = -1 if head_first else 1
        flip = head_first != (side > 0)

        def station(along: float, raised: float = 0.0) -> sapien.Pose:
            # The peg may slip, so the grip is read before every motion.
            grip = free.pose.inv() * self.env.tcp_pose
            inserted = box.pose * grip
            if flip:
                # The tool is turned in place, which puts the peg's other end into the box ...
                inserted = sapien.Pose(inserted.p, turned(inserted.q, "z", np.pi))
                if head_first and along < 0:  # ... and only in this case is that compensated.
                    along += grip.p[0]
            if self._reversed:
                along = -along
            return inserted * sapien.Pose([along, 0, -raised])

        self.move_to(station(outward * INSERT_START, INSERT_RAISED), CLOSE)
        self.move_to(station(outward * INSERT_START), CLOSE)
        self.move_to(station(outward * INSERT_NEAR))
        self.move_to(station(-INSERT_PAST), CLOSE)

    def insert_peg_fully(
        self, peg: Peg, grasped_end: PegEnd, side: int, box: Thing, begun: bool = False
    ) -> None:
        """Put the free end of a held peg into the middle of a box, whichever way the hand holds it.

        Args:
            begun: the peg is in the hole already; the other arguments are those of `insert_peg`.
        """
        head_first = grasped_end == "tail"
        free = peg.head if head_first else peg.tail
        hole = box.pose
        if head_first != (side > 0):
            hole = sapien.Pose(hole.p, turned(hole.q, "z", np.pi))
        outward = -1 if head_first else 1

        def station(along: float, raised: float = 0.0) -> sapien.Pose:
            end = hole * sapien.Pose([outward * along, 0, raised])
            return end * free.pose.inv() * self.env.tcp_pose

        if not begun:
            self.move_to(station(INSERT_START, INSERT_RAISED), CLOSE)
            for distance in (INSERT_START, INSERT_NEAR, INSERT_NEAR):
                self.move_to(station(distance), CLOSE)
        self.move_to(station(0.0), CLOSE)

    def drag_peg(self, peg: Peg, end: PegEnd, way: np.ndarray, flip: bool = False) -> None:
        """Take a peg by one tip and draw it over the table, hardly lifted, along `way` [2] in
        metres.
        """
        self.open()
        outward = TIP if end == "head" else -TIP
        grasp = _peg_grasp(getattr(peg, end), flip, outward)
        self.move_to(self.at([*grasp.p[:2], ABOVE_DRAG], grasp.q), OPEN)
        self.move_to(grasp, CLOSE)
        self.close()
        self.move_to(self.at([*grasp.p[:2], PEG_DRAGGED], grasp.q), CLOSE)
        self.lay_down_peg(way)

    def lay_down_peg(self, way: np.ndarray) -> None:
        """Carry a held peg along `way` [2] in metres, put it on the table, and let go."""
        here = self.env.tcp_pose
        place = here.p[:2] + way
        self.move_to(self.at([*place, here.p[2]], here.q), CLOSE)
        self.move_to(self.at([*place, PEG_ON_TABLE], here.q), OPEN)
        self.open()
        self.withdraw()

    def withdraw(self) -> None:
        """Move the tool straight up."""
        self.move_to(self.at([*self.env.tcp_pose.p[:2], ABOVE_PEG]))

    # The stick ------------------------------------------------------------------------------------

    def stick_to(self, target: Thing, store: bool = False) -> None:
        """Move the tip over a target, in a straight line and then once more to be exact.

        Args:
            store: keep the joint angles reached as the start of the execution.
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
        targets = []
        joints = self.env.qpos
        for pose in poses:
            solution = self.arm.ik(pose, joints)
            if solution is None:
                raise PlanningError(
                    f"The arc to {target.name} leaves the arm's reach at {pose.p.tolist()}."
                )
            targets.append(solution)
            joints = solution
        targets += [targets[-1]] * ARC_HOLD
        # The two halves of the arc are two waypoints.
        middle = len(poses) // 2
        self.announce(poses[middle], CLOSE)
        self.follow(targets[:middle])
        self.announce(poses[-1], CLOSE)
        self.follow(targets[middle:])


def _peg_grasp(end: Thing, flip: bool, outward: float = 0.0) -> sapien.Pose:
    """The tool's pose around one end of a peg, moved along the peg by `outward` metres."""
    q = turned(end.pose.q, "x", np.pi)
    if flip:
        q = turned(q, "z", np.pi)
    along = end.pose.to_transformation_matrix()[:3, 0]
    return sapien.Pose(end.position + outward * along, q)


def _direction(cube: Thing, goal: Thing) -> np.ndarray:
    way = goal.position[:2] - cube.position[:2]
    return way / np.linalg.norm(way)


def arc(
    start: np.ndarray, end: np.ndarray, direction: Literal["clockwise", "counterclockwise"]
) -> np.ndarray:
    """Points of a quadratic Bezier curve between two places at the stick's height.

    Args:
        start: [2] or [3].
        end: likewise, metres.
        direction: the side on which the curve leaves the chord; clockwise: to the left of the way.

    Returns:
        Points [45, 3], both ends included.
    """
    a, b = np.asarray(start, float)[:2], np.asarray(end, float)[:2]
    way = b - a
    aside = np.array([-way[1], way[0]]) / np.linalg.norm(way)
    if direction == "counterclockwise":
        aside = -aside
    control = (a + b) / 2 + ARC_OFFSET * aside
    t = np.linspace(0, 1, ARC_SAMPLES)[:, None]
    points = (1 - t) ** 2 * a + 2 * t * (1 - t) * control + t**2 * b
    return np.column_stack([points, np.full(ARC_SAMPLES, STICK_Z)])
