"""Predicates on objects and the robot: picked up, dropped, pressed, over, static. Thresholds are
the benchmark's.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from mme_vla.envs.robomme.scene.things import Thing, distance_xy

if TYPE_CHECKING:
    from mme_vla.envs.robomme.scene.articulated import Button
    from mme_vla.envs.robomme.scene.stage import Stage

PICKED_UP_Z = 0.05
CONTAINER_PICKED_UP_Z = 0.15
ON_TARGET = 0.05
PUSHED_ONTO = 0.048
PRESSED = 0.005
"""How far a button must be held down, metres."""
FINGER_OPEN = 0.02


def picked_up(env: "Stage", thing: Thing) -> bool:
    """A cube or a peg's end is grasped and off the table."""
    return thing.position[2] > PICKED_UP_Z and env.is_grasping(thing)


def any_picked_up(env: "Stage", things: Iterable[Thing]) -> bool:
    """Whether one of the objects is picked up."""
    return any(picked_up(env, thing) for thing in things)


def container_picked_up(container: Thing) -> bool:
    """A container is lifted high."""
    return container.position[2] > CONTAINER_PICKED_UP_Z


def container_put_down(env: "Stage", container: Thing) -> bool:
    """A container stands on the table again and the gripper has left it."""
    return (
        container.position[2] <= 0.07
        and not env.is_grasping(container)
        and env.tcp_pose.p[2] > 0.05
    )


def dropped(env: "Stage", thing: Thing) -> bool:
    """The object was let go: near the table. While recording it may still be falling, if the
    gripper is away.
    """
    highest = 0.2 if env.recording else 0.035
    if thing.position[2] > highest:
        return False
    if env.recording and env.tcp_pose.p[2] <= 0.05:
        return False
    return not env.is_grasping(thing)


def dropped_onto(env: "Stage", thing: Thing, target: Thing) -> bool:
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


def hovering(env: "Stage", button: "Button") -> bool:
    """The tool is above the button, low."""
    tcp = env.tcp_pose.p
    return distance_xy(tcp, button.position) <= 0.03 and bool(tcp[2] < 0.2)


def gripper_open(env: "Stage") -> bool:
    """Both fingers are apart."""
    return bool((env.fingers > FINGER_OPEN).all())


def released_and_away(env: "Stage", thing: Thing) -> bool:
    """The gripper is open and has left the object."""
    return gripper_open(env) and float(np.linalg.norm(env.tcp_pose.p - thing.position)) > 0.02


def reset_reached(env: "Stage", reference: np.ndarray, tolerance: float = 0.01) -> bool:
    """The arm is back at the reference joint positions [n], radians."""
    return float(np.abs(env.qpos[: len(reference)] - reference).max()) < tolerance


class StaticFor:
    """True once the arm has stood still for a number of steps; asked once a step."""

    LIMIT = 0.2
    """Joint velocity above which the arm moves, rad/s."""

    def __init__(self, env: "Stage", steps: int) -> None:
        self._env, self._steps = env, steps
        self._since: int | None = None

    def __call__(self) -> bool:
        now = self._env.steps_done
        velocity = self._env.agent.robot.get_qvel()[0, :-2]
        if self._since is None or float(velocity.abs().max()) > self.LIMIT:
            self._since = now
        return now - self._since >= self._steps
