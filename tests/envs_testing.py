"""Helpers of the tests of the simulation: a scene with any objects, and the recorded episodes as arrays."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from mme_vla.envs.scene.draws import Draws
from mme_vla.envs.subtasks import SubTask
from mme_vla.envs.task import Task


class Scene(Task):
    """A task without a goal: whatever `fill` puts on the table, in physics alone unless told otherwise."""

    def __init__(self, fill: Callable[["Scene"], None], stick: bool = False, **settings: object) -> None:
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
