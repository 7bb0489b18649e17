"""Objects with joints: the button, and the peg with two ends."""

from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
from transforms3d.euler import euler2quat

from mme_vla.envs.robomme.scene.objects import RGB, XY, Shapes, at
from mme_vla.envs.robomme.scene.things import Thing, pose_of

if TYPE_CHECKING:
    from mme_vla.envs.robomme.scene.stage import Stage

BUTTON_SCALE = 1.5
BUTTON_BASE = (0.025 * BUTTON_SCALE, 0.025 * BUTTON_SCALE, 0.005 * BUTTON_SCALE)
"""Half sizes of a button's base, metres."""
BUTTON_TRAVEL = 0.1 * BUTTON_SCALE
CAP_RADIUS, CAP_HALF_LENGTH = 0.015 * BUTTON_SCALE, 0.006 * BUTTON_SCALE
CAP_COLOUR: RGB = (0.5, 0.5, 0.5)
BASE_DENSITY, CAP_DENSITY, PEG_DENSITY = 200_000.0, 1500.0, 1200.0
PEG_COLOUR: RGB = tuple((np.array([0xEC, 0x73, 0x57]) / 255) ** 2.2)
"""Both ends of the peg that pushes cubes."""
X_UP = euler2quat(0, -np.pi / 2, 0)


class Button(Thing):
    """A cap on a spring that is pressed down into its base; the cap's foot is its position and goes
    down with it.
    """

    def __init__(self, name: str, articulation: Any) -> None:
        self.articulation = articulation
        super().__init__(name, articulation.links_map["cap"])

    @property
    def pose(self) -> sapien.Pose:
        """Pose of the base in the world."""
        return pose_of(self.articulation.root)

    @property
    def position(self) -> np.ndarray:
        """Foot of the cap in the world [3], metres: above the centre of the base, lower while
        pressed.
        """
        return np.asarray(pose_of(self.entity).p)

    @property
    def depth(self) -> float:
        """How far the cap is pressed down, metres."""
        return max(0.0, -float(self.articulation.get_qpos()[0, 0]))

    def move_to(self, pose: sapien.Pose) -> None:
        """Put the button at a pose, released."""
        self.articulation.set_pose(pose)
        self.articulation.set_qpos(np.zeros((1, 1), np.float32))
        self.articulation.set_qvel(np.zeros((1, 1), np.float32))


class Peg(Thing):
    """A rod of two halves; its position is the middle of the head half, and the tail lies behind
    that along x.

    Args:
        length: of each half, metres.
        radius: half the thickness, metres.
    """

    def __init__(self, name: str, articulation: Any, length: float, radius: float) -> None:
        self.articulation, self.length, self.radius = articulation, length, radius
        super().__init__(name, articulation.links_map["head"])
        self.head = Thing(f"{name}_head", articulation.links_map["head"])
        self.tail = Thing(f"{name}_tail", articulation.links_map["tail"])

    @property
    def pose(self) -> sapien.Pose:
        """Pose of the head half in the world."""
        return pose_of(self.articulation.root)

    def move_to(self, pose: sapien.Pose) -> None:
        self.articulation.set_pose(pose)
        self.articulation.set_root_linear_velocity(np.zeros((1, 3), np.float32))
        self.articulation.set_root_angular_velocity(np.zeros((1, 3), np.float32))

    def displace(self, pose: sapien.Pose) -> None:
        self.articulation.set_pose(pose)

    @property
    def segmentation_ids(self) -> list[int]:
        return self.head.segmentation_ids + self.tail.segmentation_ids


def build_button(env: "Stage", xy: XY, name: str = "button") -> Button:
    """A button on the table."""
    builder = env.scene.create_articulation_builder()
    base = builder.create_link_builder()
    base.set_name("base")
    Shapes(env, base).solid_box(BUTTON_BASE, None, density=BASE_DENSITY)
    cap = builder.create_link_builder(parent=base)
    cap.set_name("cap")
    cap.set_joint_name("press")
    cap.set_joint_properties(
        type="prismatic",
        limits=[[-BUTTON_TRAVEL, 0.0]],
        pose_in_parent=sapien.Pose([0, 0, BUTTON_BASE[2]], X_UP),
        pose_in_child=sapien.Pose(q=X_UP),
    )
    middle = sapien.Pose([0, 0, CAP_HALF_LENGTH], X_UP)
    Shapes(env, cap).cylinder(
        CAP_RADIUS, CAP_HALF_LENGTH, CAP_COLOUR, middle, collision=True, density=CAP_DENSITY
    )
    builder.initial_pose = at(xy, BUTTON_BASE[2])
    articulation = builder.build(name, fix_root_link=True)
    joint = articulation.active_joints[0]
    joint.set_drive_properties(stiffness=800.0, damping=40.0)
    joint.set_drive_target(np.zeros((1, 1), np.float32))
    return Button(name, articulation)


def build_peg(
    env: "Stage",
    name: str,
    length: float,
    radius: float,
    head_colour: RGB,
    tail_colour: RGB,
    xy: XY,
    yaw: float,
    z: float = 0.0,
) -> Peg:
    """A peg on the table.

    Args:
        length: of each half, metres.
        radius: half the thickness, metres.
        xy: middle of the head half.
        yaw: radians.
        z: height of the middle.
    """
    half, touched = [length / 2, radius, radius], [0.9 * length / 2, radius, radius]
    builder = env.scene.create_articulation_builder()
    head = builder.create_link_builder()
    head.set_name("head")
    Shapes(env, head).box(half, head_colour, collision=touched, density=PEG_DENSITY, glossy=True)
    tail = builder.create_link_builder(parent=head)
    tail.set_name("tail")
    tail.set_joint_name("middle")
    tail.set_joint_properties(
        type="fixed",
        limits=[],
        pose_in_parent=sapien.Pose([-length, 0, 0]),
        pose_in_child=sapien.Pose(),
    )
    Shapes(env, tail).box(half, tail_colour, collision=touched, density=PEG_DENSITY, glossy=True)
    builder.initial_pose = at(xy, z, yaw)
    return Peg(name, builder.build(name, fix_root_link=False), length, radius)
