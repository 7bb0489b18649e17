"""Objects without joints, and how each is built; without a renderer they have no visual shapes.

`env` is the task whose scene an object goes into, `name` is unique in it, `xy` is the centre on the
table. Lengths are in metres, angles in radians, colours RGB in 0 … 1.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
import sapien.render
import torch
from transforms3d.euler import euler2quat

from mme_vla.envs.robomme.scene.arithmetic import square_root
from mme_vla.envs.robomme.scene.things import Thing

if TYPE_CHECKING:
    from mme_vla.envs.robomme.scene.stage import Stage


type RGB = tuple[float, float, float]
type XY = Sequence[float] | np.ndarray
"""A place on the table [2] (or [3], whose height does not count), metres."""

DENSITY = 1000.0  # kg/m³
BELOW_TABLE = (0.0, 0.0, -10.0)
"""Where things that are only shown at times wait."""
UPRIGHT = tuple(euler2quat(0, np.pi / 2, 0))
"""Turns a cylinder, whose axis is x, upright; wxyz."""


def at(xy: XY, z: float, yaw: float = 0.0) -> sapien.Pose:
    """Pose on the table, turned about the vertical; metres and radians."""
    return sapien.Pose([float(xy[0]), float(xy[1]), z], euler2quat(0, 0, np.float32(yaw)))


class Shapes:
    """Adds shapes to an actor's or a link's builder.

    Args:
        env: whose scene the object goes into.
        builder: collects the shapes; by default that of a new actor.
    """

    def __init__(self, env: "Stage", builder: Any = None) -> None:
        self._visible = env.scene.can_render()
        self._builder = env.scene.create_actor_builder() if builder is None else builder

    def box(
        self,
        half_size: Sequence[float],
        colour: RGB | None,
        centre: Sequence[float] = (0, 0, 0),
        collision: Sequence[float] | None = None,
        density: float = DENSITY,
        glossy: bool = False,
    ) -> "Shapes":
        """A box to be seen, and, with half sizes `collision`, to be touched; no colour is white."""
        pose = sapien.Pose(centre)
        if collision is not None:
            self._builder.add_box_collision(pose, half_size=tuple(collision), density=density)
        if self._visible:
            self._builder.add_box_visual(
                pose, half_size=tuple(half_size), material=_material(colour, glossy)
            )
        return self

    def solid_box(self, half_size: Sequence[float], colour: RGB | None, **options: Any) -> "Shapes":
        """A box that is touched where it is seen."""
        return self.box(half_size, colour, collision=half_size, **options)

    def cylinder(
        self,
        radius: float,
        half_length: float,
        colour: RGB,
        pose: sapien.Pose | None = None,
        collision: bool = False,
        density: float = DENSITY,
    ) -> "Shapes":
        """A cylinder along the x axis of `pose`, by default in the object's own frame."""
        pose = pose or sapien.Pose()
        if collision:
            self._builder.add_cylinder_collision(pose, radius, half_length, density=density)
        if self._visible:
            self._builder.add_cylinder_visual(pose, radius, half_length, _material(colour))
        return self

    def sphere(self, radius: float, colour: RGB) -> "Shapes":
        """A ball to be seen."""
        if self._visible:
            self._builder.add_sphere_visual(radius=radius, material=_material(colour))
        return self

    def rings(self, radius: float, half_length: float, colour: RGB) -> "Shapes":
        """Five cylinders one in the other, of the colour and white by turns; inner ones are a
        little longer.
        """
        for k, ring_colour in enumerate((colour, WHITE, colour, WHITE, colour)):
            self.cylinder(radius * (1 - 0.2 * k), half_length + k * 1e-5, ring_colour)
        return self

    def build(self, name: str, pose: sapien.Pose, kinematic: bool = False) -> Any:
        """The actor, at its pose; a kinematic one moves only when told to."""
        self._builder.set_initial_pose(pose)
        if kinematic:
            return self._builder.build_kinematic(name)
        return self._builder.build(name)


def _material(colour: RGB | None, glossy: bool = False) -> sapien.render.RenderMaterial:
    material = sapien.render.RenderMaterial()
    if colour is not None:
        material.base_color = [*colour, 1.0]
    if glossy:
        material.roughness = material.specular = 0.5
    return material


H = 0.02
"""Half the edge of a cube, metres."""
HIDDEN_H = H / 1.2
"""Half the edge of a cube that fits under a container."""
COLOURS: dict[str, RGB] = {
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
    "yellow": (1.0, 1.0, 0.0),
    "cyan": (0.0, 1.0, 1.0),
    "magenta": (1.0, 0.0, 1.0),
    "orange": (1.0, 0.5, 0.0),
}
"""Colours of cubes; all but the first three are those of cubes that are in the way."""
TARGET_COLOURS: dict[str, RGB] = {
    "purple": (160 / 255, 32 / 255, 240 / 255),
    "gray": (128 / 255, 128 / 255, 128 / 255),
    "green": (34 / 255, 139 / 255, 34 / 255),
}
"""Colours of targets."""
WHITE: RGB = (1.0, 1.0, 1.0)
BROWN: RGB = (0.8, 0.6, 0.4)

CONTAINER_Z = 0.052
"""Height of a container's origin, the middle of its handle, when it stands on the table."""
CONTAINER_INNER, CONTAINER_WALL, CONTAINER_HEIGHT, CONTAINER_LID = 2.5 * H, 0.005, 0.05, 0.004
CONTAINER_OUTER = CONTAINER_INNER + 2 * CONTAINER_WALL
BOARD_SIDE, BOARD_HOLE, BOARD_HEIGHT = 0.1, 0.08, 0.05
APERTURE_Z = 0.04
"""Height of the middle of the box with an aperture."""
APERTURE_COLOUR: RGB = tuple((np.array([0xFF, 0xD2, 0x89]) / 255) ** 2.2)


class Cube(Thing):
    """A cube of one colour, which is a name or RGB."""

    def __init__(self, name: str, entity: Any, colour: str | RGB) -> None:
        super().__init__(name, entity)
        self.colour = colour


class Disc(Thing):
    """A flat round target; its axis is the actor's x axis."""

    def __init__(self, name: str, entity: Any, radius: float) -> None:
        super().__init__(name, entity)
        self.radius = radius


class Container(Thing):
    """A box open below, with a handle on top; its origin is the middle of the handle."""


class Board(Thing):
    """A low square frame on the table; things thrown into its hole cannot be seen."""


def cube_pose(xy: XY, yaw: float, half_size: float = H) -> sapien.Pose:
    """Pose of a cube on the table, turned in single precision, as in the benchmark.

    The last bit of its quaternion decides the order of the axes of its bounding box, and so where
    the next object is placed.
    """
    return sapien.Pose([float(xy[0]), float(xy[1]), half_size], quaternion_about_z(yaw))


def quaternion_about_z(yaw: float) -> np.ndarray:
    """Quaternion wxyz of a turn about the vertical, float32 [4], w not negative.

    It is taken from the entries of the rotation matrix, in the order of operations in which
    ManiSkill takes it from a matrix of tensors: the larger of w and z by its square, the other one
    by the off-diagonal entries.
    """
    angle = torch.tensor(yaw)
    cos, sin = np.float32(angle.cos().item()), np.float32(angle.sin().item())
    one, two, zero = np.float32(1), np.float32(2), np.float32(0)
    w_squared, z_squared = one + cos + cos + one, one - cos - cos + one  # four times the squares
    w = square_root(w_squared) if w_squared > 0 else zero
    z = square_root(z_squared) if z_squared > 0 else zero
    if w >= z:
        quaternion = np.array([w * w, zero, zero, sin + sin]) / (two * w)
    else:
        quaternion = np.array([sin + sin, zero, zero, z * z]) / (two * z)
    return -quaternion if quaternion[0] < 0 else quaternion


def build_cube(
    env: "Stage", name: str, colour: str | RGB, xy: XY, yaw: float = 0.0, half_size: float = H
) -> Cube:
    """A cube lying on the table."""
    rgb = COLOURS[colour] if isinstance(colour, str) else colour
    actor = Shapes(env).solid_box([half_size] * 3, rgb).build(name, cube_pose(xy, yaw, half_size))
    return Cube(name, actor, colour)


def build_hidden_cube(env: "Stage", name: str, colour: str, xy: XY) -> Cube:
    """A smaller cube, as it lies under a container."""
    return build_cube(env, name, colour, xy, half_size=HIDDEN_H)


def build_moving_cube(env: "Stage", name: str, colour: RGB, xy: XY, z: float) -> Cube:
    """A cube that nothing can touch and that moves only when told to."""
    actor = Shapes(env).box([H] * 3, colour).build(name, at(xy, z), kinematic=True)
    return Cube(name, actor, colour)


def build_disc(
    env: "Stage",
    name: str,
    radius: float,
    thickness: float,
    colour: str,
    xy: XY,
    z: float | None = None,
) -> Disc:
    """A target without collision: five rings, alternately of a colour of `TARGET_COLOURS` and
    white.

    Args:
        z: height of the centre; by default the thickness.
    """
    if z is None:
        z = thickness
    pose = sapien.Pose([float(xy[0]), float(xy[1]), z], UPRIGHT)
    rings = Shapes(env).rings(radius, thickness / 2, TARGET_COLOURS[colour])
    return Disc(name, rings.build(name, pose, kinematic=True), radius)


def build_highlight(
    env: "Stage",
    name: str,
    radius: float,
    half_length: float,
    colour: RGB = WHITE,
    rings: bool = False,
) -> Disc:
    """A disc that marks something for a while; it waits below the table. With `rings` it looks like
    a target.
    """
    shapes = Shapes(env)
    if rings:
        shapes.rings(radius, half_length, colour)
    else:
        shapes.cylinder(radius, half_length, colour)
    return Disc(name, shapes.build(name, sapien.Pose(BELOW_TABLE, UPRIGHT), kinematic=True), radius)


def build_sphere(env: "Stage", name: str, radius: float, colour: RGB = WHITE) -> Thing:
    """A ball that nothing can touch; it waits below the table."""
    shapes = Shapes(env).sphere(radius, colour)
    return Thing(name, shapes.build(name, sapien.Pose(BELOW_TABLE), kinematic=True))


def build_container(env: "Stage", name: str, xy: XY, yaw: float = 0.0) -> Container:
    """A container standing on the table, opening down."""
    wall, lid = CONTAINER_WALL / 2, CONTAINER_LID / 2
    middle = CONTAINER_INNER / 2 + wall
    # In the actor's own frame the opening is up: heights count downwards from the handle's middle.
    rim = CONTAINER_Z - CONTAINER_HEIGHT / 2
    # Walls and lid end at the middle of the wall they meet. Where a container settles depends on
    # that and on the order.
    shapes = Shapes(env).solid_box([H] * 3, None)
    for side in (-1, 1):
        shapes.solid_box([wall, middle, CONTAINER_HEIGHT / 2], None, centre=[side * middle, 0, rim])
        shapes.solid_box([middle, wall, CONTAINER_HEIGHT / 2], None, centre=[0, side * middle, rim])
    shapes.solid_box([middle, middle, lid], None, centre=[0, 0, lid])
    # Turned about its own vertical, which then points down: seen from above the turn goes the other
    # way.
    upside_down = sapien.Pose(q=euler2quat(np.pi, 0, 0))
    pose = at(xy, CONTAINER_Z) * upside_down * sapien.Pose(q=euler2quat(0, 0, yaw))
    return Container(name, shapes.build(name, pose))


def build_board(env: "Stage", xy: XY, yaw: float = 0.0, name: str = "board") -> Board:
    """The frame with a hole; a black block hides the lower half of the hole."""
    side, hole, height = BOARD_SIDE / 2, BOARD_HOLE / 2, BOARD_HEIGHT / 2
    strip = (side - hole) / 2
    shapes = Shapes(env)
    for sign in (-1, 1):
        shapes.solid_box([side, strip, height], BROWN, centre=[0, sign * (hole + strip), 0])
        shapes.solid_box([strip, hole, height], BROWN, centre=[sign * (hole + strip), 0, 0])
    shapes.box([hole, hole, height / 2], (0.0, 0.0, 0.0), centre=[0, 0, -height / 2])
    return Board(name, shapes.build(name, at(xy, height, yaw), kinematic=True))


def build_aperture_box(env: "Stage", xy: XY, yaw: float, name: str = "box") -> Thing:
    """A box with a square hole along its x axis, standing on the table."""
    inner, outer = 0.017, 0.04  # half the widths of the hole and of the box
    half_depth = 0.05
    wall = (outer - inner) / 2
    shapes = Shapes(env)
    for sign in (-1, 1):
        offset = sign * (inner + wall)
        shapes.solid_box(
            [half_depth, wall, outer], APERTURE_COLOUR, centre=[0, offset, 0], glossy=True
        )
        shapes.solid_box(
            [half_depth, outer, wall], APERTURE_COLOUR, centre=[0, 0, offset], glossy=True
        )
    return Thing(name, shapes.build(name, at(xy, APERTURE_Z, yaw), kinematic=True))


def build_obstacle(env: "Stage", name: str, xy: XY, yaw: float, colour: RGB) -> Thing:
    """An upright block, thin along its y axis, to be circled around."""
    half = [0.03, 0.015, 0.05]
    shapes = Shapes(env).solid_box(half, colour)
    return Thing(name, shapes.build(name, at(xy, half[2], yaw), kinematic=True))
