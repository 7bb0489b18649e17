"""The official demonstration files, `record_dataset_<Task>.h5`: which episodes they hold, and opening one."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mme_vla.data.hdf5_episode import CHOICES, FRAMES, POSE_ACTIONS, POSE_STATE, REMEDY, EpisodeRef, RawEpisode
from mme_vla.errors import UserError
from mme_vla.utils import decoding, require_file


def find_files(inputs: Sequence[str | Path]) -> list[Path]:
    """Expand files and folders into HDF5 files, sorted by name."""
    files: set[Path] = set()
    for entry in map(Path, inputs):
        matches = sorted(entry.glob("*.h5")) if entry.is_dir() else [entry]
        if not matches or not all(path.is_file() for path in matches):
            advice = "give record_dataset_<Task>.h5 files or their folder."
            if (entry / "meta" / "info.json").is_file():
                advice = (
                    "it is a LeRobot dataset already, named by data.sources as it is. What conversion keeps besides, "
                    "such as keyframes, needs the HDF5 files: `mme-vla record` writes them with hdf5=…"
                )
            raise UserError(f"No HDF5 file at {str(entry)!r}: {advice}")
        files.update(matches)
    return sorted(files, key=lambda path: (path.name, str(path)))


def list_episodes(files: Sequence[Path]) -> list[EpisodeRef]:
    """All episodes of these files: file by file, each in numerical order."""
    refs = []
    for file in files:
        task = re.sub(r"^record_dataset_", "", file.stem)
        with _open(file) as handle, decoding(file, "HDF5", REMEDY):
            numbers = sorted(int(name[8:]) for name in handle if re.fullmatch(r"episode_\d{1,9}", name))
        if not numbers:
            raise UserError(f"{file} has no episode_<number> group: it is not a RoboMME demonstration file.")
        refs += [EpisodeRef(file, number, task) for number in numbers]
    return refs


def pose_columns(refs: Sequence[EpisodeRef]) -> tuple[str, ...]:
    """The columns of `POSE_ACTIONS` that every one of these episodes has."""
    files = {file: [ref.group for ref in refs if ref.file == file] for file in dict.fromkeys(ref.file for ref in refs)}
    columns = set(POSE_ACTIONS)
    for file, groups in files.items():
        with _open(file) as handle:
            columns = {n for n in columns if all(f"{group}/timestep_0/{POSE_ACTIONS[n]}" in handle for group in groups)}
    return tuple(name for name in POSE_ACTIONS if name in columns)


def all_have_poses(refs: Sequence[EpisodeRef]) -> bool:
    """Whether the tool's poses were recorded with every one of these episodes."""
    for file in dict.fromkeys(ref.file for ref in refs):
        with _open(file) as handle:
            if not all(f"{ref.group}/timestep_0/obs/{POSE_STATE}" in handle for ref in refs if ref.file == file):
                return False
    return True


def all_have_choices(refs: Sequence[EpisodeRef]) -> bool:
    """Whether options and choices were recorded with every one of these episodes."""
    for file in dict.fromkeys(ref.file for ref in refs):
        with _open(file) as handle:
            groups = [ref.group for ref in refs if ref.file == file]
            if not all(f"{group}/{name}" in handle for group in groups for name in CHOICES):
                return False
    return True


def any_selected_frames(refs: Sequence[EpisodeRef]) -> bool:
    """Whether one of these episodes was drawn at a choice of its frames only."""
    for file in dict.fromkeys(ref.file for ref in refs):
        with _open(file) as handle:
            if any(f"{ref.group}/{FRAMES}" in handle for ref in refs if ref.file == file):
                return True
    return False


@contextmanager
def open_episode(ref: EpisodeRef) -> Iterator[RawEpisode]:
    """Open one episode for reading."""
    with _open(ref.file) as handle:
        with decoding(ref.file, "HDF5", REMEDY):
            group = handle.get(ref.group)
        if group is None:
            raise UserError(f"{ref.file} has no {ref.group}.")
        yield RawEpisode(ref, group)


@contextmanager
def _open(file: Path) -> Iterator[Any]:
    import h5py

    with decoding(require_file(file, "HDF5"), "HDF5", REMEDY):
        handle = h5py.File(file, "r")
    with handle:
        yield handle
