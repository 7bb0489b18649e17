"""Objects of a scene as the tasks use them, and the predicates on them. Thresholds are the benchmark's."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
from mani_skill.utils.structs import Actor
from sapien.render import RenderBodyComponent

if TYPE_CHECKING:
    from mme_vla.envs.scene.articulated import Button
    from mme_vla.envs.task import Task


AWAY = (10.0, 10.0, 10.0)
"""Where objects are kept while they are not in the scene."""
UNDER_THE_FLOOR = -5.0
"""Height below which nothing can be seen, metres."""


def pose_of(entity: Any) -> sapien.Pose:
    """Pose in the world of an `Actor` or a `Link`, straight from the simulator: tensors take fifty times as long."""
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
        self._initial = self.pose

    @property
    def pose(self) -> sapien.Pose:
        """Pose in the world."""
        return pose_of(self.entity)

    @property
    def position(self) -> np.ndarray:
        """Origin in the world [3], metres."""
        return np.asarray(self.pose.p)

    @property
    def initial_pose(self) -> sapien.Pose:
        """Where the object was put when the scene was built; `restore` brings it back there."""
        return self._initial

    def move_to(self, pose: sapien.Pose) -> None:
        """Teleport the object, at rest."""
        self.entity.set_pose(pose)
        self._draw(pose.p[2] > UNDER_THE_FLOOR)
        if self.entity.px_body_type == "dynamic":
            self.entity.set_linear_velocity(np.zeros((1, 3), np.float32))
            self.entity.set_angular_velocity(np.zeros((1, 3), np.float32))

    def show(self) -> None:
        """Draw the object, or leave it out, as its height says: due where its pose was set from outside."""
        self._draw(bool(self.position[2] > UNDER_THE_FLOOR))

    def _draw(self, visible: bool) -> None:
        """Leave out of the images what the floor hides anyway: dozens of marks cost a third of the rendering."""
        body = self.entity._objs[0].find_component_by_type(RenderBodyComponent) if self._may_sink else None
        if body is not None and bool(body.visibility) != visible:
            body.visibility = float(visible)

    def displace(self, pose: sapien.Pose) -> None:
        """Teleport the object in the midst of its motion: it keeps its velocity."""
        self.entity.set_pose(pose)

    def move_away(self) -> None:
        """Take the object out of the scene, keeping its orientation."""
        self.move_to(sapien.Pose(AWAY, self.pose.q))

    def set_home(self, pose: sapien.Pose) -> None:
        """Make `pose` the place the object is restored to, and put it there."""
        self._initial = pose
        self.move_to(pose)

    def restore(self) -> None:
        """Put the object where it was when the scene was built."""
        self.move_to(self._initial)

    @property
    def segmentation_ids(self) -> list[int]:
        """Ids of the object's pixels in a segmentation image."""
        return [int(self.entity.per_scene_id[0])]


def distance_xy(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two points on the table, metres."""
    return float(np.linalg.norm(np.asarray(a)[:2] - np.asarray(b)[:2]))


PICKED_UP_Z = 0.05
CONTAINER_PICKED_UP_Z = 0.15
ON_TARGET = 0.05
PUSHED_ONTO = 0.048
PRESSED = 0.005
"""How far a button must be held down, metres."""
FINGER_OPEN = 0.02


def picked_up(env: "Task", thing: Thing) -> bool:
    """A cube or a peg's end is grasped and off the table."""
    return thing.position[2] > PICKED_UP_Z and env.is_grasping(thing)


def any_picked_up(env: "Task", things: Iterable[Thing]) -> bool:
    """Whether one of the objects is picked up."""
    return any(picked_up(env, thing) for thing in things)


def container_picked_up(container: Thing) -> bool:
    """A container is lifted high."""
    return container.position[2] > CONTAINER_PICKED_UP_Z


def container_put_down(env: "Task", container: Thing) -> bool:
    """A container stands on the table again and the gripper has left it."""
    return container.position[2] <= 0.07 and not env.is_grasping(container) and env.tcp_pose.p[2] > 0.05


def dropped(env: "Task", thing: Thing) -> bool:
    """The object was let go: near the table. While recording it may still be falling, if the gripper is away."""
    z = thing.position[2]
    low = (z <= 0.2 and env.tcp_pose.p[2] > 0.05) if env.recording else z <= 0.035
    return bool(low) and not env.is_grasping(thing)


def dropped_onto(env: "Task", thing: Thing, target: Thing) -> bool:
    """The object was released on the target."""
    return distance_xy(thing.position, target.position) <= ON_TARGET and dropped(env, thing)


def pushed_onto(thing: Thing, target: Thing) -> bool:
    """The object is on the target, held or not."""
    return distance_xy(thing.position, target.position) <= PUSHED_ONTO


def over(position: np.ndarray, target: Thing, distance: float = 0.01, height: float = 0.1) -> bool:
    """A point, such as the tool's, is above the target and not too high."""
    return distance_xy(position, target.position) <= distance and bool(position[2] < height)


def pressed(button: "Button") -> bool:
    """The button is held down at this time step."""
    return button.depth > PRESSED


def hovering(env: "Task", button: "Button") -> bool:
    """The tool is above the button, low."""
    tcp = env.tcp_pose.p
    return distance_xy(tcp, button.position) <= 0.03 and bool(tcp[2] < 0.2)


def gripper_open(env: "Task") -> bool:
    """Both fingers are apart."""
    return bool((env.fingers > FINGER_OPEN).all())


def released_and_away(env: "Task", thing: Thing) -> bool:
    """The gripper is open and has left the object."""
    return gripper_open(env) and float(np.linalg.norm(env.tcp_pose.p - thing.position)) > 0.02


def reset_reached(env: "Task", reference: np.ndarray, tolerance: float = 0.01) -> bool:
    """The arm is back at the reference joint positions [n], radians."""
    return float(np.abs(env.qpos[: len(reference)] - reference).max()) < tolerance


class StaticFor:
    """True once the arm has stood still for a number of steps; asked once a step."""

    LIMIT = 0.2
    """Joint velocity above which the arm moves, rad/s."""

    def __init__(self, env: "Task", steps: int) -> None:
        self._env, self._steps = env, steps
        self._since: int | None = None

    def __call__(self) -> bool:
        now = self._env.steps_done
        velocity = self._env.agent.robot.get_qvel()[0, :-2]
        if self._since is None or float(velocity.abs().max()) > self.LIMIT:
            self._since = now
        return now - self._since >= self._steps
