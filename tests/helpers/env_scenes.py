"""Helpers of the tests of the simulation: a scene with any objects, and the recorded episodes as
arrays.
"""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from sapien.physx import PhysxArticulationLinkComponent, PhysxCollisionShapeBox

from mme_vla.envs.robomme.scene.articulated import build_button, build_peg
from mme_vla.envs.robomme.scene.objects import (
    build_aperture_box,
    build_board,
    build_container,
    build_cube,
    build_disc,
    build_hidden_cube,
    build_highlight,
    build_moving_cube,
    build_obstacle,
    build_sphere,
)
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.subtasks import SubTask
from mme_vla.envs.task import Task


class Scene(Task):
    """A task without a goal: whatever `fill` puts on the table, in physics alone unless told
    otherwise.
    """

    def __init__(
        self, fill: Callable[["Scene"], None], stick: bool = False, **settings: object
    ) -> None:
        self._fill = fill
        self.stick = stick  # type: ignore[misc]
        super().__init__(**{"obs_mode": "none", "render_backend": "none", **settings})

    def build(self, draws: Draws) -> None:
        self._fill(self)

    def subtasks(self) -> list[SubTask]:
        return [SubTask("stay", done=lambda: False, run=lambda _: None)]

    def goals(self) -> list[str]:
        return ["stay"]


def recorded(folder: Path, task: str, episode: int, key: str) -> np.ndarray:
    """One quantity of an official episode over all its frames, e.g. `obs/joint_state`."""
    with h5py.File(folder / f"record_dataset_{task}.h5") as file:
        frames = file[f"episode_{episode}"]
        count = sum(name.startswith("timestep_") for name in frames)
        return np.array([frames[f"timestep_{k}"][key][()] for k in range(count)])


def setup(folder: Path, task: str, episode: int, key: str) -> object:
    """One entry of an official episode's setup, e.g. `task_goal`."""
    with h5py.File(folder / f"record_dataset_{task}.h5") as file:
        return file[f"episode_{episode}/setup/{key}"][()]


def arm_presses_on_box(env: Task) -> bool:
    """Return whether a box of the arm, such as a finger, exerts force on a box of another body."""
    return any(
        any(isinstance(body, PhysxArticulationLinkComponent) for body in contact.bodies)
        and all(isinstance(shape, PhysxCollisionShapeBox) for shape in contact.shapes)
        and any(point.impulse.any() for point in contact.points)
        for contact in env.scene.get_contacts()
    )


def replay(env: Task, folder: Path, episode: int) -> np.ndarray:
    """Replay an official episode and compare it with its recording.

    PhysX computes contacts between two boxes with the instruction `rcpps`, whose result differs
    between makers of CPUs. Until the first such contact of the arm, joints must equal the recorded
    ones to the last bit. In the whole episode the order of sub-tasks and the success must be the
    recorded ones.

    Returns:
        The largest difference of a joint position at each step [steps]: radians, for the fingers
        metres.
    """
    keys = (
        "action/joint_action",
        "obs/joint_state",
        "obs/gripper_state",
        "info/simple_subgoal_online",
    )
    actions, arm, fingers, texts = (
        recorded(folder, type(env).__name__, episode, key) for key in keys
    )
    joints, subtasks, contacts, success = [], [], [], False

    def note_contact() -> None:
        if arm_presses_on_box(env):
            contacts.append(len(joints))

    env._after_simulation_step = note_contact
    for action in actions.astype(np.float32):
        *_, info = env.step(action)
        joints.append(env.qpos)
        subtasks.append(env.progress.displayed.text)
        success = bool(info["success"])
    del env._after_simulation_step
    error = np.abs(np.array(joints) - np.hstack([arm, fingers])).max(1)
    assert contacts and error[: contacts[0]].max() == 0
    assert list(dict.fromkeys(subtasks)) == list(dict.fromkeys(text.decode() for text in texts))
    assert success == recorded(folder, type(env).__name__, episode, "info/is_completed")[-1]
    return error


def one_of_everything(env: Scene) -> None:
    env.add(build_cube(env, "cube", "red", (0.1, 0.1), 0.3))
    env.add(build_hidden_cube(env, "hidden_cube", "green", (0.1, -0.1)))
    env.add(build_moving_cube(env, "moving_cube", (0.2, 0.3, 0.4), (0.0, 0.0), 0.01))
    env.add(build_container(env, "container", (0.1, -0.1), 0.5))
    env.add(build_disc(env, "target", 0.04, 0.005, "purple", (0.0, -0.2)))
    env.add(build_highlight(env, "highlight", 0.05, 0.001))
    env.add(build_highlight(env, "rings", 0.04, 0.014, (1.0, 0.0, 0.0), rings=True))
    env.add(build_sphere(env, "dot", 0.005))
    env.add(build_button(env, (-0.2, 0.1)))
    env.add(build_board(env, (0.2, 0.2), 0.2))
    env.add(build_aperture_box(env, (-0.1, -0.3), 1.2))
    env.add(build_obstacle(env, "obstacle", (0.1, 0.35), 0.3, (0.0, 0.0, 1.0)))
    env.add(build_peg(env, "peg", 0.1, 0.01, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-0.1, 0.25), 0.4))
