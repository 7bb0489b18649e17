"""Writing demonstrations in the layout of the official files, `record_dataset_<Task>.h5`."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from mme_vla.embodiment.robomme import CAMERAS
from mme_vla.envs.observations import INTRINSIC
from mme_vla.files import remove_drafts, write_atomically

if TYPE_CHECKING:
    from mme_vla.envs.recording.frames import FrameChoice
    from mme_vla.envs.recording.recorder import RecordedStep
    from mme_vla.envs.task import Task

_BYTES = ("simple_subgoal", "grounded_subgoal", "simple_subgoal_online", "grounded_subgoal_online")


class EpisodeWriter:
    """Writes one episode, a step at a time, as `episode_<index>` of a file of its own.

    Args:
        path: of the new file.
        index: of the episode.
        task: what is demonstrated; its seed, difficulty, goals and options go into `setup`.
        frames: the choice of frames that are drawn, where not all are.
    """

    def __init__(self, path: Path, index: int, task: "Task", frames: "FrameChoice | None" = None) -> None:
        self._file = h5py.File(path, "w")
        self._episode = self._file.create_group(f"episode_{index}")
        self._steps = 0
        choices = [{"label": c.label, "action": c.action, "need_parameter": c.needs_point} for c in task.choices()]
        setup = self._episode.create_group("setup")
        setup["seed"] = np.int64(task.seed)
        texts = {"difficulty": task.difficulty, "available_multi_choices": json.dumps(choices)}
        if frames is not None:
            texts["frames"] = json.dumps(frames.to_dict())
        for name, text in texts.items():
            setup.create_dataset(name, data=text, dtype=h5py.string_dtype())
        setup.create_dataset("task_goal", data=task.goals(), dtype=h5py.string_dtype())
        for camera in CAMERAS:
            setup[f"{camera}_camera_intrinsic"] = INTRINSIC

    def add(self, step: "RecordedStep") -> None:
        """Write the next step."""
        group = self._episode.create_group(f"timestep_{self._steps}")
        for part in ("obs", "action", "info"):
            for name, value in getattr(step, part).items():
                self._write(group, f"{part}/{name}", name, value)
        self._steps += 1

    def _write(self, group: Any, path: str, name: str, value: Any) -> None:
        if isinstance(value, str):
            # As in the official files; every text of the benchmark is ASCII.
            encoding = "ascii" if name in _BYTES else "utf-8"
            group.create_dataset(path, data=value.encode(encoding), dtype=h5py.string_dtype(encoding))
        elif isinstance(value, np.ndarray) and value.ndim == 3:
            # One chunk: the dozens that h5py would make of it double the time that storing a step takes.
            group.create_dataset(path, data=value, compression="lzf", chunks=value.shape)
        else:
            group[path] = value

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


def join(parts: Sequence[Path], path: Path) -> None:
    """Copy the episodes of several files into one, uncompressed as the official files are.

    The file appears under its name only when it is whole.
    """
    remove_drafts(path.parent)
    with write_atomically(path) as draft, h5py.File(draft, "w") as target:
        for part in parts:
            with h5py.File(part) as source:
                for episode in source.values():
                    _copy(episode, target.create_group(Path(episode.name).name))


def _copy(source: Any, target: Any) -> None:
    for name, item in source.items():
        if isinstance(item, h5py.Group):
            _copy(item, target.create_group(name))
        else:
            target.create_dataset(name, data=item[()], dtype=item.dtype)
