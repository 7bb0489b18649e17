"""Boxes, cylinders and spheres for the builders of objects; what is only to be seen is left out without a renderer."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
import sapien.render
from transforms3d.euler import euler2quat

if TYPE_CHECKING:
    from mme_vla.envs.scene.stage import Stage

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
    return sapien.Pose([float(xy[0]), float(xy[1]), z], euler2quat(0, 0, yaw))


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
            self._builder.add_box_visual(pose, half_size=tuple(half_size), material=_material(colour, glossy))
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
        """Five cylinders one in the other, of the colour and white by turns; inner ones are a little longer."""
        for k in range(5):
            self.cylinder(radius * (1 - 0.2 * k), half_length + k * 1e-5, colour if k % 2 == 0 else (1.0, 1.0, 1.0))
        return self

    def build(self, name: str, pose: sapien.Pose, kinematic: bool = False) -> Any:
        """The actor, at its pose; a kinematic one moves only when told to."""
        self._builder.set_initial_pose(pose)
        return self._builder.build_kinematic(name) if kinematic else self._builder.build(name)


def _material(colour: RGB | None, glossy: bool = False) -> sapien.render.RenderMaterial:
    material = sapien.render.RenderMaterial()
    if colour is not None:
        material.base_color = [*colour, 1.0]
    if glossy:
        material.roughness = material.specular = 0.5
    return material
