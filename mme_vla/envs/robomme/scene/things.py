"""Objects of a scene as the tasks use them: an entity with a name, a pose, and a pose to be
restored to.
"""

from typing import Any

import numpy as np
import sapien
from mani_skill.utils.structs import Actor
from sapien.render import RenderBodyComponent

AWAY = (10.0, 10.0, 10.0)
"""Where objects are kept while they are not in the scene."""
UNDER_THE_FLOOR = -5.0
"""Height below which nothing can be seen, metres."""


def pose_of(entity: Any) -> sapien.Pose:
    """Pose in the world of an `Actor` or a `Link`, straight from the simulator: tensors take fifty
    times as long.
    """
    simulated = entity._objs[0]
    return simulated.pose if isinstance(entity, Actor) else simulated.entity_pose


class Thing:
    """One object of a scene: a ManiSkill actor, or one link of an articulation.

    Args:
        name: unique in the scene.
        entity: the `Actor` or `Link` whose pose and pixels count.
    """

    def __init__(self, name: str, entity: Any) -> None:
        self.name = name
        self.entity = entity
        self._may_sink = isinstance(entity, Actor)
        self.initial_pose = self.pose
        """Where the object was put when the scene was built; `restore` brings it back there."""

    @property
    def pose(self) -> sapien.Pose:
        """Pose in the world."""
        return pose_of(self.entity)

    @property
    def position(self) -> np.ndarray:
        """Origin in the world [3], metres."""
        return np.asarray(self.pose.p)

    def move_to(self, pose: sapien.Pose) -> None:
        """Teleport the object, at rest."""
        self.entity.set_pose(pose)
        if self._may_sink:
            # Leave out of the images what the floor hides anyway: dozens of marks cost a third of
            # the rendering.
            visible = bool(pose.p[2] > UNDER_THE_FLOOR)
            body = self.entity._objs[0].find_component_by_type(RenderBodyComponent)
            if body is not None and bool(body.visibility) != visible:
                body.visibility = float(visible)
        if self.entity.px_body_type == "dynamic":
            self.entity.set_linear_velocity(np.zeros((1, 3), np.float32))
            self.entity.set_angular_velocity(np.zeros((1, 3), np.float32))

    def displace(self, pose: sapien.Pose) -> None:
        """Teleport the object in the midst of its motion: it keeps its velocity."""
        self.entity.set_pose(pose)

    def set_home(self, pose: sapien.Pose) -> None:
        """Make `pose` the place the object is restored to, and put it there."""
        self.initial_pose = pose
        self.move_to(pose)

    def restore(self) -> None:
        """Put the object where it was when the scene was built."""
        self.move_to(self.initial_pose)

    @property
    def segmentation_ids(self) -> list[int]:
        """Ids of the object's pixels in a segmentation image."""
        return [int(self.entity.per_scene_id[0])]


def distance_xy(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two points on the table, metres."""
    return float(np.linalg.norm(np.asarray(a)[:2] - np.asarray(b)[:2]))
