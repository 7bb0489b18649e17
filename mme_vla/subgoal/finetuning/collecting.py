"""Training data of the subgoal predictors, from demonstrations.

`mme-vla subgoal-build input=<HDF5 files, folders of them, or LeRobot datasets> output=<new folder>`

Writes one JSON-lines file for each set (`simple.jsonl`, `grounded.jsonl`, `memer.jsonl`) in the
layout of ms-swift, with the images and videos beside it; paths in the rows are relative to the
output folder. An interrupted run continues with the episodes that are missing, and the same input
always gives the same files.
"""

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mme_vla.data.console import progress
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import EpisodeRef, find_files, list_episodes, open_episode
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.embodiment.robomme import ARM_JOINTS
from mme_vla.errors import UserError, brief, require
from mme_vla.subgoal.clips import ENCODING
from mme_vla.subgoal.finetuning.labels import Labels
from mme_vla.subgoal.finetuning.rows import RowOptions, episode_rows
from mme_vla.utils import (
    SUMS,
    FolderLock,
    claim_plan,
    file_sum,
    read_json,
    to_json,
    write_atomically,
    write_sums,
    write_text,
)  # fmt: skip
from mme_vla.utils.media import png_bytes, write_video

PARTS = "parts"


@dataclass(frozen=True)
class Demonstration:
    """One episode to build from. Labels and images are read when they are needed.

    task, number: its name and number.
    origin: its source and a digest of it; another origin makes other rows.
    labels: reads its labels.
    read_images: reads the front images [H, W, 3] of some frames, in order.
    """

    task: str
    number: int
    origin: str
    labels: Callable[[], Labels]
    read_images: Callable[[Sequence[int]], Iterator[np.ndarray]]

    @property
    def name(self) -> str:
        """Unique among the episodes of one build; file names begin with it."""
        return f"{self.task}_ep{self.number}"


def open_input(entry: str | Path, tasks: Path | None = None) -> list[Demonstration]:
    """List the episodes of an HDF5 file, a folder of them, or a LeRobot dataset (`sample`: the
    embedded one).

    Args:
        tasks: JSON file {"<episode index>": "<Task>"} for a LeRobot dataset that does not tell its
            tasks.
    """
    root = SAMPLE if str(entry) == "sample" else Path(entry)
    if (root / "meta" / "info.json").is_file():
        return _from_lerobot(EpisodeSource(root), tasks)
    sums: dict[Path, str] = {}
    demonstrations = []
    for ref in list_episodes(find_files([root])):
        if ref.file not in sums:
            sums[ref.file] = file_sum(ref.file)
        origin = f"{ref.file.name}:{sums[ref.file]}"
        labels = partial(_h5_labels, ref)
        read_images = partial(_h5_images, ref)
        demonstrations.append(Demonstration(ref.task, ref.index, origin, labels, read_images))
    return demonstrations


def build(
    episodes: Sequence[Demonstration],
    output: Path,
    sets: Sequence[str],
    options: RowOptions,
) -> dict[str, int]:
    """Build these sets; return the number of rows of each."""
    require(
        episodes and sets,
        "There is nothing to build: name at least one episode and one of the sets.",
    )
    origins: dict[str, str] = {}
    for episode in episodes:
        if episode.name in origins:
            raise UserError(
                f"Two episodes are called {episode.name}: give inputs that do not overlap, or build"
                " them apart."
            )
        origins[episode.name] = episode.origin
    plan = to_json({"sets": list(sets), "options": asdict(options), "episodes": origins})
    with FolderLock(output, "build of subgoal data"):
        require(
            claim_plan(output, plan),
            f"{output} holds something else, or the result of other inputs, sets or options. Choose"
            " another output, repeat that command to finish it, or remove the folder yourself.",
        )
        rows_files = {name: output / f"{name}.jsonl" for name in sets}
        if not all(path.is_file() for path in rows_files.values()):
            missing = []
            for episode in episodes:
                if not all(_part(output, name, episode).is_file() for name in sets):
                    missing.append(episode)
            n_built = len(episodes) - len(missing)
            with progress("subgoal data", len(episodes), n_built, "episodes") as advance:
                for episode in missing:
                    _build_episode(episode, output, sets, options)
                    advance(1)
            for name, path in rows_files.items():
                with write_atomically(path) as draft, draft.open("w", encoding="utf-8") as file:
                    for episode in episodes:
                        file.write(_part(output, name, episode).read_text(encoding="utf-8"))
        shutil.rmtree(output / PARTS, ignore_errors=True)

        # The checksums are written last: a file that they do not list is not compared.
        if not (output / SUMS).is_file():
            files = []
            for path in output.rglob("*.*"):
                if path.suffix in (".jsonl", ".png", ".mp4"):
                    files.append(str(path.relative_to(output)))
            write_sums(output, files)
        return {
            name: path.read_text(encoding="utf-8").count("\n") for name, path in rows_files.items()
        }


def _build_episode(
    episode: Demonstration, output: Path, sets: Sequence[str], options: RowOptions
) -> None:
    labels = episode.labels()
    sets_rows = {name: episode_rows(name, labels, options) for name in sets}

    # Videos, and the paths of missing images by frame: several sets may show the same frame.
    missing: dict[int, list[Path]] = {}
    for built in sets_rows.values():
        if built.video:
            path = output / built.video
            if not path.is_file():
                write_video(episode.read_images(range(labels.exec_start)), path, **ENCODING)
        for image, frame in built.images.items():
            path = output / image
            if not path.is_file():
                missing.setdefault(frame, []).append(path)

    # Each frame is decoded once, in order.
    frames = sorted(missing)
    for frame, pixels in zip(frames, episode.read_images(frames), strict=True):
        for path in missing[frame]:
            with write_atomically(path) as draft:
                draft.write_bytes(png_bytes(pixels))

    # The rows come last: where they exist, their images do.
    for name, built in sets_rows.items():
        lines = [json.dumps(row, ensure_ascii=False) + "\n" for row in built.rows]
        write_text(_part(output, name, episode), "".join(lines))


def _part(output: Path, name: str, episode: Demonstration) -> Path:
    return output / PARTS / name / f"{episode.name}.jsonl"


def _h5_labels(ref: EpisodeRef) -> Labels:
    with open_episode(ref) as episode:
        joints, targets = episode.joints()
        return Labels(
            task=ref.task,
            number=ref.index,
            goal=episode.goals[0],
            exec_start=episode.exec_start,
            joints=joints,
            targets=targets,
            **_texts(episode.subgoals()),
        )


def _h5_images(ref: EpisodeRef, steps: Sequence[int]) -> Iterator[np.ndarray]:
    with open_episode(ref) as episode:
        for t in steps:
            yield episode.front(t)


def _from_lerobot(source: EpisodeSource, tasks: Path | None) -> list[Demonstration]:
    columns = ("simple_subgoal", "grounded_subgoal")
    missing = [name for name in columns if name not in source.subgoal_names]
    if missing:
        raise UserError(
            f"{source.root} has no column {' and no '.join(missing)}: nothing to learn subgoals"
            " from."
        )
    task_names: dict[str, str] = {}
    if tasks is not None:
        form = '{"<episode index>": "<Task>", …}'
        task_names = read_json(tasks, f"tasks=<file> of {form}", kind=(dict, list))
        is_mapping = isinstance(task_names, dict)
        if not is_mapping or not all(isinstance(name, str) for name in task_names.values()):
            raise UserError(f"tasks={tasks} must hold {form}.")
    demonstrations = []
    for e in range(len(source)):
        task = task_names.get(str(e)) or source.task(e)
        require(
            task,
            f"{source.root} does not name the task of episode {e}, which some rules depend on. Give"
            ' a JSON file tasks=<file> with {"<episode index>": "<Task>", …}.',
        )
        # The number that the episode had where it was recorded, if the dataset has it.
        number = e
        if e < len(source.records):
            number = source.records[e].get("source_episode", e)
        if type(number) is not int or not 0 <= number < 2**31:
            raise UserError(
                f"{source.root} gives {brief(number)} as the number of episode {e}; expected a"
                " whole one."
            )
        origin = f"{source.fingerprint}:{e}"
        labels = partial(_lerobot_labels, source, e, task, number)
        read_images = partial(_lerobot_images, source, e)
        demonstrations.append(Demonstration(task, number, origin, labels, read_images))
    return demonstrations


def _lerobot_labels(source: EpisodeSource, episode: int, task: str, number: int) -> Labels:
    subgoals = (source.subgoals(episode, t) for t in range(int(source.lengths[episode])))
    return Labels(
        task=task,
        number=number,
        goal=source.goal(episode),
        exec_start=int(source.exec_starts[episode]),
        joints=source.states(episode)[:, :ARM_JOINTS],
        targets=source.actions(episode)[:, :ARM_JOINTS],
        **_texts(subgoals),
    )


def _texts(subgoals: Iterable[Mapping[str, str]]) -> dict[str, list[str]]:
    """The subgoals of each kind, frame by frame."""
    texts: dict[str, list[str]] = {"simple": [], "grounded": []}
    for subgoal in subgoals:
        for kind, column in texts.items():
            column.append(subgoal[f"{kind}_subgoal"])
    return texts


def _lerobot_images(
    source: EpisodeSource, episode: int, steps: Sequence[int]
) -> Iterator[np.ndarray]:
    for start in range(0, len(steps), 64):  # few frames are in memory at once
        yield from source.frames(episode, list(steps[start : start + 64]))
