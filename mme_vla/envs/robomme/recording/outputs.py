"""The outputs of a recording: a LeRobot dataset, official files, or both."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from mme_vla.data.convert import ConvertOptions, convert, drop_work, planned_options
from mme_vla.data.hdf5 import EpisodeRef, list_episodes, open_episode
from mme_vla.data.lerobot_files import FACTS, SIDE_FILE
from mme_vla.embodiment.robomme import CAMERAS
from mme_vla.envs.facts import read_facts, write_facts
from mme_vla.envs.observations import INTRINSIC
from mme_vla.envs.robomme.recording.frames import FrameChoice
from mme_vla.errors import require
from mme_vla.utils import is_vacant, read_json, write_atomically

if TYPE_CHECKING:
    from mme_vla.envs.robomme.recording.recorder import RecordedStep
    from mme_vla.envs.task import Task


_BYTES = ("simple_subgoal", "grounded_subgoal", "simple_subgoal_online", "grounded_subgoal_online")


class EpisodeWriter:
    """Writes one episode, a step at a time, as `episode_<index>` of a file of its own.

    Args:
        path: of the new file.
        index: of the episode.
        task: what is demonstrated; its seed, difficulty, goals and options go into `setup`.
        frames: the choice of frames that are rendered, where not all are.
    """

    def __init__(
        self, path: Path, index: int, task: "Task", frames: FrameChoice | None = None
    ) -> None:
        self._file = h5py.File(path, "w")
        self._episode = self._file.create_group(f"episode_{index}")
        self._steps = 0
        choices = [choice.option.to_dict() for choice in task.choices()]
        setup = self._episode.create_group("setup")
        setup["seed"] = np.int64(task.seed)
        texts = {
            "difficulty": task.tier or task.difficulty,
            "available_multi_choices": json.dumps(choices),
        }
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
            group.create_dataset(
                path, data=value.encode(encoding), dtype=h5py.string_dtype(encoding)
            )
        elif isinstance(value, np.ndarray) and value.ndim == 3:
            # One chunk: the dozens that h5py would make of it double the time that storing a step
            # takes.
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


@dataclass(frozen=True)
class Job:
    """One episode to demonstrate."""

    task: str
    episode: int
    seed: int
    difficulty: str
    recovery: str | None
    retries: int
    frames: FrameChoice | None = None
    """The rendered frames; None: all."""
    row: Mapping[str, Any] | None = None
    """The scene's values, where it is not sampled from the seed."""

    @property
    def name(self) -> str:
        """Of the episode's files."""
        return f"{self.task}-{self.episode:04d}"

    @property
    def plan(self) -> dict[str, Any]:
        """What decides the result; without `frames` where all are rendered, as in older plans."""
        plan = asdict(self) | {"frames": self.frame_selection}
        for name in ("frames", "row"):
            if plan[name] is None:
                del plan[name]
        return plan

    @property
    def frame_selection(self) -> dict[str, Any] | None:
        """The choice of frames in plain values."""
        return None if self.frames is None else self.frames.to_dict()

    def made(self, seed: int | None, difficulty: str | None, frames: Any) -> bool:
        """Whether an episode of this seed, difficulty and rendered frames can be what this job
        records.
        """
        is_tried = seed is not None and self.seed <= seed < self.seed + self.retries
        return is_tried and difficulty == self.difficulty and frames == self.frame_selection


@dataclass(frozen=True)
class RecordingPlan:
    """The results of a recording.

    jobs: its episodes.
    dataset: folder of the LeRobot dataset, if one is wanted.
    hdf5: folder of the official files, one a task, if they are.
    """

    jobs: Sequence[Job]
    dataset: Path | None
    hdf5: Path | None

    @property
    def places(self) -> list[Path]:
        """The dataset and the official files."""
        places: list[Path] = []
        if self.dataset is not None:
            places.append(self.dataset)
        if self.hdf5 is not None:
            for task in dict.fromkeys(job.task for job in self.jobs):
                places.append(self._official(task))
        return places

    def missing(self, options: ConvertOptions) -> list[Path]:
        """The places that are still to be written; what is there holds exactly these episodes."""
        missing = []
        for place in self.places:
            if is_vacant(place):
                missing.append(place)
                continue
            if place == self.dataset:
                is_same = self._is_dataset(options)
            else:
                is_same = self._is_official(place)
            require(
                is_same,
                f"{place} exists already, and is not what this command records; choose another"
                " place, or remove it yourself.",
            )
        return missing

    def write(self, missing: Sequence[Path], episodes: Path, options: ConvertOptions) -> None:
        """Write these places from the recorded files in `episodes`; each appears whole or not at
        all.
        """
        for place in missing:
            if place != self.dataset:
                place.parent.mkdir(parents=True, exist_ok=True)
                join([episodes / f"{job.name}.h5" for job in self._of(place)], place)
        if self.dataset is not None and self.dataset in missing:
            refs = [
                EpisodeRef(episodes / f"{job.name}.h5", job.episode, job.task) for job in self.jobs
            ]
            convert(refs, self.dataset, options)

    def write_facts(self, episodes: Path) -> None:
        """Write the table of facts of each place that has none, from what is known in `episodes` of
        every episode.
        """
        if not all((episodes / f"{job.name}.json").is_file() for job in self.jobs):
            return
        facts = {}
        for job in self.jobs:
            file = episodes / f"{job.name}.json"
            known = read_json(file, "what is known of a recorded episode")
            facts[job.name] = read_facts(known.get("facts"), str(file))
        for place in self.places:
            if place == self.dataset:
                table = place / FACTS
                numbered = list(enumerate(self.jobs))
            else:
                table = place.with_suffix(".facts.csv")
                numbered = [(job.episode, job) for job in self._of(place)]
            if not table.exists():
                write_facts(table, [(i, job.task, facts[job.name]) for i, job in numbered])

    def tidy(self) -> None:
        """Remove what earlier runs left beside the dataset, which is there; the caller holds the
        recording's folder.
        """
        if self.dataset is not None:
            drop_work(self.dataset)

    def _official(self, task: str) -> Path:
        assert self.hdf5 is not None
        return self.hdf5 / f"record_dataset_{task}.h5"

    def _of(self, place: Path) -> list[Job]:
        return [job for job in self.jobs if self._official(job.task) == place]

    def _is_official(self, place: Path) -> bool:
        jobs = {job.episode: job for job in self._of(place)}
        refs = list_episodes([place])
        if {ref.index for ref in refs} != set(jobs):
            return False
        for ref in refs:
            with open_episode(ref) as episode:
                if not jobs[ref.index].made(episode.seed, episode.difficulty, episode.frames):
                    return False
        return True

    def _is_dataset(self, options: ConvertOptions) -> bool:
        assert self.dataset is not None
        if not (self.dataset / SIDE_FILE).is_file():
            return False
        side = read_json(self.dataset / SIDE_FILE, "the facts of a recorded dataset")
        entries = side.get("episodes", [])
        if side.get("plan", {}).get("options") != planned_options(options):
            return False
        if len(entries) != len(self.jobs):
            return False
        for job, entry in zip(self.jobs, entries, strict=True):
            if (entry.get("task"), entry.get("source_episode")) != (job.task, job.episode):
                return False
            if not job.made(entry.get("seed"), entry.get("difficulty"), entry.get("frames")):
                return False
        return True
