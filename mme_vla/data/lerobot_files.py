"""A LeRobot v3.0 dataset's files: description, columns, tables. All of them are checked when they
are opened.

Places, fallbacks and meanings are those of LeRobot's own classes; tests compare the two on every
layout. The classes themselves are not used: they download a file from the hub that they cannot open
here, read the table of episodes through a cache whose key is the files' paths and time stamps, and
take several seconds to import.
"""

import math
import re
import string
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.hdf5 import SUBGOALS
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.action_space import POSE_WIDTH
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.utils import decoding, file_sum, inside, read_json, require_file, user_cache

SIDE_FILE = "meta/robomme_episodes.json"
"""What LeRobot's columns have no place for: task, seed, difficulty, options of a choice."""
OPTIONAL = ("is_demo", "exec_start_idx", *SUBGOALS)
RENDERED_SUFFIX = "_drawn"
"""After a camera's name: the column that says which frames it was rendered at, where not at all."""
NAMES: Mapping[str, Mapping[str, str]] = {
    "robomme": {},
    "lerobot": {
        "image": "observation.images.image",
        "wrist_image": "observation.images.wrist_image",
        "state": "observation.state",
        "actions": "action",
    },
}
"""Spellings of a dataset's columns, each by how it differs from the released datasets'."""
_ACTION = ("action", "actions")


@dataclass(frozen=True)
class Columns:
    """Where things are: a column for every camera, and those whose numbers, joined, are the state
    and the action.

    pose: the same of the tool's pose, where actions are differences to it.
    tables: the columns that are read from the tables; images are among them only where they are
    stored there.
    """

    cameras: Mapping[str, str]
    state: tuple[str, ...]
    action: tuple[str, ...]
    pose: tuple[str, ...]
    tables: tuple[str, ...]


def find_columns(
    root: Path, features: Mapping[str, Mapping[str, Any]], robot: Embodiment
) -> Columns:
    """Match a robot with a dataset."""
    spellings = {
        camera.name: [
            spelling
            for name in ((camera.key, camera.name) if camera.key else (camera.name,))
            for spelling in (name, f"observation.images.{name}")
        ]
        for camera in robot.cameras
    }
    spellings |= {
        key: [key, f"observation.{key}"] for key in (*robot.state.key, *robot.action.pose_key)
    }
    spellings |= {key: [key, *(_ACTION if key in _ACTION else ())] for key in robot.action.key}
    if not robot.state.key:
        spellings["state"] = ["observation.state", "state"]
    if not robot.action.key:
        spellings["action"] = [*_ACTION]
    matches = {
        key: next((name for name in names if name in features), None)
        for key, names in spellings.items()
    }
    keys = {camera.name: camera.key or camera.name for camera in robot.cameras}
    missing = [keys.get(name, name) for name, column in matches.items() if column is None]
    require(
        not missing,
        f"{root} lacks the feature{'s'[: len(missing) > 1]} {', '.join(missing)}; it has"
        f" {listed(features)}. These are the names of the robot {robot.name!r}: choose"
        " embodiment=<the robot this dataset is of>, or name its columns in a configs/embodiment"
        " file of your own. (RoboMME's poses and waypoints are columns of datasets that this"
        " library converts or records.)",
    )
    columns = {name: str(column) for name, column in matches.items()}
    cameras = {name: columns[name] for name in robot.camera_names}
    for name, column in cameras.items():
        require(
            features[column]["dtype"] in ("image", "video"),
            f"{root}: {column} holds {brief(features[column]['dtype'])}, no images: it cannot be"
            f" the camera {name!r} of the robot {robot.name!r} (embodiment.cameras.{name}.key).",
        )
    state = tuple(columns[key] for key in robot.state.key or ("state",))
    action = tuple(columns[key] for key in robot.action.key or ("action",))
    pose = tuple(columns[key] for key in robot.action.pose_key)
    vectors = {"state": (state, robot.state.width), "action": (action, robot.action.width)}
    for what, (names, width) in (
        vectors | ({"tool's pose": (pose, POSE_WIDTH)} if pose else {})
    ).items():
        if sum(width_of(features[name]) for name in names) != width:
            shapes = ", ".join(
                f"{name} has shape {list(features[name]['shape'])}" for name in names
            )
            raise UserError(
                f"{root}: {shapes}; expected [{width}], the {what} of the robot {robot.name!r}."
            )
    tables = [
        "episode_index",
        *state,
        *action,
        *pose,
        *(name for name in OPTIONAL if name in features),
    ]
    tables += [
        f"{name}{RENDERED_SUFFIX}" for name in cameras if f"{name}{RENDERED_SUFFIX}" in features
    ]
    tables += [column for column in cameras.values() if features[column]["dtype"] == "image"]
    return Columns(cameras, state, action, pose, tuple(dict.fromkeys(tables)))


def width_of(feature: Mapping[str, Any]) -> int:
    """How many numbers a row of this feature holds."""
    shape = tuple(feature["shape"])
    return shape[0] if len(shape) == 1 else 0


def names_of(features: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """What a dataset calls the numbers of some features, joined; empty where one of them has no
    name for each number.

    LeRobot writes a list, or a list under one key such as `motors`.
    """
    names: list[str] = []
    for feature in features:
        listed = feature.get("names")
        if isinstance(listed, Mapping) and len(listed) == 1:
            listed = next(iter(listed.values()))
        if not isinstance(listed, list | tuple) or len(listed) != width_of(feature):
            return ()
        names += map(str, listed)
    return tuple(names)


SAMPLE = Path(__file__).resolve().parent.parent / "assets" / "sample"


def resolve_root(root: str | Path) -> Path:
    """Return the dataset folder; `sample` names the one in the package."""
    path = SAMPLE if str(root) == "sample" else Path(root).expanduser()
    info = path / "meta" / "info.json"
    require(
        info.is_file(),
        f"No LeRobot dataset at {str(root)!r} (there is no {info}). Give its local folder, or"
        " 'sample'. From the hub: `hf download <owner>/<dataset> --repo-type dataset --local-dir"
        " <folder>`; from HDF5 files: `mme-vla convert input=<files> output=<folder>`.",
    )
    version = brief(read_info(path).get("codebase_version", "unknown"), quote=False)
    require(
        version.startswith("v3."),
        f"{path} is a LeRobot {version} dataset; v3.0 is needed. Convert it with LeRobot's own"
        f" command: `python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={path.name}"
        f" --root={path} --push-to-hub=false`.",
    )
    there = {TASKS: (path / TASKS).exists()}
    there |= {
        f"{folder}/*/*.parquet": bool(_tables(path, folder)) for folder in ("meta/episodes", "data")
    }
    for pattern, present in there.items():
        if not present:
            raise UserError(
                f"{path} has no {pattern}: the dataset is incomplete. Copy, download or convert it"
                " again."
            )
    return path


def read_info(root: Path) -> dict[str, Any]:
    """Return `meta/info.json`: features with a `dtype` and a `shape`, frames per second, and
    others.
    """
    path = root / "meta" / "info.json"
    info = read_json(path, "a dataset's description")
    features = info.get("features")
    if not isinstance(features, dict) or not all(
        _is_feature(feature) for feature in features.values()
    ):
        raise UserError(
            f"{path} does not describe its features by dtype and shape. Copy or download it again."
        )
    fps = info.get("fps")
    if (
        isinstance(fps, bool)
        or not isinstance(fps, int | float)
        or not 0 < fps <= 1000
        or not math.isfinite(fps)
    ):
        raise UserError(
            f"{path}: fps is {brief(fps)}; expected frames per second, above 0 and at most 1000."
        )
    described = {
        name: {**feature, "shape": tuple(feature["shape"])} for name, feature in features.items()
    }
    return {"video_path": VIDEO_PATH, **info, "features": described}


def about_images(feature: Mapping[str, Any]) -> dict[str, Any]:
    """What a dataset says of a camera's images beside their shape, empty where it says nothing.

    LeRobot writes it under `info`; older writers did under `video_info`.
    """
    for key in ("info", "video_info"):
        about = feature.get(key)
        if isinstance(about, dict) and about:
            return about
    return {}


def lossy_coding(feature: Mapping[str, Any]) -> str | None:
    """The lossy codec of a video, such as `av1 at crf 30`; None for a lossless one, or without
    information.

    LeRobot's default before it wrote the quality was AV1 at crf 30.
    """
    about = about_images(feature)
    codec, crf = about.get("video.codec"), about.get("video.crf")
    if not isinstance(codec, str) or crf == 0 or (crf is None and codec != "av1"):
        return None
    return brief(codec, quote=False) + ("" if crf is None else f" at crf {brief(crf)}")


def _is_feature(feature: object) -> bool:
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        return False
    shape = feature.get("shape")
    return isinstance(shape, list) and all(type(side) is int and 0 < side < 2**20 for side in shape)


def read_exec_starts(file: Path, episodes: int) -> np.ndarray:
    """Read a side file of first execution frames, JSON {"0": 66, …} or parquet (episode_index,
    exec_start_idx).

    Returns:
        int64 [episodes].
    """
    expected = (
        'Expected JSON {"<episode_index>": <exec_start_idx>, …} or a parquet table with the columns'
        " episode_index and exec_start_idx, all whole numbers from 0."
    )
    require_file(file, "exec_starts, first execution frames")
    if file.suffix == ".json":
        entries = list(read_json(file, "first execution frames").items())
        pairs = [
            (int(key) if key.isdecimal() and len(key) < 10 else key, value)
            for key, value in entries
        ]
    else:
        import pyarrow.parquet as pq

        with decoding(file, "a parquet table", expected), pq.ParquetFile(file) as opened:
            columns = opened.read(columns=["episode_index", "exec_start_idx"]).to_pydict()
            pairs = list(zip(columns["episode_index"], columns["exec_start_idx"], strict=True))
    for pair in pairs:
        if not all(type(number) is int and 0 <= number < 2**40 for number in pair):
            raise UserError(f"{file} says {brief(pair[1])} of episode {brief(pair[0])}. {expected}")
    table = dict(pairs)
    lost = [episode for episode in range(episodes) if episode not in table]
    require(
        not lost,
        f"{file} covers no episode {lost[:5]}{'…' if len(lost) > 5 else ''}; it must name all"
        f" {episodes}.",
    )
    return np.array([table[episode] for episode in range(episodes)], np.int64)


def content_fingerprint(
    root: Path, parts: Sequence[str] = ("data", "videos", "meta/episodes")
) -> str:
    """Hash what the dataset holds: names, sizes and 64 KB from the start, middle and end of every
    file in `parts`.

    Independent of the folder's place and of time stamps; reading whole videos would take minutes. A
    change that leaves a file's size and these three places alone is not noticed: a cache of images
    is then taken for that of the changed ones. Only checksums notice it (`EpisodeSource.verify`).
    Numbers are never read by this hash: see `open_table`.

    Args:
        root: the dataset's folder. parts: folders in it, or single files.
    """
    digest = sha256()
    for part in parts:
        place = root / part
        files = [place] if place.is_file() else sorted(place.rglob("*"))
        for file in files:
            if file.suffix not in (".parquet", ".mp4") or _is_hidden(file):
                continue
            size = (
                require_file(inside(root, file.relative_to(root).as_posix()), "a part of a dataset")
                .stat()
                .st_size
            )
            digest.update(f"{file.relative_to(root).as_posix()} {size}\n".encode())
            with file.open("rb") as handle:
                for offset in (0, size // 2, max(size - 65536, 0)):
                    handle.seek(offset)
                    digest.update(handle.read(65536))
    return digest.hexdigest()[:16]


REMEDY = "Copy, download or convert the dataset again."
TASKS = "meta/tasks.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
"""Where LeRobot keeps videos unless info.json says otherwise."""
_MOST_FRAMES = 2**40  # of a dataset; a larger number is damage
_INTEGER_COLUMNS = ("episode_index", "is_demo", "exec_start_idx")
_FIELDS = {"video_key": ("",), "chunk_index": ("", "d", "03d"), "file_index": ("", "d", "03d")}


def _is_hidden(file: Path) -> bool:
    """Whether a file is not the dataset's: macOS leaves `._<name>` beside what it copies to other
    disks.
    """
    return file.name.startswith(".")


def _tables(root: Path, folder: str) -> list[Path]:
    return [path for path in (root / folder).glob("*/*.parquet") if not _is_hidden(path)]


def _in_order(path: Path) -> list[str | int]:
    """Sorts by the numbers in a path: file-1000 comes after file-999, where texts would put it
    after file-100.
    """
    parts: list[str | int] = []
    for part in re.split(r"(\d+)", f"{path.parent.name}/{path.name}"):
        parts.append(int(part) if part.isdecimal() else part)
    return parts


def parquet_files(root: Path, folder: str) -> list[Path]:
    """The parquet files of `folder`, two levels down as in LeRobot v3.0, in the order of their
    numbers.
    """
    return [
        require_file(path, "a parquet table")
        for path in sorted(_tables(root, folder), key=_in_order)
    ]


def read_episode_table(
    root: Path, video_views: Sequence[str]
) -> dict[str, np.ndarray | list[tuple[str, ...]]]:
    """Read and check `meta/episodes`.

    Returns:
        `starts` and `lengths`, [e] int64 rows of the tables; `tasks`, [e] the tasks listed for each
        episode, none where they are not listed; and for every view `<view>/chunk_index`,
        `<view>/file_index` [e] int64, `<view>/from_timestamp` [e] float64, seconds, and
        `<view>/to_timestamp` where there is one. `length`, the lengths once more, where they are
        written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    meta = root / "meta" / "episodes"
    files = [f"{view}/{key}" for view in video_views for key in ("chunk_index", "file_index")]
    times = [f"{view}/from_timestamp" for view in video_views]
    ends = [f"{view}/to_timestamp" for view in video_views]
    integers = [
        "episode_index",
        "dataset_from_index",
        "dataset_to_index",
        *(f"videos/{name}" for name in files),
    ]
    needed = {name: pa.int64() for name in integers} | {
        f"videos/{name}": pa.float64() for name in times
    }
    more = {"length": pa.int64()} | {f"videos/{name}": pa.float64() for name in ends}
    with decoding(meta, "tables of episodes", REMEDY):
        opened = [pq.ParquetFile(file) for file in parquet_files(root, "meta/episodes")]
        there = set.intersection(*(set(file.schema_arrow.names) for file in opened))
    missing = [name for name in needed if name not in there]
    require(
        not missing,
        f"{meta} lacks the column{'s'[: len(missing) > 1]} {listed(missing)}; LeRobot writes them"
        " in every dataset of version v3.0. It has"
        f" {listed(sorted(name for name in there if not name.startswith('stats/')))}.",
    )
    kinds = needed | {name: kind for name, kind in more.items() if name in there}
    with decoding(meta, "tables of episodes", REMEDY):
        parts = [file.read([*kinds, *(["tasks"] if "tasks" in there else [])]) for file in opened]
        table = pa.concat_tables(
            [part.select(list(kinds)).cast(pa.schema(list(kinds.items()))) for part in parts]
        )
        empty = [name for name in kinds if table[name].null_count]
        columns = {name: table[name].to_numpy() for name in kinds}
        cells = [None] * table.num_rows
        if "tasks" in there:
            cells = [cell for part in parts for cell in part["tasks"].to_pylist()]
    require(
        not empty and table.num_rows,
        f"{meta} describes {table.num_rows} episodes; empty cells in: {listed(empty) or 'none'}."
        f" {REMEDY}",
    )
    starts, stops = columns["dataset_from_index"], columns["dataset_to_index"]
    checks = {
        "episode_index": (columns["episode_index"] == np.arange(len(starts)), "0, 1, 2, …"),
        "dataset_from_index": (
            starts == np.concatenate([[0], stops[:-1]]),
            "the row after the episode before",
        ),
        "dataset_to_index": ((stops > starts) & (stops <= _MOST_FRAMES), "at least one row"),
        **{
            f"videos/{n}": (((v := columns[f"videos/{n}"]) >= 0) & (v <= _MOST_FRAMES), "a number")
            for n in files
        },
        **{
            f"videos/{n}": (np.isfinite(v := columns[f"videos/{n}"]) & (v >= 0), "seconds from 0")
            for n in times
        },
    }
    for name, (valid, expected) in checks.items():
        if not valid.all():
            episode = int(np.argmin(valid))
            value = brief(columns[name][episode].item())
            raise UserError(
                f"{meta}: {name} of episode {episode} is {value}; expected {expected}. {REMEDY}"
            )
    named = {
        name.removeprefix("videos/"): columns[name]
        for name in columns
        if name in more or name in needed
    }
    tasks = [_listed_tasks(meta, episode, cell) for episode, cell in enumerate(cells)]
    return {**named, "starts": starts, "lengths": stops - starts, "tasks": tasks}


def _listed_tasks(meta: Path, episode: int, cell: Any) -> tuple[str, ...]:
    """The tasks of an episode: LeRobot writes a list of texts; one text alone, an empty list or
    nothing is read too.
    """
    texts = list(cell or ()) if isinstance(cell, list | None) else [cell]
    if not all(isinstance(text, str) for text in texts):
        raise UserError(
            f"{meta}: tasks of episode {episode} is {brief(cell)}; expected a list of texts."
            f" {REMEDY}"
        )
    return tuple(texts)


def read_tasks(root: Path) -> list[str]:
    """The texts of `meta/tasks.parquet` by `task_index`.

    Raises:
        UserError: the file holds no texts, or its column `task_index` does not count its rows,
            which LeRobot goes by.
    """
    import pandas as pd

    path = root / TASKS
    expected = (
        "Expected the task's text as the index (or a column `task`), and a column `task_index`: 0,"
        " 1, 2, …"
    )
    with decoding(require_file(path, "a table of tasks"), "a table of tasks", expected):
        table = pd.read_parquet(path)
        texts = list(table["task"] if "task" in table.columns else table.index)
        numbers = (
            list(table["task_index"]) if "task_index" in table.columns else list(range(len(texts)))
        )
    wrong = [text for text in texts if not isinstance(text, str)]
    require(
        not wrong, f"{path} holds {brief(wrong[:1])} where the text of a task belongs. {expected}"
    )
    for row, (number, text) in enumerate(zip(numbers, texts, strict=True)):
        if number != row:
            raise UserError(
                f"{path}: row {row}, {brief(text)}, has task_index {brief(number)}. LeRobot takes a"
                f" task by its row, so the row and task_index must be the same. {expected}"
            )
    return texts


INDEX_COLUMNS = ("episode_index", "frame_index", "timestamp", "index", "task_index")
"""What LeRobot writes of every row beside the recorded values."""


def read_index_columns(root: Path, extra: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The columns that say which row is which, each [rows]: int64, and `timestamp` float64; those
    that all files have.

    Args:
        extra: further columns of one whole number a row.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = parquet_files(root, "data")
    with decoding(root / "data", "tables of frames", REMEDY):
        opened = [pq.ParquetFile(file) for file in files]
        there = set.intersection(*(set(file.schema_arrow.names) for file in opened))
        names = [name for name in (*INDEX_COLUMNS, *extra) if name in there]
        table = pa.concat_tables([file.read(names) for file in opened])
    columns = {}
    for name in names:
        values = table[name]
        require(not values.null_count, f"{root}: {values.null_count} rows have no {name}. {REMEDY}")
        with decoding(root / "data", f"numbers ({name})", REMEDY):
            kind = pa.float64() if name == "timestamp" else pa.int64()
            columns[name] = flat(values).cast(kind).to_numpy(zero_copy_only=False)
    return columns


def open_table(root: Path, columns: Sequence[str], features: dict[str, Any]) -> Any:
    """Memory-map these columns of all tables, through the `datasets` library as LeRobot does.

    Its copy of the tables lies in a folder that is named after their content: the library itself
    tells them by path and time stamp, which copies and archives may keep while the content is
    another.
    """
    from lerobot.utils.utils import SuppressProgressBars

    from datasets import Dataset, Features

    for name in _INTEGER_COLUMNS:
        if name in columns and not features[name]["dtype"].startswith(("int", "uint", "bool")):
            raise UserError(
                f"{root}: {name} is {brief(features[name]['dtype'])}; expected whole numbers."
                f" {REMEDY}"
            )
    with decoding(root / "meta" / "info.json", "a description of features", REMEDY):
        target = Features({name: _kind(**features[name]) for name in columns})
    large = any(features[name]["dtype"] == "image" for name in columns)
    files = parquet_files(root, "data")
    folder = user_cache("tables") / _tables_key(root, files, large)
    with (
        decoding(root / "data", "tables of frames", REMEDY),
        nullcontext() if large else SuppressProgressBars(),
    ):
        table = Dataset.from_parquet(
            [str(file) for file in files],
            columns=list(columns),
            features=target,
            cache_dir=str(folder),
        )
    return table.with_format("arrow")


def _tables_key(root: Path, files: Sequence[Path], large: bool) -> str:
    """Names the content of tables: all of it, or, where images make them large, the fingerprint and
    times of change.

    The time of change (ctime) is set by the system whenever content is written; no program can keep
    it.
    """
    digest = sha256()
    if large:
        digest.update(content_fingerprint(root, ("data",)).encode())
    for file in files:
        content = str(file.stat().st_ctime_ns) if large else file_sum(file)
        digest.update(f"{file.relative_to(root).as_posix()} {content}\n".encode())
    return digest.hexdigest()[:16]


def flat(column: Any) -> Any:
    """A column of an arrow table as one flat array; columns of one number may be stored as lists of
    one.
    """
    array = column.combine_chunks() if hasattr(column, "combine_chunks") else column
    while (
        hasattr(array, "flatten")
        and getattr(array.type, "num_fields", 0) == 1
        and hasattr(array.type, "value_type")
    ):
        array = array.flatten()
    return array


def _kind(dtype: str, shape: tuple[int, ...], **_: Any) -> Any:
    """What `datasets` calls such a feature. LeRobot could say it, at the price of four seconds for
    importing it.
    """
    import datasets

    if dtype == "image":
        return datasets.Image()
    if shape == (1,):
        return datasets.Value(dtype)
    if len(shape) == 1:
        return datasets.List(datasets.Value(dtype), length=shape[0])
    return getattr(datasets, f"Array{len(shape)}D")(shape=shape, dtype=dtype)


def check_vectors(root: Path, table: Any, name: str, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Make sure that every row of a column is `width` finite numbers; one alone may stand without a
    list around it.

    Returns:
        The least and the greatest of each number, [width] float64.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    least, greatest = np.full(width, np.inf), np.full(width, -np.inf)
    first, list_kinds = 0, (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    for chunk in table.data[name].chunks:
        # Counting is not enough: rows of 7 and 9 numbers have 8 on average.
        is_list = any(is_kind(chunk.type) for is_kind in list_kinds)
        lengths = (
            pc.list_value_length(chunk).fill_null(-1).to_numpy(zero_copy_only=False)
            if is_list
            else width
        )
        wrong = np.broadcast_to(lengths != width, len(chunk))
        if not wrong.any():
            numbers = chunk.flatten() if is_list else chunk
            values = numbers.to_numpy(zero_copy_only=False).reshape(-1, width)  # nulls become NaN
            with np.errstate(over="ignore"):
                wrong = ~np.isfinite(values.astype(np.float32)).all(axis=1)  # as policies read them
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            value = brief(chunk[row].as_py())
            raise UserError(
                f"{root}: row {first + row} has {name} {value}; expected {width} finite numbers"
                f" within float32 (to 3.4e38). {REMEDY}"
            )
        if len(chunk):
            least, greatest = (
                np.minimum(least, values.min(axis=0)),
                np.maximum(greatest, values.max(axis=0)),
            )
        first += len(chunk)
    return least, greatest


def video_file(root: Path, template: object, view: str, chunk: int, file: int) -> Path:
    """The place of a video: `video_path` of meta/info.json, filled in."""
    info = root / "meta" / "info.json"
    try:
        fields = [
            (name, spec or "")
            for _, name, spec, _ in string.Formatter().parse(str(template))
            if name is not None
        ]
    except ValueError:
        fields = [("", "")]
    if not isinstance(template, str) or any(
        spec not in _FIELDS.get(name, ()) for name, spec in fields
    ):
        raise UserError(
            f"{info}: video_path is {brief(template)}; expected a path with the fields"
            f" {{video_key}}, {{chunk_index:03d}} and {{file_index:03d}}. {REMEDY}"
        )
    return inside(
        root, template.format(video_key=view, chunk_index=chunk, file_index=file), "video"
    )
