"""A LeRobot v3.0 dataset's files: description, columns, tables. All of them are checked when they are opened.

LeRobot's own reader is not used: it downloads a file from the hub that it cannot open here.
"""

import math
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
from mme_vla.utils import decoding, inside, read_json, require_file

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
    """Where things are: a column for every camera, and those whose numbers, joined, are the state and the action.

    pose: the same of the tool's pose, where actions are differences to it.
    tables: the columns that are read from the tables; images are among them only where they are stored there.
    """

    cameras: Mapping[str, str]
    state: tuple[str, ...]
    action: tuple[str, ...]
    pose: tuple[str, ...]
    tables: tuple[str, ...]


def find_columns(root: Path, features: Mapping[str, Mapping[str, Any]], robot: Embodiment) -> Columns:
    """Match a robot with a dataset."""
    spellings = {
        camera.name: [
            spelling
            for name in ((camera.key, camera.name) if camera.key else (camera.name,))
            for spelling in (name, f"observation.images.{name}")
        ]
        for camera in robot.cameras
    }
    spellings |= {key: [key, f"observation.{key}"] for key in (*robot.state.key, *robot.action.pose_key)}
    spellings |= {key: [key, *(_ACTION if key in _ACTION else ())] for key in robot.action.key}
    if not robot.state.key:
        spellings["state"] = ["observation.state", "state"]
    if not robot.action.key:
        spellings["action"] = [*_ACTION]
    matches = {key: next((name for name in names if name in features), None) for key, names in spellings.items()}
    keys = {camera.name: camera.key or camera.name for camera in robot.cameras}
    missing = [keys.get(name, name) for name, column in matches.items() if column is None]
    require(
        not missing,
        f"{root} lacks the feature{'s'[: len(missing) > 1]} {', '.join(missing)}; it has {listed(features)}. "
        f"These are the names of the robot {robot.name!r}: choose embodiment=<the robot this dataset is of>, or "
        "name its columns in a configs/embodiment file of your own. (RoboMME's poses and waypoints are columns of "
        "datasets that this library converts or records.)",
    )
    columns = {name: str(column) for name, column in matches.items()}
    cameras = {name: columns[name] for name in robot.camera_names}
    for name, column in cameras.items():
        require(
            features[column]["dtype"] in ("image", "video"),
            f"{root}: {column} holds {brief(features[column]['dtype'])}, no images: it cannot be the camera "
            f"{name!r} of the robot {robot.name!r} (embodiment.cameras.{name}.key).",
        )
    state = tuple(columns[key] for key in robot.state.key or ("state",))
    action = tuple(columns[key] for key in robot.action.key or ("action",))
    pose = tuple(columns[key] for key in robot.action.pose_key)
    vectors = {"state": (state, robot.state.width), "action": (action, robot.action.width)}
    for what, (names, width) in (vectors | ({"tool's pose": (pose, POSE_WIDTH)} if pose else {})).items():
        if sum(width_of(features[name]) for name in names) != width:
            shapes = ", ".join(f"{name} has shape {list(features[name]['shape'])}" for name in names)
            raise UserError(f"{root}: {shapes}; expected [{width}], the {what} of the robot {robot.name!r}.")
    tables = ["episode_index", *state, *action, *pose, *(name for name in OPTIONAL if name in features)]
    tables += [f"{name}{RENDERED_SUFFIX}" for name in cameras if f"{name}{RENDERED_SUFFIX}" in features]
    tables += [column for column in cameras.values() if features[column]["dtype"] == "image"]
    return Columns(cameras, state, action, pose, tuple(dict.fromkeys(tables)))


def width_of(feature: Mapping[str, Any]) -> int:
    """How many numbers a row of this feature holds."""
    shape = tuple(feature["shape"])
    return shape[0] if len(shape) == 1 else 0


def names_of(features: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """What a dataset calls the numbers of some features, joined; empty where one of them has no name for each number.

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
        f"No LeRobot dataset at {str(root)!r} (there is no {info}). Give its local folder, or 'sample'. From the "
        "hub: `hf download <owner>/<dataset> --repo-type dataset --local-dir <folder>`; from HDF5 files: "
        "`mme-vla convert input=<files> output=<folder>`.",
    )
    version = brief(read_info(path).get("codebase_version", "unknown"), quote=False)
    require(
        version.startswith("v3."),
        f"{path} is a LeRobot {version} dataset; v3.0 is needed. Convert it with LeRobot's own command: "
        f"`python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={path.name} --root={path} "
        "--push-to-hub=false`.",
    )
    for pattern in ("meta/tasks.parquet", "meta/episodes/*/*.parquet", "data/*/*.parquet"):
        if not any(path.glob(pattern)):
            raise UserError(f"{path} has no {pattern}: the dataset is incomplete. Copy, download or convert it again.")
    return path


def read_info(root: Path) -> dict[str, Any]:
    """Return `meta/info.json`: features with a `dtype` and a `shape`, frames per second, and others."""
    path = root / "meta" / "info.json"
    info = read_json(path, "a dataset's description")
    features = info.get("features")
    if not isinstance(features, dict) or not all(_is_feature(feature) for feature in features.values()):
        raise UserError(f"{path} does not describe its features by dtype and shape. Copy or download it again.")
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps <= 1000 or not math.isfinite(fps):
        raise UserError(f"{path}: fps is {brief(fps)}; expected frames per second, above 0 and at most 1000.")
    return {**info, "features": {name: {**f, "shape": tuple(f["shape"])} for name, f in features.items()}}


def lossy_coding(feature: dict[str, Any]) -> str | None:
    """The lossy codec of a video, such as `av1 at crf 30`; None for a lossless one, or without information.

    LeRobot writes what is known under `info`; its default before it wrote the quality was AV1 at crf 30.
    """
    about = feature.get("info")
    about = about if isinstance(about, dict) else {}
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
    """Read a side file of first execution frames, JSON {"0": 66, …} or parquet (episode_index, exec_start_idx).

    Returns:
        int64 [episodes].
    """
    expected = (
        'Expected JSON {"<episode_index>": <exec_start_idx>, …} or a parquet table with the columns episode_index and '
        "exec_start_idx, all whole numbers from 0."
    )
    require_file(file, "exec_starts, first execution frames")
    if file.suffix == ".json":
        entries = list(read_json(file, "first execution frames").items())
        pairs = [(int(key) if key.isdecimal() and len(key) < 10 else key, value) for key, value in entries]
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
        not lost, f"{file} covers no episode {lost[:5]}{'…' if len(lost) > 5 else ''}; it must name all {episodes}."
    )
    return np.array([table[episode] for episode in range(episodes)], np.int64)


def content_fingerprint(root: Path, parts: Sequence[str] = ("data", "videos", "meta/episodes")) -> str:
    """Hash what the dataset holds: names, sizes and 64 KB from the start, middle and end of every file in `parts`.

    Independent of the folder's place and of time stamps; reading whole videos would take minutes.
    """
    digest = sha256()
    for part in parts:
        for file in sorted((root / part).rglob("*")):
            if file.suffix not in (".parquet", ".mp4"):
                continue
            size = require_file(inside(root, file.relative_to(root).as_posix()), "a part of a dataset").stat().st_size
            digest.update(f"{file.relative_to(root).as_posix()} {size}\n".encode())
            with file.open("rb") as handle:
                for offset in (0, size // 2, max(size - 65536, 0)):
                    handle.seek(offset)
                    digest.update(handle.read(65536))
    return digest.hexdigest()[:16]


REMEDY = "Copy, download or convert the dataset again."
_MOST_FRAMES = 2**40  # of a dataset; a larger number is damage
_INTEGER_COLUMNS = ("episode_index", "is_demo", "exec_start_idx")
_FIELDS = {"video_key": ("",), "chunk_index": ("", "d", "03d"), "file_index": ("", "d", "03d")}


def parquet_files(root: Path, folder: str) -> list[Path]:
    """The parquet files of `folder`, two levels down as in LeRobot v3.0, in order."""
    return [require_file(path, "a parquet table") for path in sorted((root / folder).glob("*/*.parquet"))]


def read_episode_table(root: Path, video_views: Sequence[str]) -> dict[str, np.ndarray | list[str]]:
    """Read and check `meta/episodes`.

    Returns:
        `starts` and `lengths`, [e] int64 rows of the tables; `goals`, [e] texts, lower-case; and for every view
        `<view>/chunk_index`, `<view>/file_index` [e] int64 and `<view>/from_timestamp` [e] float64, seconds.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = [f"{view}/{key}" for view in video_views for key in ("chunk_index", "file_index")]
    times = [f"{view}/from_timestamp" for view in video_views]
    integers = ["episode_index", "dataset_from_index", "dataset_to_index", *(f"videos/{name}" for name in files)]
    fields = [(name, pa.int64()) for name in integers] + [(f"videos/{name}", pa.float64()) for name in times]
    schema, meta = pa.schema([*fields, ("tasks", pa.list_(pa.string()))]), root / "meta" / "episodes"
    with decoding(meta, "tables of episodes", REMEDY):
        parts = [pq.ParquetFile(file).read(schema.names) for file in parquet_files(root, "meta/episodes")]
        table = pa.concat_tables([part.select(schema.names).cast(schema) for part in parts])
        empty = [name for name in schema.names if table[name].null_count]
        columns = {name: table[name].to_numpy() for name, _ in fields}
        tasks = [texts[0] if texts else None for texts in table["tasks"].to_pylist()]
    require(
        not empty and table.num_rows,
        f"{meta} describes {table.num_rows} episodes; empty cells in: {listed(empty) or 'none'}. {REMEDY}",
    )
    starts, stops = columns["dataset_from_index"], columns["dataset_to_index"]
    checks = {
        "episode_index": (columns["episode_index"] == np.arange(len(starts)), "0, 1, 2, …"),
        "dataset_from_index": (starts == np.concatenate([[0], stops[:-1]]), "the row after the episode before"),
        "dataset_to_index": ((stops > starts) & (stops <= _MOST_FRAMES), "at least one row"),
        "tasks": (np.array([isinstance(task, str) for task in tasks]), "a text"),
        **{f"videos/{n}": (((v := columns[f"videos/{n}"]) >= 0) & (v <= _MOST_FRAMES), "a number") for n in files},
        **{f"videos/{n}": (np.isfinite(v := columns[f"videos/{n}"]) & (v >= 0), "seconds from 0") for n in times},
    }
    for name, (valid, expected) in checks.items():
        if not valid.all():
            episode = int(np.argmin(valid))
            value = brief(columns[name][episode].item() if name in columns else tasks[episode])
            raise UserError(f"{meta}: {name} of episode {episode} is {value}; expected {expected}. {REMEDY}")
    named = {name: columns[f"videos/{name}"] for name in (*files, *times)}
    return {"starts": starts, "lengths": stops - starts, "goals": [str(task).lower() for task in tasks], **named}


def open_table(root: Path, columns: Sequence[str], features: dict[str, Any]) -> Any:
    """Memory-map these columns of all tables, as LeRobot does, through the cache folder of the `datasets` library."""
    from lerobot.utils.utils import SuppressProgressBars

    from datasets import Dataset, Features

    for name in _INTEGER_COLUMNS:
        if name in columns and not features[name]["dtype"].startswith(("int", "uint", "bool")):
            raise UserError(f"{root}: {name} is {brief(features[name]['dtype'])}; expected whole numbers. {REMEDY}")
    with decoding(root / "meta" / "info.json", "a description of features", REMEDY):
        target = Features({name: _kind(**features[name]) for name in columns})
    large = any(features[name]["dtype"] == "image" for name in columns)
    files = [str(file) for file in parquet_files(root, "data")]
    with decoding(root / "data", "tables of frames", REMEDY), nullcontext() if large else SuppressProgressBars():
        table = Dataset.from_parquet(files, columns=list(columns), features=target)
    return table.with_format("arrow")


def _kind(dtype: str, shape: tuple[int, ...], **_: Any) -> Any:
    """What `datasets` calls such a feature. LeRobot could say it, at the price of four seconds for importing it."""
    import datasets

    if dtype == "image":
        return datasets.Image()
    if shape == (1,):
        return datasets.Value(dtype)
    if len(shape) == 1:
        return datasets.List(datasets.Value(dtype), length=shape[0])
    return getattr(datasets, f"Array{len(shape)}D")(shape=shape, dtype=dtype)


def check_vectors(root: Path, table: Any, name: str, width: int) -> None:
    """Make sure that every row of a column is `width` finite numbers; one alone may stand without a list around it."""
    import pyarrow as pa
    import pyarrow.compute as pc

    first, list_kinds = 0, (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    for chunk in table.data[name].chunks:
        # Counting is not enough: rows of 7 and 9 numbers have 8 on average.
        listed = any(is_kind(chunk.type) for is_kind in list_kinds)
        lengths = pc.list_value_length(chunk).fill_null(-1).to_numpy(zero_copy_only=False) if listed else width
        wrong = np.broadcast_to(lengths != width, len(chunk))
        if not wrong.any():
            numbers = chunk.flatten() if listed else chunk
            values = numbers.to_numpy(zero_copy_only=False).reshape(-1, width)  # nulls become NaN
            wrong = ~np.isfinite(values).all(axis=1)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            value = brief(chunk[row].as_py())
            raise UserError(f"{root}: row {first + row} has {name} {value}; expected {width} finite numbers. {REMEDY}")
        first += len(chunk)


def video_file(root: Path, template: object, view: str, chunk: int, file: int) -> Path:
    """The place of a video: `video_path` of meta/info.json, filled in."""
    info = root / "meta" / "info.json"
    try:
        fields = [
            (name, spec or "") for _, name, spec, _ in string.Formatter().parse(str(template)) if name is not None
        ]
    except ValueError:
        fields = [("", "")]
    if not isinstance(template, str) or any(spec not in _FIELDS.get(name, ()) for name, spec in fields):
        raise UserError(
            f"{info}: video_path is {brief(template)}; expected a path with the fields {{video_key}}, "
            f"{{chunk_index:03d}} and {{file_index:03d}}. {REMEDY}"
        )
    return inside(root, template.format(video_key=view, chunk_index=chunk, file_index=file), "video")
