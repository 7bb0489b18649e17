"""The tables of a LeRobot v3.0 dataset: one row a frame."""

import sys
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.lerobot_files import REMEDY, Feature, content_fingerprint, parquet_files
from mme_vla.errors import UserError, brief, counted, listed, require
from mme_vla.utils import decoding, file_sum, user_cache

INDEX_COLUMNS = ("episode_index", "frame_index", "timestamp", "index", "task_index")
"""What LeRobot writes of every row beside the recorded values."""


def read_index_columns(
    root: Path, features: Mapping[str, Feature], flags: Sequence[str]
) -> dict[str, np.ndarray]:
    """The columns that say which row is which, each [rows]: int64, and `timestamp` float64; those
    that all files have.

    Args:
        features: what info.json declares.
        flags: further columns of one whole number a row, read where they are declared.

    Raises:
        UserError: a file lacks a declared flag, or a column holds something else than one number a
            row.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    declared = [name for name in flags if name in features]
    for name in ("episode_index", *declared):
        if name in features:
            kind = features[name].dtype
            require(
                kind.startswith(("int", "uint", "bool")),
                f"{root}: {name} is {brief(kind)}; expected whole numbers. {REMEDY}",
            )

    files = parquet_files(root, "data")
    with decoding(root / "data", "tables of frames", REMEDY):
        opened = [pq.ParquetFile(file) for file in files]
        there = set.intersection(*(set(file.schema_arrow.names) for file in opened))
        names = [name for name in (*INDEX_COLUMNS, *declared) if name in there]
        table = pa.concat_tables([file.read(names) for file in opened])
    lost = [name for name in declared if name not in there]
    require(
        not lost,
        f"{root}: meta/info.json declares {listed(lost)}, which not every file in data/ has."
        f" {REMEDY}",
    )

    columns = {}
    for name in names:
        values = table[name]
        with decoding(root / "data", f"numbers ({name})", REMEDY):
            # One number may stand in a list of its own.
            if pa.types.is_nested(values.type):
                sizes = pc.list_value_length(values).fill_null(1)
                require(
                    pc.all(pc.equal(sizes, 1)).as_py(),
                    f"{root}: {name} holds lists; expected one number a row. {REMEDY}",
                )
            numbers = flat(values)
            missing = max(values.null_count, numbers.null_count)
            require(
                not missing, f"{root}: {name} is missing in {counted(missing, 'row')}. {REMEDY}"
            )
            require(
                len(numbers) == table.num_rows,
                f"{root}: {name} has {counted(len(numbers), 'number')} in"
                f" {counted(table.num_rows, 'row')}. {REMEDY}",
            )
            target = pa.float64() if name == "timestamp" else pa.int64()
            columns[name] = numbers.cast(target).to_numpy(zero_copy_only=False)
    return columns


def open_table(root: Path, columns: Sequence[str], features: Mapping[str, Feature]) -> Any:
    """Memory-map these columns of all tables, through the `datasets` library as LeRobot does.

    Its copy of the tables lies in a folder that is named after their content: the library itself
    tells them by path and time stamp, which copies and archives may keep while the content is
    another.
    """
    import pyarrow.parquet as pq
    from lerobot.utils.utils import SuppressProgressBars

    from datasets import Dataset, Features

    with decoding(root / "meta" / "info.json", "a description of features", REMEDY):
        target = Features({name: _kind(features[name]) for name in columns})
    large = any(features[name].dtype == "image" for name in columns)
    files = parquet_files(root, "data")
    # Every number but 0 would become true without a word.
    flags = [name for name in columns if features[name].dtype == "bool"]
    for file in files if flags else ():
        with decoding(file, "a table of frames", REMEDY):
            schema = pq.read_schema(file)
        for name in flags:
            kind = str(schema.field(name).type)
            require(
                "bool" in kind,
                f"{root}: {name} is bool in meta/info.json, but {file.name} holds {kind}. Correct"
                " the one that is wrong.",
            )
    # A digest of all content, or, where images make it large, of its fingerprint and the times of
    # change (ctime), which the system sets whenever content is written; no program can keep them.
    digest = sha256()
    if large:
        digest.update(content_fingerprint(root, ("data",)).encode())
    for file in files:
        content = str(file.stat().st_ctime_ns) if large else file_sum(file)
        digest.update(f"{file.relative_to(root).as_posix()} {content}\n".encode())
    folder = user_cache("tables") / digest.hexdigest()[:16]
    if large and not folder.exists() and sys.stderr.isatty():
        print(f"{root}: copying the images once to {folder} …", file=sys.stderr, flush=True)
    with decoding(root / "data", "tables of frames", REMEDY), SuppressProgressBars():
        table = Dataset.from_parquet(
            [str(file) for file in files],
            columns=list(columns),
            features=target,
            cache_dir=str(folder),
        )
    return table.with_format("arrow")


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


def _kind(feature: Feature) -> Any:
    """What `datasets` calls such a feature. LeRobot could say it, at the price of four seconds for
    importing it.
    """
    import datasets

    if feature.dtype == "image":
        return datasets.Image()
    if feature.shape == (1,):
        return datasets.Value(feature.dtype)
    if len(feature.shape) == 1:
        return datasets.List(datasets.Value(feature.dtype), length=feature.shape[0])
    array = getattr(datasets, f"Array{len(feature.shape)}D")
    return array(shape=feature.shape, dtype=feature.dtype)


def check_vectors(root: Path, table: Any, name: str, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Make sure that every row of a column is `width` finite numbers; one alone may stand without a
    list around it.

    Returns:
        The least and the greatest of each number, [width] float64.
    """
    least = np.full(width, np.inf)
    greatest = np.full(width, -np.inf)
    first = 0
    for chunk in table.data[name].chunks:
        wrong = chunk.is_null().to_numpy(zero_copy_only=False)
        if not wrong.any():
            numbers = flat(chunk).to_numpy(zero_copy_only=False)  # nulls become NaN
            values = numbers.reshape(-1, width)
            with np.errstate(over="ignore"):
                is_finite = np.isfinite(values.astype(np.float32))  # as policies read them
            wrong = ~is_finite.all(axis=1)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            numbers = chunk[row].as_py()
            value = brief(numbers)
            if isinstance(numbers, list):
                number = int(np.argmin(is_finite[row]))  # the first that is not
                value = f"{values[row, number]} for number {number + 1}"
            raise UserError(
                f"{root}: row {first + row} has {name} {value}; expected {width} finite numbers"
                f" within float32 (to 3.4e38). {REMEDY}"
            )
        if len(chunk):
            least = np.minimum(least, values.min(axis=0))
            greatest = np.maximum(greatest, values.max(axis=0))
        first += len(chunk)
    return least, greatest
