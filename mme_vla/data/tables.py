"""The tables of a LeRobot dataset, opened and looked through before anything is made of them.

LeRobot's own reader is not asked: it takes a file that it cannot open for one that has to be fetched from the hub.
"""

import string
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.hdf5_episode import SUBGOALS
from mme_vla.errors import UserError, brief
from mme_vla.utils import decoding, inside, require_file

REMEDY = "Copy, download or convert the dataset again."
_MOST_FRAMES = 2**40  # of a dataset; a larger number is damage
_INTEGER_COLUMNS = (
    "episode_index",
    "is_demo",
    "exec_start_idx",
)  # columns of whole numbers or flags, whatever is announced
_FIELDS = {"video_key": ("",), "chunk_index": ("", "d", "03d"), "file_index": ("", "d", "03d")}


def parquet_files(root: Path, folder: str) -> list[Path]:
    """The parquet files of `folder`, two levels down as in LeRobot v3.0, in order."""
    return [require_file(path, "a parquet table") for path in sorted((root / folder).glob("*/*.parquet"))]


def read_episode_table(root: Path, video_views: Sequence[str]) -> dict[str, np.ndarray | list[str]]:
    """What `meta/episodes` says of every episode.

    Returns:
        `starts` and `lengths`, [e] int64 rows of the tables; `goals`, [e] texts, lower-case; and for every view
        `<view>/chunk_index`, `<view>/file_index` [e] int64 and `<view>/from_timestamp` [e] float64, seconds.
    """
    import pyarrow as pa

    integers = ["episode_index", "dataset_from_index", "dataset_to_index"]
    places = {f"{view}/{key}": f"videos/{view}/{key}" for view in video_views for key in ("chunk_index", "file_index")}
    times = {f"{view}/from_timestamp": f"videos/{view}/from_timestamp" for view in video_views}
    kinds = dict.fromkeys([*integers, *places.values()], pa.types.is_integer)
    kinds |= dict.fromkeys(times.values(), pa.types.is_floating)
    tables = [_read_columns(file, {**kinds, "tasks": _is_list}) for file in parquet_files(root, "meta/episodes")]
    meta = root / "meta" / "episodes"
    with decoding(meta, "tables of episodes", REMEDY):
        table = pa.concat_tables(tables, promote_options="permissive").combine_chunks()
        columns = {name: table[name].to_numpy() for name in kinds}
        tasks = table["tasks"].to_pylist()
    starts, stops = columns["dataset_from_index"].astype(np.int64), columns["dataset_to_index"].astype(np.int64)
    if not np.array_equal(columns["episode_index"], np.arange(len(starts))) or not len(starts):
        raise UserError(f"{meta} does not number its episodes 0, 1, 2, …; it describes {len(starts)}. {REMEDY}")
    if (starts < 0).any() or (stops > _MOST_FRAMES).any() or (stops <= starts).any():
        episode = int(np.flatnonzero((starts < 0) | (stops > _MOST_FRAMES) | (stops <= starts))[0])
        raise UserError(
            f"{meta}: episode {episode} reaches from row {starts[episode]} to row {stops[episode]}; expected at least "
            f"one row. {REMEDY}"
        )
    if starts[0] != 0 or not np.array_equal(starts[1:], stops[:-1]):
        raise UserError(f"{meta} does not describe its episodes back to back, from row 0 on. {REMEDY}")
    goals = [texts[0] if isinstance(texts, list) and texts else None for texts in tasks]
    if not all(isinstance(goal, str) for goal in goals):
        episode = next(i for i, goal in enumerate(goals) if not isinstance(goal, str))
        raise UserError(f"{meta}: episode {episode} has no task in words. {REMEDY}")
    for name in places.values():
        if (columns[name] < 0).any() or (columns[name] > _MOST_FRAMES).any():
            raise UserError(f"{meta}: {name} holds {columns[name].min()}; expected whole numbers from 0. {REMEDY}")
    for name in times.values():
        if not np.isfinite(columns[name]).all() or (columns[name] < 0).any():
            raise UserError(f"{meta}: {name} holds a time that is no number of seconds from 0. {REMEDY}")
    named = {name: columns[column] for name, column in {**places, **times}.items()}
    return {"starts": starts, "lengths": stops - starts, "goals": [str(goal).lower() for goal in goals], **named}


def open_table(root: Path, columns: Sequence[str], features: dict[str, Any]) -> Any:
    """Memory-map these columns of all tables, as LeRobot does, through the cache folder of the `datasets` library."""
    from lerobot.utils.utils import SuppressProgressBars

    from datasets import Dataset, Features

    with decoding(root / "meta" / "info.json", "a description of features", REMEDY):
        target = Features({name: _kind(**features[name]) for name in columns})
    large = any(features[name]["dtype"] == "image" for name in columns)
    files = parquet_files(root, "data")
    for file in files:
        _check_schema(file, columns, features)
    with decoding(root / "data", "tables of frames", REMEDY), nullcontext() if large else SuppressProgressBars():
        table = Dataset.from_parquet([str(file) for file in files], columns=list(columns), features=target)
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
    import pyarrow.compute as pc

    first = 0
    for chunk in table.data[name].chunks:
        # Counting is not enough: rows of 7 and 9 numbers have 8 on average.
        listed = _is_list(chunk.type)
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


def _read_columns(file: Path, kinds: dict[str, Any]) -> Any:
    import pyarrow.parquet as pq

    with decoding(file, "a table of episodes", REMEDY), pq.ParquetFile(file) as opened:
        schema = opened.schema_arrow
    for name, right in kinds.items():
        if name not in schema.names or not right(schema.field(name).type):
            kind = schema.field(name).type if name in schema.names else "absent"
            raise UserError(f"{file}: the column {name} is {kind}, which is not LeRobot v3.0. {REMEDY}")
    with decoding(file, "a table of episodes", REMEDY), pq.ParquetFile(file) as opened:
        table = opened.read(columns=list(kinds))
    for name in kinds:
        if table[name].null_count:
            raise UserError(f"{file}: the column {name} has empty cells. {REMEDY}")
    return table


def _check_schema(file: Path, columns: Sequence[str], features: dict[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    with decoding(file, "a table of frames", REMEDY), pq.ParquetFile(file) as opened:
        schema = opened.schema_arrow
    for name in columns:
        kind = schema.field(name).type if name in schema.names else None
        inner = kind.value_type if kind is not None and _is_list(kind) else kind
        if features[name]["dtype"] == "image":
            right = kind is not None and (pa.types.is_struct(kind) or pa.types.is_binary(kind))
        elif name in SUBGOALS:
            right = inner is not None and (pa.types.is_string(inner) or pa.types.is_large_string(inner))
        elif len(features[name]["shape"]) == 1 and features[name]["shape"][0] > 1:
            right = kind is not None and _is_list(kind) and _is_number(inner)
        elif name not in _INTEGER_COLUMNS and features[name]["dtype"] != "bool":
            right = inner is not None and _is_number(inner)
        else:
            right = inner is not None and (pa.types.is_integer(inner) or pa.types.is_boolean(inner))
        if not right:
            raise UserError(
                f"{file}: the column {name} is {kind or 'absent'}, where meta/info.json announces "
                f"{brief(features[name]['dtype'])} {list(features[name]['shape'])}. {REMEDY}"
            )


def _is_number(kind: Any) -> bool:
    import pyarrow as pa

    return pa.types.is_floating(kind) or pa.types.is_integer(kind)


def _is_list(kind: Any) -> bool:
    import pyarrow as pa

    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
