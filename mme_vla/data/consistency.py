"""What a dataset says twice, compared: one pass over a few numbers a row, whenever a dataset is
opened.

LeRobot's format writes most facts more than once: the task of a frame, its place in time, where its
picture is. Where two of them contradict each other, one is wrong, and what would be trained on is
not what was recorded. An error names both. What does no harm here, and what LeRobot reads as well,
is a warning.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.episode_table import Description
from mme_vla.data.hdf5 import is_goal
from mme_vla.data.image_consistency import (
    CORRECT,
    HALF,
    check_colour,
    check_images,
    check_videos,
    first_wrong,
)
from mme_vla.data.lerobot_files import (
    REMEDY,
    RENDERED_SUFFIX,
    SIDE_FILE,
    TASKS,
    read_records,
    read_tasks,
)
from mme_vla.errors import UserError, brief, counted, require
from mme_vla.utils import read_json

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameTasks:
    """The task of every frame, as runs of rows that have the same one.

    first: [r] int64, the first row of each run, ascending from 0.
    texts: [r], lower-case.
    """

    first: np.ndarray
    texts: tuple[str, ...]

    def at(self, row: int) -> str:
        """The task of a row of the tables."""
        return self.texts[int(np.searchsorted(self.first, row, side="right")) - 1]

    def within(self, start: int, stop: int) -> tuple[str, ...]:
        """The different tasks of rows start … stop − 1, in the order in which they begin."""
        begin = int(np.searchsorted(self.first, start, side="right")) - 1
        end = int(np.searchsorted(self.first, stop, side="left"))
        return tuple(dict.fromkeys(self.texts[begin:end]))


def check_consistency(
    dataset: Description, rows: Mapping[str, np.ndarray], table: Any
) -> tuple[FrameTasks, np.ndarray | None]:
    """Compare everything that a dataset says twice.

    Args:
        rows: of `read_index_columns`.
        table: of `open_table`; only first pictures are read from it.

    Returns:
        The task of every frame, and the first execution frame of each episode, [e] int64, where
        the rows tell it.

    Raises:
        UserError: two places contradict each other; it names both, and the first episode or row.
    """
    _check_totals(dataset)
    _check_rows(dataset, rows)
    exec_starts = _read_starts(dataset, rows)
    _check_side_file(dataset, rows)
    tasks = _find_tasks(dataset, rows)
    for column in (*dataset.videos, *dataset.images):
        check_colour(dataset, column)
    for column in dataset.videos:
        check_videos(dataset, column)
    for column in dataset.images:
        check_images(dataset, column, table)
    return tasks, exec_starts


def _check_totals(dataset: Description) -> None:
    """Compare meta/info.json and the column `length` with the places of episodes."""
    lengths = dataset.lengths
    totals = (
        ("total_episodes", dataset.info.total_episodes, len(lengths), "episodes"),
        ("total_frames", dataset.info.total_frames, lengths.sum(), "frames"),
    )
    for key, declared, count, what in totals:
        require(
            declared is None or declared == count,
            f"{dataset.root}/meta/info.json: {key} is {brief(declared)}, but meta/episodes"
            f" describes {count} {what}. {CORRECT}",
        )
    listed = dataset.declared_lengths
    if listed is None:
        return
    episode = first_wrong(listed != lengths)
    if episode is not None:
        raise UserError(
            f"{dataset.root}/meta/episodes: episode {episode} has length {listed[episode]}, but"
            f" dataset_from_index and dataset_to_index give it {lengths[episode]} rows. {CORRECT}"
        )


def _check_rows(dataset: Description, rows: Mapping[str, np.ndarray]) -> None:
    """Make sure that rows lie in the order of episodes and of time, none missing and none twice,
    and that time is frame / fps.
    """
    root, fps, lengths = dataset.root, dataset.info.fps, dataset.lengths
    total = int(lengths.sum())
    require(
        "episode_index" in rows,
        f"{root}: not every file in data/ has the column episode_index, which LeRobot writes in"
        f" every dataset. {REMEDY}",
    )
    index = rows["episode_index"]
    # Before anything of that size: a damaged length may be larger than memory.
    require(
        len(index) == total,
        f"{root}: the tables hold {counted(len(index), 'row')} where meta/episodes describes"
        f" {total} in {counted(len(lengths), 'episode')}; the dataset is incomplete or mixed up."
        f" {REMEDY}",
    )
    episodes = np.repeat(np.arange(len(lengths)), lengths)
    places = np.arange(total)
    frames = places - dataset.starts[episodes]
    for name, expected in (("episode_index", episodes), ("frame_index", frames), ("index", places)):
        row = first_wrong(rows.get(name, expected) != expected)
        if row is not None:
            raise UserError(
                f"{root}: {dataset.place(row)}, has {name} {rows[name][row]}; by its place it is"
                f" {expected[row]}. Frames are missing, twice there or out of order, so that"
                f" actions would not follow each other. {CORRECT}"
            )
    if "timestamp" in rows:
        off = ~(np.abs(rows["timestamp"] * fps - frames) <= HALF)  # not a number is off as well
        row = first_wrong(off)
        if row is not None:
            raise UserError(
                f"{root}: {dataset.place(row)}, has timestamp {rows['timestamp'][row]:.4f} s; at"
                f" fps={fps:g} of meta/info.json it is {frames[row] / fps:.4f} s, more than half a"
                f" frame away ({off.sum()} such rows). Frames are taken as evenly spaced: correct"
                " fps, or resample the recording to one rate."
            )


def _read_starts(dataset: Description, rows: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Where conditioning videos end, by the two columns that say it, compared with each other and
    each with itself. Flags are 0 or 1.
    """
    for name, values in rows.items():
        if name != "is_demo" and not name.endswith(RENDERED_SUFFIX):
            continue
        row = first_wrong((values != 0) & (values != 1))
        if row is not None:
            raise UserError(
                f"{dataset.root}: {dataset.place(row)}, has {name} {values[row]}; expected true or"
                f" false. {REMEDY}"
            )
    exec_starts = None
    other = "{} at the first frame of the episode, which has one such number"
    if "exec_start_idx" in rows:
        exec_starts = rows["exec_start_idx"][dataset.starts]
    if "is_demo" in rows:
        exec_starts = np.add.reduceat(rows["is_demo"], dataset.starts)
        other = "is_demo marks the first {} frames of the episode as its conditioning video"
        frames = np.arange(len(rows["is_demo"])) - np.repeat(dataset.starts, dataset.lengths)
        require(
            ((frames < np.repeat(exec_starts, dataset.lengths)) == rows["is_demo"]).all(),
            f"{dataset.root}: is_demo must be true for an episode's first frames only.",
        )
    if exec_starts is not None and "exec_start_idx" in rows:
        expected = np.repeat(exec_starts, dataset.lengths)
        row = first_wrong(rows["exec_start_idx"] != expected)
        if row is not None:
            raise UserError(
                f"{dataset.root}: {dataset.place(row)}, has exec_start_idx"
                f" {rows['exec_start_idx'][row]}, but {other.format(expected[row])}. {CORRECT}"
            )
    return exec_starts


def _check_side_file(dataset: Description, rows: Mapping[str, np.ndarray]) -> None:
    """Compare what lies beside the tables of a converted dataset with them: others may edit the
    tables alone.
    """
    path = dataset.root / SIDE_FILE
    records = read_records(dataset.root)
    lengths, starts = dataset.lengths, dataset.starts
    require(
        len(records) <= len(lengths),
        f"{path} tells of {counted(len(records), 'episode')}, meta/episodes of {len(lengths)}."
        f" {CORRECT}"
        " Without the file, episodes have no names of tasks.",
    )
    for episode, record in enumerate(records):
        facts = {"episode_index": episode, "length": int(lengths[episode])}
        if "exec_start_idx" in rows:
            facts["exec_start_idx"] = int(rows["exec_start_idx"][starts[episode]])
        for key, value in facts.items():
            declared = record.get(key, value)
            if declared != value:
                raise UserError(
                    f"{path}: {key} of episode {episode} is {brief(declared)}; the tables say"
                    f" {value}. {CORRECT} (LeRobot's tools for editing datasets do not edit this"
                    " file.)"
                )


def _find_tasks(dataset: Description, rows: Mapping[str, np.ndarray]) -> FrameTasks:
    """The task of every frame: by `task_index` as LeRobot does, else as listed for its episode."""
    root, starts, listed_tasks = dataset.root, dataset.starts, dataset.tasks
    meta = root / "meta" / "episodes"
    if "task_index" not in rows:
        for episode, tasks in enumerate(listed_tasks):
            require(
                len(set(tasks)) == 1,
                f"{meta}: tasks of episode {episode} is {brief(list(tasks))}, and the rows have no"
                " task_index that says which one each frame has. Expected one text there, or a"
                " column task_index in the tables.",
            )
        return FrameTasks(starts, _goals(root, [tasks[0] for tasks in listed_tasks]))
    numbers = rows["task_index"]
    texts = read_tasks(root)
    row = first_wrong((numbers < 0) | (numbers >= len(texts)))
    if row is not None:
        raise UserError(
            f"{root}: {dataset.place(row)}, has task_index {numbers[row]}, but {TASKS} holds"
            f" {counted(len(texts), 'task')}. {CORRECT}"
        )
    begins = np.concatenate([[True], numbers[1:] != numbers[:-1]])
    begins[starts] = True
    first = np.flatnonzero(begins)
    episodes = np.searchsorted(starts, first, side="right") - 1
    for row, episode in zip(first.tolist(), episodes.tolist(), strict=True):
        text = texts[numbers[row]]
        # Spaces around a task and its capitals do not count.
        known = {listed_text.strip().casefold() for listed_text in listed_tasks[episode]}
        if known and text.strip().casefold() not in known:
            raise UserError(
                f"{root}: {dataset.place(row)}, has task_index {numbers[row]}, {brief(text)} in"
                f" {TASKS}; meta/episodes lists for this episode"
                f" {brief(list(listed_tasks[episode]), 200)}. {CORRECT}"
            )
    return FrameTasks(first, _goals(root, [texts[number] for number in numbers[first]]))


def _goals(root: Path, texts: Sequence[str]) -> tuple[str, ...]:
    """Goals as they are trained on, lower-case."""
    spelled = {text: text.lower() for text in texts}  # one text in memory for all its runs
    for text in spelled:
        require(
            is_goal(text),
            f"{root}: the task {brief(text)} is empty or holds control characters (in {TASKS} or"
            " meta/episodes), and a policy is told what to do in words. Write the task there.",
        )
    return tuple(spelled[text] for text in texts)


def compare_stats(root: Path, name: str, least: np.ndarray, greatest: np.ndarray) -> None:
    """Warn where `meta/stats.json` gives other extremes of a column than its rows have.

    This library never reads them for training; LeRobot's policies do.

    Args:
        least, greatest: of the rows, [d].
    """
    path = root / "meta" / "stats.json"
    if not path.is_file():
        return
    stats = read_json(path, "a dataset's statistics").get(name)
    try:
        low = np.asarray(stats["min"], np.float64).reshape(-1)
        high = np.asarray(stats["max"], np.float64).reshape(-1)
    except (KeyError, TypeError, ValueError):  # other statistics than LeRobot's
        return
    if low.shape != least.shape or high.shape != greatest.shape:
        return
    slack = 1e-3 * np.maximum(np.abs(greatest - least), 1e-3)
    d = first_wrong((np.abs(low - least) > slack) | (np.abs(high - greatest) > slack))
    if d is not None:
        log.warning(
            "%s: by meta/stats.json number %d of %s lies within %.4g and %.4g, in the rows within"
            " %.4g and %.4g. Statistics are computed anew here; LeRobot's own policies read these.",
            root,
            d + 1,
            name,
            low[d],
            high[d],
            least[d],
            greatest[d],
        )


LARGEST_IN = {"rad": 20.0, "m": 20.0}
"""What no robot reaches in a unit: three turns of a joint, twenty metres. Degrees and millimetres
go beyond.
"""


def compare_units(
    root: Path, names: Sequence[str], units: Sequence[str], scales: np.ndarray
) -> None:
    """Warn of numbers far too large for the unit that the robot's description gives them.

    Args:
        names, units: of each number.
        scales: the greatest size of each, [w].
    """
    largest = [LARGEST_IN.get(unit.strip().casefold(), np.inf) for unit in units]
    beyond = scales > np.array(largest)
    d = first_wrong(beyond)
    if d is not None:
        log.warning(
            "%s: the action's %s reaches %.4g, which is hardly in %s, as embodiment.action.units"
            " says (%d such). Correct the units, or convert the data.",
            root,
            names[d],
            scales[d],
            units[d],
            beyond.sum(),
        )


UNITS_APART = 20
"""How many times larger numbers are than others where units differ: 57 from radians to degrees."""


def have_other_units(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether the sizes of the same numbers [w] differ so much in most of them; those that never
    move do not count.
    """
    moving = (first > 0) & (second > 0)
    apart = np.abs(np.log(first[moving] / second[moving])) >= np.log(UNITS_APART)
    return bool(2 * apart.sum() > len(apart))
