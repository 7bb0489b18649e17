"""Primitives of the gripper: pick, place, put down, drop, press, hover; and the orientations they
need.
"""

from collections.abc import Sequence

import numpy as np
import sapien
from mani_skill.utils.geometry.trimesh_utils import get_component_mesh
from sapien import physx
from scipy.spatial.transform import Rotation

from mme_vla.envs.robomme.robot.control import CLOSE, OPEN, RobotControl
from mme_vla.envs.robomme.scene.articulated import Button
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.scene.things import Thing

DOWN = np.array([0.0, 0.0, -1.0])
DOWNWARD_Q = (float(np.cos(np.float32(np.pi / 2))), 1.0, 0.0, 0.0)
"""The gripper straight down, its x axis along the world's (roll pi in single precision, as
recorded); wxyz.
"""
SQUARE = 0.01
"""Two sides whose ratio is within this of 1 are equally good to grasp."""


def grasp_orientation(thing: Thing, closing: np.ndarray) -> np.ndarray:
    """Orientation of the tool for grasping an object from above.

    The fingers close along the shorter of the two horizontal axes of the object's smallest bounding
    box; where these are equal, along the one nearer to `closing`, their present direction [3].
    Returns a quaternion [4], wxyz.
    """
    body = thing.entity._objs[0].find_component_by_type(physx.PhysxRigidDynamicComponent)
    box = get_component_mesh(body).bounding_box_oriented.primitive
    axes, extents = np.array(box.transform)[:3, :3].T, np.array(box.extents)
    first, second = np.argsort(np.abs(axes @ DOWN))[:2]
    if extents[second] < extents[first]:
        first, second = second, first
    is_square = extents[first] / extents[second] > 1 - SQUARE
    if is_square and abs(closing @ axes[second]) > abs(closing @ axes[first]):
        first = second
    across = axes[first]
    if closing @ across < 0:
        across = -across
    across = across - (across @ DOWN) * DOWN
    across /= np.linalg.norm(across)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([np.cross(across, DOWN), across, DOWN], axis=1)
    return sapien.Pose(frame).q


def pointing_down(forward: np.ndarray) -> np.ndarray:
    """Orientation wxyz of a gripper that points down, its x axis along a horizontal direction [2]
    or [3].
    """
    x = np.array([forward[0], forward[1], 0.0])
    x /= np.linalg.norm(x)
    rotation = Rotation.from_matrix(np.stack([x, np.cross(DOWN, x), DOWN], axis=1))
    return np.roll(rotation.as_quat(), 1)


def turned(q: np.ndarray, axis: str, angle: float) -> np.ndarray:
    """An orientation wxyz turned about one of its own axes by an angle in radians."""
    rotation = Rotation.from_euler(axis, angle)
    return (sapien.Pose(q=q) * sapien.Pose(q=np.roll(rotation.as_quat(), 1))).q


def failing_offset(mode: str, distance: float, seed: int) -> np.ndarray:
    """Offset [3] of a grasp that is to fail, `distance` metres along each axis that is missed.

    `z` closes too high, `xy` beside the object, in a direction that the seed decides.
    """
    if mode == "z":
        return np.array([0.0, 0.0, distance])
    draws = Draws(seed)
    signs = (0, 0)
    while signs == (0, 0):
        signs = (draws.integer(-1, 2), draws.integer(-1, 2))
    return distance * np.array([*signs, 0.0])


ABOVE, ABOVE_CONTAINER, ABOVE_BOARD = 0.15, 0.2, 0.2
"""Heights of the tool before and after a grasp or a release, metres."""
HANDLE = 0.01
"""How far above a container's origin its handle is grasped, metres."""
LIFTED = 0.02
"""How far a thing has risen at least when it was grasped, metres."""
MISS, MISS_CONTAINER = 0.04, 0.035
"""How far a grasp that is to fail misses, metres."""


class GripperPrimitives(RobotControl):
    """The primitives of tasks in which things are grasped and buttons pressed."""

    fail_next_pick: str | None = None
    """`z` or `xy`: the next `pick` or `pick_container` fails once before it succeeds; that clears
    it.
    """

    def pick(self, thing: Thing) -> None:
        """Grasp a cube on the table and lift it."""
        self._grasp(thing, ABOVE, depth=0.0, miss=MISS)

    def pick_container(self, thing: Thing) -> None:
        """Grasp a container by its handle and lift it."""
        self._grasp(thing, ABOVE_CONTAINER, depth=HANDLE, miss=MISS_CONTAINER)

    def place_on(self, target: Thing, z: float | None = None) -> None:
        """Put what is held on a target, and withdraw.

        Args:
            z: height of the tool at the release, metres; by default the target's own.
        """
        if z is None:
            z = target.position[2]
        q = self.env.tcp_pose.q
        above = self._over(target, ABOVE, q)
        below = self._over(target, z, q)
        self.move_to(above, CLOSE)
        self.move_to(below, OPEN)
        self.open()
        self.move_to(above, OPEN)

    def put_down(self, release_z: float = 0.07) -> None:
        """Lower what is held straight down to a height of the tool in metres, let go,
        and withdraw.
        """
        here = self.env.tcp_pose
        self.move_to(self.at([*here.p[:2], release_z], here.q), OPEN)
        self.open()
        self.move_to(self.at([*self.env.tcp_pose.p[:2], ABOVE], here.q))

    def drop_into_bin(self, board: Thing) -> None:
        """Let what is held fall into the hole of a board, and withdraw."""
        over = self._over(board, ABOVE_BOARD, self.env.tcp_pose.q)
        self.move_to(over, CLOSE)
        self.announce(over, OPEN)
        self.open()
        self.move_to(sapien.Pose(over.p - [0.1, 0, 0], over.q))

    def move_over(self, target: Thing, z: float) -> None:
        """Carry what is held over a target, the tool at height `z` in metres."""
        self.move_to(self._over(target, z, self.env.tcp_pose.q), CLOSE)

    def press(self, button: Button, hold: bool = True, close: bool = True) -> None:
        """Press a button with closed fingers and let it go.

        Args:
            hold: first move above it; without, the tool is there already.
            close: close the fingers first; without, they are closed already and time is short.
        """
        above = self._over(button, ABOVE, DOWNWARD_Q)
        if hold:
            self.move_to(above, OPEN)
        if close:
            self.announce(above, CLOSE)
            self.close()
        self.move_to(self._over(button, float(button.pose.p[2]), DOWNWARD_Q), CLOSE)
        self.move_to(above, CLOSE)

    def hover(self, button: Button) -> None:
        """Move above a button and close the fingers."""
        self.move_to(self._over(button, ABOVE, DOWNWARD_Q), CLOSE)
        self.close()

    def _grasp(self, thing: Thing, above: float, depth: float, miss: float) -> None:
        self.open()
        mode = self.fail_next_pick
        if mode is not None:
            self.fail_next_pick = None
            # Close the fingers where the object is not, and come back up.
            grasp = self._grasp_pose(thing, depth)
            offset = failing_offset(mode, miss, self.env.seed)
            wrong = sapien.Pose(grasp.p + offset, grasp.q)
            over = self.at([*wrong.p[:2], above], grasp.q)
            self.open()
            self.move_to(over, OPEN)
            self.move_to(wrong, CLOSE)
            self.close()
            self.move_to(over, OPEN)
            self.open()
        grasp = self._grasp_pose(thing, depth)
        initial_height = thing.position[2]
        self._grasp_at(grasp, thing, above)
        if self.env.second_tries and thing.position[2] - initial_height < LIFTED:
            # A finger was blocked: once more, across the other sides.
            self.open()
            grasp = self._grasp_pose(thing, depth)
            self._grasp_at(sapien.Pose(grasp.p, turned(grasp.q, "z", np.pi / 2)), thing, above)

    def _grasp_at(self, grasp: sapien.Pose, thing: Thing, above: float) -> None:
        self.move_to(self.at([*grasp.p[:2], above], grasp.q), OPEN)
        self.open()
        self.move_to(grasp, CLOSE)
        self.close()
        self.move_to(self.at([*thing.position[:2], above], grasp.q), CLOSE)

    def _grasp_pose(self, thing: Thing, depth: float) -> sapien.Pose:
        closing = self.env.tcp_pose.to_transformation_matrix()[:3, 1]
        place = thing.position + np.array([0, 0, depth])
        return sapien.Pose(place, grasp_orientation(thing, closing))

    @staticmethod
    def _over(target: Thing, z: float, q: np.ndarray | Sequence[float]) -> sapien.Pose:
        return sapien.Pose([*target.position[:2], z], q)
