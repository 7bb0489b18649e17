"""What a dataset says twice, compared: one pass over a few numbers a row, whenever a dataset is
opened.

LeRobot's format writes most facts more than once: the task of a frame, its place in time, where its
picture is. Where two of them contradict each other, one is wrong, and what would be trained on is
not what was recorded. An error names both. What does no harm here, and what LeRobot reads as well,
is a warning.
"""

import io
import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.lerobot_files import (
    REMEDY,
    SIDE_FILE,
    TASKS,
    EpisodeTable,
    Info,
    VideoSpans,
    read_records,
    read_tasks,
    video_file,
)
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.utils import decoding, read_json

log = logging.getLogger(__name__)

HALF = 0.5  # frames: what is nearer to another frame than to its own is that other frame
# frames: up to here a video's header is believed; beyond, its pictures are looked at one by one
QUARTER = 0.25
_CORRECT = "Correct the one that is wrong, or record or convert the dataset again."
_AT_ONCE = 4  # video files
_DEEP_MODES = ("I", "F")  # of Pillow: more than 8 bits a pixel


@dataclass(frozen=True)
class FrameTasks:
    """The task of every frame, as runs of rows that have the same one.

    first: [r] int64, the first row of each run, ascending from 0. texts: [r], lower-case.
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


@dataclass(frozen=True)
class Description:
    """What is compared: the parts of a dataset that were read already.

    root: its folder. info: meta/info.json. episodes: meta/episodes. videos, images: columns of the
    cameras that are videos, and of those stored in the tables.
    """

    root: Path
    info: Info
    episodes: EpisodeTable
    videos: tuple[str, ...]
    images: tuple[str, ...]

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.info.fps

    @property
    def starts(self) -> np.ndarray:
        """First row of each episode, [e] int64."""
        return self.episodes.starts

    @property
    def lengths(self) -> np.ndarray:
        """Frames of each episode, [e] int64."""
        return self.episodes.lengths

    def place(self, row: int) -> str:
        """A row in words, by its episode and frame."""
        episode = int(np.searchsorted(self.starts, row, side="right")) - 1
        return f"row {row}, frame {row - int(self.starts[episode])} of episode {episode}"


def check_consistency(
    dataset: Description, rows: Mapping[str, np.ndarray], table: Any
) -> FrameTasks:
    """Compare everything that a dataset says twice.

    Args:
        rows: of `read_index_columns`. table: of `open_table`; only first pictures are read from it.

    Returns:
        The task of every frame.

    Raises:
        UserError: two places contradict each other; it names both, and the first episode or row.
    """
    _check_totals(dataset)
    _check_rows(dataset, rows)
    _check_phases(dataset, rows)
    _check_side_file(dataset, rows)
    tasks = _find_tasks(dataset, rows)
    for column in (*dataset.videos, *dataset.images):
        _check_colour(dataset, column)
    for column in dataset.videos:
        _check_videos(dataset, column)
    for column in dataset.images:
        _check_images(dataset, column, table)
    return tasks


def _check_totals(dataset: Description) -> None:
    """Compare meta/info.json and the column `length` with the places of episodes."""
    lengths = dataset.lengths
    totals = (
        ("total_episodes", dataset.info.total_episodes, len(lengths), "episodes"),
        ("total_frames", dataset.info.total_frames, lengths.sum(), "frames"),
    )
    for key, declared, count, what in totals:
        if declared is not None and declared != count:
            raise UserError(
                f"{dataset.root}/meta/info.json: {key} is {brief(declared)}, but meta/episodes"
                f" describes {count} {what}. {_CORRECT}"
            )
    listed = dataset.episodes.declared_lengths
    if listed is None:
        return
    episode = _first(listed != lengths)
    if episode is not None:
        raise UserError(
            f"{dataset.root}/meta/episodes: episode {episode} has length {listed[episode]}, but"
            f" dataset_from_index and dataset_to_index give it {lengths[episode]} rows. {_CORRECT}"
        )


def _first(wrong: np.ndarray) -> int | None:
    """The first place at which something is wrong, [n] bool; None where nothing is."""
    places = np.flatnonzero(wrong)
    return int(places[0]) if len(places) else None


def _check_rows(dataset: Description, rows: Mapping[str, np.ndarray]) -> None:
    """Make sure that rows lie in the order of episodes and of time, none missing and none twice,
    and that time is frame / fps.
    """
    root, fps, lengths = dataset.root, dataset.fps, dataset.lengths
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
        f"{root}: the tables hold {len(index)} rows where meta/episodes describes {total} in"
        f" {len(lengths)} episodes; the dataset is incomplete or mixed up. {REMEDY}",
    )
    episodes = np.repeat(np.arange(len(lengths)), lengths)
    row = _first(index != episodes)
    if row is not None:
        raise UserError(
            f"{root}: row {row} has episode_index {index[row]}; by meta/episodes it is of episode"
            f" {episodes[row]}. The dataset is incomplete or mixed up. {REMEDY}"
        )
    places = np.arange(total)
    frames = places - dataset.starts[episodes]
    if "frame_index" in rows:
        row = _first(rows["frame_index"] != frames)
        if row is not None:
            raise UserError(
                f"{root}: {dataset.place(row)}, has frame_index {rows['frame_index'][row]}; by its"
                f" place it is {frames[row]}. Frames are missing, twice there or out of order, so"
                " that actions would not follow each other. Expected 0, 1, 2, … in every episode."
                f" {_CORRECT}"
            )
    if "index" in rows:
        row = _first(rows["index"] != places)
        if row is not None:
            raise UserError(
                f"{root}: {dataset.place(row)}, has index {rows['index'][row]}; expected {row}, its"
                f" place in the tables. {_CORRECT}"
            )
    if "timestamp" in rows:
        off = ~(np.abs(rows["timestamp"] * fps - frames) <= HALF)  # not a number is off as well
        row = _first(off)
        if row is not None:
            raise UserError(
                f"{root}: {dataset.place(row)}, has timestamp {rows['timestamp'][row]:.4f} s; at"
                f" fps={fps:g} of meta/info.json it is {frames[row] / fps:.4f} s, more than half a"
                f" frame away ({off.sum()} such rows). Frames are taken as evenly spaced: correct"
                " fps, or resample the recording to one rate."
            )


def _check_phases(dataset: Description, rows: Mapping[str, np.ndarray]) -> None:
    """Compare the two columns that say where a conditioning video ends."""
    if not {"exec_start_idx", "is_demo"} <= set(rows):
        return
    declared = rows["exec_start_idx"]
    counted = np.repeat(np.add.reduceat(rows["is_demo"], dataset.starts), dataset.lengths)
    row = _first(declared != counted)
    if row is not None:
        raise UserError(
            f"{dataset.root}: {dataset.place(row)}, has exec_start_idx {declared[row]}, but is_demo"
            f" marks the first {counted[row]} frames of the episode as its conditioning video."
            f" {_CORRECT}"
        )


def _check_side_file(dataset: Description, rows: Mapping[str, np.ndarray]) -> None:
    """Compare what lies beside the tables of a converted dataset with them: others may edit the
    tables alone.
    """
    path = dataset.root / SIDE_FILE
    records = read_records(dataset.root)
    lengths, starts = dataset.lengths, dataset.starts
    require(
        len(records) <= len(lengths),
        f"{path} tells of {len(records)} episodes, meta/episodes of {len(lengths)}. {_CORRECT}"
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
                    f" {value}. {_CORRECT} (LeRobot's tools for editing datasets do not edit this"
                    " file.)"
                )


def _find_tasks(dataset: Description, rows: Mapping[str, np.ndarray]) -> FrameTasks:
    """The task of every frame: by `task_index` as LeRobot does, else as listed for its episode."""
    root, starts, listed_tasks = dataset.root, dataset.starts, dataset.episodes.tasks
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
    row = _first((numbers < 0) | (numbers >= len(texts)))
    if row is not None:
        raise UserError(
            f"{root}: {dataset.place(row)}, has task_index {numbers[row]}, but {TASKS} holds"
            f" {len(texts)} tasks. {_CORRECT}"
        )
    begins = np.concatenate([[True], numbers[1:] != numbers[:-1]])
    begins[starts] = True
    first = np.flatnonzero(begins)
    episodes = np.searchsorted(starts, first, side="right") - 1
    for row, episode in zip(first.tolist(), episodes.tolist(), strict=True):
        text = texts[numbers[row]]
        known = {_plain(listed_text) for listed_text in listed_tasks[episode]}
        if known and _plain(text) not in known:
            raise UserError(
                f"{root}: {dataset.place(row)}, has task_index {numbers[row]}, {brief(text)} in"
                f" {TASKS}; meta/episodes lists for this episode"
                f" {brief(list(listed_tasks[episode]), 200)}. {_CORRECT}"
            )
    return FrameTasks(first, _goals(root, [texts[number] for number in numbers[first]]))


def _plain(text: str) -> str:
    """A text as tasks are compared: spaces around it and capitals do not count."""
    return text.strip().casefold()


def _goals(root: Path, texts: Sequence[str]) -> tuple[str, ...]:
    """Goals as they are trained on, lower-case; an empty one tells a policy nothing."""
    for text in set(texts):
        require(
            text.strip(),
            f"{root}: the task {brief(text)} is empty (in {TASKS} or meta/episodes), and a policy"
            " is told what to do in words. Write the task there.",
        )
    spelled = {text: text.lower() for text in set(texts)}  # one text in memory for all its runs
    return tuple(spelled[text] for text in texts)


def _check_colour(dataset: Description, column: str) -> None:
    """Refuse depth by what meta/info.json says of a camera: a policy reads colours of 8 bits."""
    about = dataset.info.features[column].about_images
    depth = about.get("is_depth_map", about.get("video.is_depth_map", False))
    if depth is True:
        raise _depth(dataset.root, column, "is_depth_map is true in meta/info.json")
    kind = about.get("video.pix_fmt")
    if isinstance(kind, str) and _is_deep_grey(kind):
        raise _depth(dataset.root, column, f"video.pix_fmt is {brief(kind)} in meta/info.json")


def _is_deep_grey(pixel_format: str) -> bool:
    """Whether pixels are one number of more than 8 bits: gray10le, gray12le, gray16be, grayf32le,
    y210 is colour.
    """
    return pixel_format.startswith("gray") and pixel_format not in ("gray", "gray8", "gray8a")


def _depth(root: Path, column: str, reason: str) -> UserError:
    return UserError(
        f"{root}: {column} holds depth, or numbers of more than 8 bits ({reason}). As a colour"
        " image it would be cut off to 8 bits. Name a colour camera in its place"
        " (embodiment.cameras.<name>.key), or leave the camera out."
    )


def check_mode(root: Path, column: str, image: Any) -> None:
    """Refuse a picture of Pillow whose pixels do not fit into 8 bits.

    Raises:
        UserError: it holds 16-bit, 32-bit or floating-point pixels.
    """
    if str(image.mode).partition(";")[0] in _DEEP_MODES:
        kind = {"F": "floating-point", "I": "32-bit"}.get(image.mode, "16-bit")
        raise _depth(root, column, f"its pictures are {kind}, mode {image.mode!r} of Pillow")


def _check_images(dataset: Description, column: str, table: Any) -> None:
    """Look at the header of every episode's first picture; the others are looked at when they are
    read.
    """
    from PIL import Image

    sizes = set()
    for start in dataset.starts.tolist():
        cell = table[start : start + 1][column][0].as_py()
        content = cell["bytes"] if isinstance(cell, Mapping) else None
        if content is None:
            raise UserError(
                f"{dataset.root}: {dataset.place(start)}, holds no picture in {column} (only a"
                " path). Pictures lie in the tables; LeRobot embeds them when an episode is saved."
            )
        place = f"{dataset.root}, {dataset.place(start)}, {column}"
        with decoding(place, "a picture", REMEDY), Image.open(io.BytesIO(content)) as image:
            check_mode(dataset.root, column, image)
            sizes.add(image.size)
    for width, height in sizes:
        _compare_size(dataset, column, width, height)


def _compare_size(dataset: Description, column: str, width: int, height: int) -> None:
    """Warn of pictures of another size than described: all are scaled for the network anyway."""
    shape = dataset.info.features[column].shape
    # colours last, or first
    sides = [shape[:2], shape[-2:]]
    if len(shape) != 3 or (height, width) not in sides:
        log.warning(
            "%s: meta/info.json gives %s the shape %s, but its pictures have %d rows and %d"
            " columns.",
            dataset.root,
            column,
            list(shape),
            height,
            width,
        )


@dataclass(frozen=True)
class _Header:
    """What a video file says of itself: pictures (0: unknown), seconds, pictures per second (0:
    they vary), format.

    begin: of the first picture, seconds.
    """

    images: int
    begin: float
    seconds: float
    rate: float
    pixel_format: str
    width: int
    height: int


def _check_videos(dataset: Description, column: str) -> None:
    """Compare the spans of episodes in video files with each other, with their lengths, and with
    the files.
    """
    spans = dataset.episodes.videos[column]
    _check_ends(dataset, column, spans)
    # Which episodes each file holds, in the order of their images.
    episodes_of: dict[Path, np.ndarray] = {}
    places = np.stack([spans.chunk, spans.file], axis=1)
    files, file_of_episode = np.unique(places, axis=0, return_inverse=True)
    for number, (chunk, file) in enumerate(files.tolist()):
        path = video_file(dataset.root, dataset.info.video_path, column, chunk, file)
        episodes = np.flatnonzero(file_of_episode.reshape(-1) == number)
        episodes_of[path] = episodes[np.argsort(spans.begin[episodes], kind="stable")]
    for path, episodes in episodes_of.items():
        _check_neighbours(dataset, column, path, episodes, spans.begin[episodes])
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        headers = list(pool.map(_read_header, episodes_of))
    sizes = set()
    for (path, episodes), header in zip(episodes_of.items(), headers, strict=True):
        if _is_deep_grey(header.pixel_format):
            raise _depth(dataset.root, column, f"{path.name} is stored as {header.pixel_format}")
        sizes.add((header.width, header.height))
        begins = spans.begin[episodes]
        if not _is_even(header, begins, dataset.lengths[episodes], dataset.fps):
            _check_frames_of_video(dataset, column, path, episodes, begins)
    for width, height in sizes:
        _compare_size(dataset, column, width, height)


def _check_ends(dataset: Description, column: str, videos: VideoSpans) -> None:
    if videos.end is None:
        return
    begins, ends = videos.begin, videos.end
    spans = (ends - begins) * dataset.fps
    episode = _first(~(np.abs(spans - dataset.lengths) <= HALF))
    if episode is not None:
        raise UserError(
            f"{dataset.root}/meta/episodes: the pictures of {column} of episode {episode} lie"
            f" between {begins[episode]:.4f} s and {ends[episode]:.4f} s, {spans[episode]:.2f}"
            f" frames at fps={dataset.fps:g}, but the episode has {dataset.lengths[episode]}"
            f" frames. {_CORRECT}"
        )


def _check_neighbours(
    dataset: Description, column: str, path: Path, inside: np.ndarray, begins: np.ndarray
) -> None:
    """Make sure that no two episodes have the same pictures of a file."""
    ends = begins + dataset.lengths[inside] / dataset.fps
    k = _first((ends[:-1] - begins[1:]) * dataset.fps > HALF)
    if k is not None:
        raise UserError(
            f"{dataset.root}/meta/episodes: episodes {inside[k]} and {inside[k + 1]} overlap in the"
            f" video {path.name} of {column}: one ends at {ends[k]:.4f} s, and the other begins at"
            f" {begins[k + 1]:.4f} s (from_timestamp). One of them would show the other's pictures."
            f" {_CORRECT}"
        )


def _read_header(path: Path) -> _Header:
    import av

    require(
        path.is_file(), f"{path} is missing: the dataset is incomplete. Copy or download it again."
    )
    with decoding(path, "a video", "Copy or convert it again."), av.open(str(path)) as container:
        stream = container.streams.video[0]
        tick_seconds = float(stream.time_base or 0)
        average, base = float(stream.average_rate or 0), float(stream.base_rate or 0)
        is_constant = abs(average - base) <= 1e-3 * base
        context = stream.codec_context
        header = _Header(
            images=stream.frames,
            begin=(stream.start_time or 0) * tick_seconds,
            seconds=(stream.duration or 0) * tick_seconds,
            rate=average if is_constant else 0.0,
            pixel_format=str(context.pix_fmt),
            width=context.width,
            height=context.height,
        )
    return header


def _is_even(header: _Header, begins: np.ndarray, lengths: np.ndarray, fps: float) -> bool:
    """Whether a file holds the pictures of its episodes back to back, by its header alone; else one
    has to look.
    """
    before = np.cumsum(lengths) - lengths
    total = int(lengths.sum())
    return bool(
        header.images == total
        and header.rate > 0
        and abs(header.begin * fps) <= QUARTER
        and abs(total / header.rate - total / fps) * fps <= QUARTER
        and abs(header.seconds * fps - total) <= QUARTER
        and (np.abs(begins * fps - before) <= QUARTER).all()
    )


def _check_frames_of_video(
    dataset: Description, column: str, path: Path, inside: np.ndarray, begins: np.ndarray
) -> None:
    """Compare the time of every picture in a file with the times at which rows look for theirs.
    Decodes nothing.
    """
    times = _frame_times(path)
    lengths, fps = dataset.lengths[inside], dataset.fps
    exact = len(times) == lengths.sum()
    before = 0
    for episode, begin, length in zip(
        inside.tolist(), begins.tolist(), lengths.tolist(), strict=True
    ):
        targets = begin + np.arange(length) / fps
        after = np.clip(np.searchsorted(times, targets), 1, max(len(times) - 1, 1))
        following = np.minimum(after, len(times) - 1)
        is_before_nearer = targets - times[after - 1] <= times[following] - targets
        nearest = np.where(is_before_nearer, after - 1, following)
        away = np.abs(times[nearest] - targets) * fps
        # With a picture for every row, the n-th row's is the n-th. Otherwise only the distance
        # tells.
        wrong = away > QUARTER
        if exact:
            wrong = nearest != before + np.arange(length)
        before += length
        frame = _first(wrong | (away > HALF + 1e-6))
        if frame is not None:
            raise UserError(
                f"{path}: frame {frame} of episode {episode} is looked for at {targets[frame]:.4f}"
                f" s ({column}/from_timestamp {begin:.4f} s, fps={fps:g}), but the video, with"
                f" {len(times)} pictures to {times[-1]:.4f} s for {lengths.sum()} rows, has the"
                f" nearest at {times[nearest[frame]]:.4f} s: it is shorter than the table beside"
                f" it, shifted, or of another rate. {_CORRECT}"
            )


def _frame_times(path: Path) -> np.ndarray:
    """When each picture of a file is displayed, seconds, ascending [n]; reads the file without
    decoding it.
    """
    import av

    with decoding(path, "a video", "Copy or convert it again."), av.open(str(path)) as container:
        stream = container.streams.video[0]
        ticks = [packet.pts for packet in container.demux(stream) if packet.pts is not None]
        if not ticks:
            raise ValueError("it holds no picture")
        seconds = np.sort(np.array(ticks, np.int64)) * float(stream.time_base or 0)
    return seconds


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
    d = _first((np.abs(low - least) > slack) | (np.abs(high - greatest) > slack))
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
        names, units: of each number. scales: the greatest size of each, [w].
    """
    largest = [LARGEST_IN.get(unit.strip().casefold(), np.inf) for unit in units]
    beyond = scales > np.array(largest)
    d = _first(beyond)
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


def named_alike(name: str) -> str:
    """A number's name as names are compared: `Joint_1` is `joint 1`."""
    return "".join(letter for letter in name.casefold() if letter.isalnum())


def compare_names(
    first: Sequence[str],
    second: Sequence[str],
    what: str,
    of_first: str,
    of_second: str,
    same_place: str,
) -> None:
    """Compare the names of the same numbers in two places; empty where one has none.

    Raises:
        UserError: the same names in another order: numbers would be exchanged.
    """
    if not first or not second:
        return
    compared_first = [named_alike(name) for name in first]
    compared_second = [named_alike(name) for name in second]
    if compared_first == compared_second:
        return
    both = f"{of_first}: {listed(first, 24)}; {of_second}: {listed(second, 24)}"
    if sorted(compared_first) == sorted(compared_second):
        raise UserError(
            f"The numbers of the {what} have the same names in another order. {both}. {same_place}"
        )
    log.warning("The numbers of the %s have different names. %s.", what, both)
