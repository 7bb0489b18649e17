"""Training data of the subgoal predictors, from demonstrations.

`mme-vla subgoal-build input=<HDF5 files, folders of them, or LeRobot datasets> output=<new folder>`

Writes one JSON-lines file for each set (`simple.jsonl`, `grounded.jsonl`, `memer.jsonl`) in the
layout of ms-swift, with the images and videos beside it; paths in the rows are relative to the
output folder. An interrupted run continues with the episodes that are missing, and the same input
always gives the same files.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

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
    remove_drafts,
    to_json,
    write_atomically,
    write_sums,
)  # fmt: skip
from mme_vla.utils.media import png_bytes, write_video

PARTS = "parts"


@dataclass(frozen=True)
class Demonstration:
    """One episode to build from: its labels, and its front images at some frames, both read when
    asked for.
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
    refs = list_episodes(find_files([root]))
    sums = {file: file_sum(file) for file in dict.fromkeys(ref.file for ref in refs)}
    return [
        Demonstration(ref.task, ref.index, f"{ref.file.name}:{sums[ref.file]}", *_h5_readers(ref))
        for ref in refs
    ]


def build(
    episodes: Sequence[Demonstration],
    output: Path,
    sets: Sequence[str],
    options: RowOptions | None = None,
) -> dict[str, int]:
    """Build these sets; return the number of rows of each."""
    options = options or RowOptions()
    require(
        episodes and sets,
        "There is nothing to build: name at least one episode and one of the sets.",
    )
    names = [episode.name for episode in episodes]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UserError(
            f"Two episodes are called {twice[0]}: give inputs that do not overlap, or build them"
            " apart."
        )
    origins = {episode.name: episode.origin for episode in episodes}
    plan = to_json({"sets": list(sets), "options": asdict(options), "episodes": origins})
    with FolderLock(output, "build of subgoal data"):
        return _build(episodes, output, sets, options, plan)


def _build(
    episodes: Sequence[Demonstration],
    output: Path,
    sets: Sequence[str],
    options: RowOptions,
    plan: dict[str, Any],
) -> dict[str, int]:
    require(
        claim_plan(output, plan),
        f"{output} holds something else, or the result of other inputs, sets or options. Choose"
        " another output, repeat that command to finish it, or remove the folder yourself.",
    )
    for folder in (output, *(path for path in output.rglob("*") if path.is_dir())):
        remove_drafts(folder)
    missing = [e for e in episodes if not all(_part(output, name, e).is_file() for name in sets)]
    if not all((output / f"{name}.jsonl").is_file() for name in sets):
        with progress(
            "subgoal data", len(episodes), len(episodes) - len(missing), "episodes"
        ) as advance:
            for episode in missing:
                _build_episode(episode, output, sets, options)
                advance(1)
        for name in sets:
            with write_atomically(output / f"{name}.jsonl") as draft:
                draft.write_text(
                    "".join(_part(output, name, episode).read_text() for episode in episodes)
                )
    shutil.rmtree(output / PARTS, ignore_errors=True)
    if not (
        output / SUMS
    ).is_file():  # the last thing written: what they do not list is not compared
        kinds = {".jsonl", ".png", ".mp4"}
        write_sums(
            output,
            [str(p.relative_to(output)) for p in sorted(output.rglob("*.*")) if p.suffix in kinds],
        )
    return {name: (output / f"{name}.jsonl").read_text().count("\n") for name in sets}


def _build_episode(
    episode: Demonstration, output: Path, sets: Sequence[str], options: RowOptions
) -> None:
    labels = episode.labels()
    paths_at: dict[int, list[Path]] = {}
    for name in sets:
        built = episode_rows(name, labels, options)
        for image, frame in built.images.items():
            paths_at.setdefault(frame, []).append(output / image)
        if built.video:
            path = output / built.video
            if not path.is_file():
                write_video(episode.read_images(range(labels.exec_start)), path, **ENCODING)
    missing = {
        t: [path for path in paths if not path.is_file()] for t, paths in sorted(paths_at.items())
    }
    steps = [t for t, paths in missing.items() if paths]
    for t, pixels in zip(steps, episode.read_images(steps), strict=True):
        for path in missing[t]:
            with write_atomically(path) as draft:
                draft.write_bytes(png_bytes(pixels))
    for name in sets:  # the rows last: where they are, their images are
        rows = episode_rows(name, labels, options).rows
        with write_atomically(_part(output, name, episode)) as draft:
            draft.write_text("".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows))


def _part(output: Path, name: str, episode: Demonstration) -> Path:
    return output / PARTS / name / f"{episode.name}.jsonl"


def _h5_readers(
    ref: EpisodeRef,
) -> tuple[Callable[[], Labels], Callable[[Sequence[int]], Iterator[np.ndarray]]]:
    def labels() -> Labels:
        with open_episode(ref) as episode:
            texts = _two_kinds(list(episode.subgoals()))
            return Labels(
                ref.task, ref.index, episode.goals[0], episode.exec_start, *texts, *episode.joints()
            )

    def read_images(steps: Sequence[int]) -> Iterator[np.ndarray]:
        with open_episode(ref) as episode:
            for t in steps:
                yield episode.front(t)

    return labels, read_images


def _from_lerobot(source: EpisodeSource, tasks: Path | None) -> list[Demonstration]:
    needed = ("simple_subgoal", "grounded_subgoal")
    if lacking := [name for name in needed if name not in source.subgoal_names]:
        raise UserError(
            f"{source.root} has no column {' and no '.join(lacking)}: nothing to learn subgoals"
            " from."
        )
    task_names = {} if tasks is None else _read_tasks(tasks)
    demonstrations = []
    for e in range(len(source)):
        task = task_names.get(str(e)) or source.task(e)
        require(
            task,
            f"{source.root} does not tell the task of episode {e}, which some rules depend on. Give"
            ' a JSON file tasks=<file> with {"<episode index>": "<Task>", …}.',
        )
        record = source.records[e] if e < len(source.records) else {}
        number = record.get("source_episode", e)
        if type(number) is not int or not 0 <= number < 2**31:
            raise UserError(
                f"{source.root} gives {brief(number)} as the number of episode {e}; expected a"
                " whole one."
            )
        reader = partial(_lerobot_labels, source, e, task, number)
        read_images = partial(_lerobot_images, source, e)
        demonstrations.append(
            Demonstration(task, number, f"{source.fingerprint}:{e}", reader, read_images)
        )
    return demonstrations


def _read_tasks(path: Path) -> dict[str, str]:
    tasks: dict[str, str] = read_json(
        path, 'tasks=<file> of {"<episode index>": "<Task>", …}', kind=(dict, list)
    )
    if not isinstance(tasks, dict) or not all(isinstance(task, str) for task in tasks.values()):
        raise UserError(f'tasks={path} must hold {{"<episode index>": "<Task>", …}}.')
    return tasks


def _lerobot_labels(source: EpisodeSource, episode: int, task: str, number: int) -> Labels:
    texts = [source.subgoals(episode, t) for t in range(int(source.lengths[episode]))]
    joints, targets = (
        source.states(episode)[:, :ARM_JOINTS],
        source.actions(episode)[:, :ARM_JOINTS],
    )
    start = int(source.exec_starts[episode])
    return Labels(task, number, source.goal(episode), start, *_two_kinds(texts), joints, targets)


def _lerobot_images(
    source: EpisodeSource, episode: int, steps: Sequence[int]
) -> Iterator[np.ndarray]:
    for start in range(0, len(steps), 64):  # what is decoded at once stays small
        yield from source.frames(episode, list(steps[start : start + 64]))


def _two_kinds(texts: Sequence[Mapping[str, str]]) -> tuple[list[str], list[str]]:
    return [text["simple_subgoal"] for text in texts], [text["grounded_subgoal"] for text in texts]
