"""How the gripper takes hold of a thing: from above, across its narrower side."""

import numpy as np
from mani_skill.utils.geometry.trimesh_utils import get_component_mesh
from sapien import physx
from scipy.spatial.transform import Rotation

from mme_vla.envs.scene.draws import Draws
from mme_vla.envs.scene.things import Thing

DOWN = np.array([0.0, 0.0, -1.0])
DOWNWARD_Q = (0.0, 1.0, 0.0, 0.0)
"""The gripper straight down, its x axis along the world's (roll pi); wxyz."""
SQUARE = 0.01
"""Two sides whose ratio is within this of 1 are equally good to grasp."""


def grasp_orientation(thing: Thing, closing: np.ndarray) -> np.ndarray:
    """Orientation of the tool for grasping an object from above.

    The fingers close along the shorter of the two horizontal axes of the object's smallest bounding box; where these
    are equal, along the one nearer to how the fingers stand now.

    Args:
        thing: an actor with collision shapes.
        closing: the direction the fingers close along now, [3].

    Returns:
        Quaternion [4], wxyz.
    """
    body = thing.entity._objs[0].find_component_by_type(physx.PhysxRigidDynamicComponent)
    box = get_component_mesh(body).bounding_box_oriented.primitive
    axes, extents = np.array(box.transform)[:3, :3].T, np.array(box.extents)
    first, second = np.argsort(np.abs(axes @ DOWN))[:2]
    if extents[second] < extents[first]:
        first, second = second, first
    if extents[first] / extents[second] > 1 - SQUARE and abs(closing @ axes[second]) > abs(closing @ axes[first]):
        first = second
    across = axes[first] * (1 if closing @ axes[first] >= 0 else -1)
    across = across - (across @ DOWN) * DOWN
    return pointing_down(np.cross(across, DOWN))


def pointing_down(forward: np.ndarray) -> np.ndarray:
    """Orientation wxyz of a gripper that points down, its x axis along a horizontal direction [2] or [3]."""
    x = np.array([forward[0], forward[1], 0.0])
    x /= np.linalg.norm(x)
    return wxyz(Rotation.from_matrix(np.stack([x, np.cross(DOWN, x), DOWN], axis=1)))


def turned(q: np.ndarray, axis: str, angle: float) -> np.ndarray:
    """An orientation wxyz turned about one of its own axes by an angle in radians."""
    return wxyz(Rotation.from_quat(np.roll(q, -1)) * Rotation.from_euler(axis, angle))


def wxyz(rotation: Rotation) -> np.ndarray:
    """A rotation as a quaternion [4], scalar first."""
    return np.roll(rotation.as_quat(), 1)


def failing_offset(mode: str, distance: float, seed: int) -> np.ndarray:
    """Where a grasp that is to fail goes instead, relative to the right place [3].

    Args:
        mode: `z` closes too high, `xy` beside the object.
        distance: metres, along each axis that is missed.
        seed: the episode's; draws the direction of `xy`.
    """
    if mode == "z":
        return np.array([0.0, 0.0, distance])
    draws, signs = Draws(seed), (0, 0)
    while signs == (0, 0):
        signs = (draws.integer(-1, 2), draws.integer(-1, 2))
    return distance * np.array([*signs, 0.0])
