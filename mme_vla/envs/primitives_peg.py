"""What a cube or a peg is shown to suffer: pushing, hooking, grasping by one end, inserting."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import sapien

from mme_vla.envs.grasping import pointing_down, turned
from mme_vla.envs.objects import H, Peg
from mme_vla.envs.robot_control import CLOSE, OPEN, RobotControl
from mme_vla.envs.things import Thing

BEHIND = 0.05
"""Where a push begins: how far behind the cube, metres."""
HOOK_BACK, HOOK_ASIDE, HOOK_STOP = 0.1, 0.1, 0.03
"""Where a hook begins behind and beside the cube, and how far before the goal it ends, metres."""
ABOVE_PEG = 0.2
INSERT_FAR, INSERT_NEAR, INSERT_PAST, INSERT_RAISED = 0.2, 0.15, 0.05, 0.15
"""Stations of an insertion along the hole, seen from where the end is in the middle of the box, and the first's height."""


class PegPrimitives(RobotControl):
    """The primitives of tasks in which cubes are moved along the table and pegs are handled."""

    def push(self, cube: Thing, goal: Thing) -> None:
        """Push a cube to a goal with closed fingers, then open them."""
        way, z = _direction(cube, goal), cube.position[2]
        # The gripper never looks back to the robot: for a push towards it, it is turned by half a turn.
        q = pointing_down(way if goal.position[0] >= cube.position[0] else -way)
        self.open()
        self.move_to(self.at([*(cube.position[:2] - BEHIND * way), z], q), CLOSE)
        self.close()
        end = self.at([*(goal.position[:2] - H * way), z], q)
        self.move_to(end, CLOSE)
        self.announce(end, OPEN)
        self.open()

    def hook(self, cube: Thing, goal: Thing, side: int | None = None) -> None:
        """Draw a cube to a goal with a peg that is held by its tail, then let go.

        Args:
            cube: what is moved.
            goal: where to.
            side: +1 if the gripper passes the cube on the right of the way (the peg reaches to the left), -1 for the
                other; by default the one that the cube's place asks for.
        """
        if side is None:
            side = 1 if cube.position[1] > goal.position[1] else -1
        way, z = _direction(cube, goal), cube.position[2]
        lateral = side * np.array([-way[1], way[0]])
        q, aside = pointing_down(lateral), HOOK_ASIDE * lateral
        self.move_to(self.at([*(cube.position[:2] - HOOK_BACK * way - aside), z], q))
        self.close()
        end = self.at([*(goal.position[:2] - HOOK_STOP * way - aside), z], q)
        self.move_to(end, CLOSE)
        self.announce(end, OPEN)
        self.open()

    def grasp_peg(self, peg: Peg, end: Thing | Literal["head", "tail"]) -> None:
        """Grasp a peg by one of its ends, `peg.head` or `peg.tail` (or its name), and lift it."""
        half: Thing = getattr(peg, end) if isinstance(end, str) else end
        self.open()
        grasp = sapien.Pose(half.position, turned(half.pose.q, "x", np.pi))
        self.move_to(self.at([*grasp.p[:2], ABOVE_PEG], grasp.q), OPEN)
        self.move_to(grasp, CLOSE)
        self.close()
        self.move_to(self.at([*grasp.p[:2], ABOVE_PEG], grasp.q), CLOSE)
        self.close()

    def insert_peg(
        self,
        peg: Peg,
        held: Thing | Literal["head", "tail"],
        side: int,
        box: Thing,
        until: Callable[[], bool] | None = None,
    ) -> None:
        """Put the free end of a held peg into the hole of a box.

        Args:
            peg: the peg.
            held: the end that is held; the other one goes in.
            side: +1 from the right (smaller y) as the robot sees it, -1 from the left.
            box: its hole runs along its x axis, which points to the left.
            until: asked after each step of the last motion, which ends when it is true.
        """
        head_first = (held if isinstance(held, str) else held.name) in ("tail", peg.tail.name)
        free = peg.head if head_first else peg.tail
        grip = free.pose.inv() * self.env.tcp_pose
        # Unturned, a peg that goes in head first comes from the hole's negative end, which is on the right.
        hole = box.pose if head_first == (side > 0) else sapien.Pose(box.pose.p, turned(box.pose.q, "z", np.pi))
        inserted = hole * grip
        outward = -1 if head_first else 1

        def station(along: float, raised: float = 0.0) -> sapien.Pose:
            return inserted * sapien.Pose([outward * along, 0, -raised])

        self.move_to(station(INSERT_FAR, INSERT_RAISED), CLOSE)
        self.move_to(station(INSERT_FAR), CLOSE)
        self.move_to(station(INSERT_NEAR))
        self.move_to(station(-INSERT_PAST), CLOSE, until)


def _direction(cube: Thing, goal: Thing) -> np.ndarray:
    way = goal.position[:2] - cube.position[:2]
    return way / np.linalg.norm(way)
