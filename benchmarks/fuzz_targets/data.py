"""Recordings, datasets and vision caches, as small as they can be."""

import importlib
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from benchmarks.fuzz_targets.base import Target, digest, every_file
from mme_vla.data.cache import VisionCache, fingerprint
from mme_vla.data.cache_building import build_cache
from mme_vla.data.convert import convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import SUBGOALS, find_files, list_episodes, open_episode
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.memory.tokendrop import TokenDrop
from mme_vla.utils import write_sums

for _name in ("av", "datasets", "lerobot.datasets.feature_utils", "PIL.Image", "pyarrow.parquet"):
    importlib.import_module(_name)  # here, or every process that reads a damaged copy takes seconds to do so

LENGTHS, VIDEO, SIDE = (12, 9), 4, 32  # steps of the episodes, of which so many are video; pixels
H5 = "record_dataset_PickXtimes.h5"


def write_recording(folder: Path) -> None:
    """A file in the layout of RoboMME's recorder, with compressed images as there."""
    rng = np.random.default_rng(0)
    with h5py.File(folder / H5, "w") as file:
        for number, length in enumerate(LENGTHS):
            episode = file.create_group(f"episode_{number}")
            episode["setup/task_goal"] = np.array([f"Do task {number}"], dtype=h5py.string_dtype())
            episode["setup/seed"], episode["setup/difficulty"] = 100 * number, "easy"
            for t in range(length):
                step = episode.create_group(f"timestep_{t}")
                for view in ("front", "wrist"):
                    image = np.repeat(rng.integers(0, 255, (SIDE, SIDE, 1), np.uint8), 3, axis=2)
                    step.create_dataset(f"obs/{view}_rgb", data=image, compression="lzf")
                step["obs/joint_state"] = rng.normal(size=7).astype(np.float32)
                step["obs/gripper_state"] = np.array([0.04, 0.04], np.float32)
                step["action/joint_action"] = rng.normal(size=8)
                for name in SUBGOALS:
                    step[f"info/{name}"] = f"pick up the cube {t // 3}"
                step["info/is_video_demo"], step["info/is_completed"] = t < VIDEO, False


def read_recording(folder: Path) -> object:
    """Every frame of every episode."""
    read: list[object] = []
    for ref in list_episodes(find_files([folder / H5])):
        with open_episode(ref) as episode:
            read += [ref.index, ref.task, episode.goals, episode.seed, episode.difficulty, episode.exec_start]
            for frame in episode:
                read += [
                    frame.front,
                    frame.wrist,
                    frame.state,
                    frame.action,
                    frame.is_demo,
                    sorted(frame.subgoals.items()),
                ]
    return digest(*read)


def write_dataset(folder: Path) -> None:
    """The same as a LeRobot dataset with videos, without checksums."""
    work = folder / "recording"
    work.mkdir()
    write_recording(work)
    convert(list_episodes(find_files([work])), folder / "dataset")
    shutil.rmtree(work)
    (folder / "dataset" / "SHA256SUMS").unlink(missing_ok=True)


def write_summed_dataset(folder: Path) -> None:
    """The same with checksums."""
    write_dataset(folder)
    write_sums(folder / "dataset")


def read_dataset(folder: Path) -> object:
    """Every column and image, and the checksums as `inspect` compares them."""
    source = EpisodeSource(folder / "dataset", name="fuzzed")
    source.verify()
    read: list[object] = [source.fps, source.lengths, source.exec_starts, source.subgoal_names]
    for e in range(len(source)):
        steps = range(int(source.lengths[e]))
        read += [source.goal(e), source.task(e), source.states(e), source.actions(e)]
        read += [sorted(source.subgoals(e, t).items()) for t in steps]
        read += [source.frames(e, list(steps), view) for view in source.columns]
    return digest(*read)


class _SyntheticSource:
    """As much of an `EpisodeSource` as a cache asks for."""

    name, fingerprint = "fuzzed", "0123456789abcdef"
    lengths, exec_starts = np.array(LENGTHS), np.array([VIDEO, VIDEO])
    robot, columns = ROBOMME_JOINT, {"front": "image", "wrist": "wrist_image"}

    def __len__(self) -> int:
        return len(LENGTHS)

    def rendered(self, episode: int, camera: str | None = None) -> np.ndarray:
        return np.ones(LENGTHS[episode], bool)

    def frames(self, episode: int, indices: Any, camera: str | None = None) -> np.ndarray:
        values = np.random.default_rng(episode).integers(0, 255, (LENGTHS[episode], SIDE, SIDE, 3), np.uint8)
        return values[np.asarray(indices)]


def _memory() -> TokenDrop:
    return TokenDrop(d_vision=8, width=8, budget=8, grid=2, stride=2)


def _encode(frames: np.ndarray) -> Tensor:
    return torch.from_numpy(frames.reshape(len(frames), -1)[:, :32].astype(np.float32)).view(-1, 4, 8)


def _expected() -> dict[str, Any]:
    source: Any = _SyntheticSource()
    return fingerprint(source, _memory().storage, "encoder")


def write_cache(folder: Path) -> None:
    """The vision cache of two episodes, with scores."""
    source: Any = _SyntheticSource()
    build_cache(source, _memory(), _encode, folder / "cache", _expected(), shard=(0, 1))


def read_cache(folder: Path) -> object:
    """Every token and score."""
    source: Any = _SyntheticSource()
    cache = VisionCache(folder / "cache", source, _expected())
    read: list[object] = [cache.width]
    for episode in range(len(source)):
        history = cache.history(episode)
        stored = cache.spec.stored_frames(len(history))
        every = np.stack([np.repeat(stored, 4), np.tile(np.arange(4), len(stored))], axis=1)
        read += [history.gather(every).view(torch.int16).numpy(), history.scores.frames, history.scores.values]
    return digest(*read)


def _always(valid: object, result: object) -> bool:
    return True


TARGETS = [
    Target("cache", write_cache, every_file, read_cache),
    Target("dataset", write_summed_dataset, every_file, read_dataset),
    Target("dataset-without-sums", write_dataset, every_file, read_dataset, _always),
    Target("hdf5", write_recording, every_file, read_recording, _always),
]
