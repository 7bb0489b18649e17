"""What `meta/` says of the episodes of a LeRobot v3.0 dataset: their rows, images and tasks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.lerobot_files import REMEDY, Info, parquet_files
from mme_vla.errors import UserError, brief, counted, listed, require
from mme_vla.utils import decoding

_MOST_FRAMES = 2**40  # of a dataset; a larger number is damage


@dataclass(frozen=True)
class VideoSpans:
    """Where the images of each episode lie in the video files of a column, [e] each.

    chunk, file: numbers of the file, int64.
    begin, end: seconds, float64; `end` may be missing.
    """

    chunk: np.ndarray
    file: np.ndarray
    begin: np.ndarray
    end: np.ndarray | None


@dataclass(frozen=True)
class Description:
    """A dataset as `meta/info.json` and `meta/episodes` describe it.

    root: its folder.
    info: meta/info.json.
    starts, lengths: [e] int64, the first row of each episode and its frames.
    tasks: [e], those listed for each episode, none where they are not listed.
    declared_lengths: the lengths once more, where they are written.
    videos: of the cameras that are videos, by column.
    images: columns of the cameras that are stored in the tables.
    """

    root: Path
    info: Info
    starts: np.ndarray
    lengths: np.ndarray
    tasks: list[tuple[str, ...]]
    declared_lengths: np.ndarray | None
    videos: Mapping[str, VideoSpans]
    images: Sequence[str]

    def place(self, row: int) -> str:
        """A row in words, by its episode and frame."""
        episode = int(np.searchsorted(self.starts, row, side="right")) - 1
        return f"row {row}, frame {row - int(self.starts[episode])} of episode {episode}"


def read_description(
    root: Path, info: Info, video_columns: Sequence[str], image_columns: Sequence[str]
) -> Description:
    """Read and check `meta/episodes`.

    Raises:
        UserError: a column is missing, or a value that cannot be; it names the episode.
    """
    meta = root / "meta" / "episodes"
    columns, cells = _read_episode_columns(root, meta, video_columns)
    videos: dict[str, VideoSpans] = {}
    for column in video_columns:
        name = f"videos/{column}"
        videos[column] = VideoSpans(
            columns[f"{name}/chunk_index"],
            columns[f"{name}/file_index"],
            columns[f"{name}/from_timestamp"],
            columns.get(f"{name}/to_timestamp"),
        )
    for name, (valid, expected) in _validity(columns, videos).items():
        if not valid.all():
            episode = int(np.argmin(valid))
            value = brief(columns[name][episode].item())
            raise UserError(
                f"{meta}: {name} of episode {episode} is {value}; expected {expected}. {REMEDY}"
            )
    starts, stops = columns["dataset_from_index"], columns["dataset_to_index"]
    # LeRobot writes a list of texts; one text alone, an empty list or nothing is read too.
    tasks: list[tuple[str, ...]] = []
    for episode, cell in enumerate(cells):
        texts = cell if isinstance(cell, list) else [cell]
        if cell is None:
            texts = []
        if not all(isinstance(text, str) for text in texts):
            raise UserError(
                f"{meta}: tasks of episode {episode} is {brief(cell)}; expected a list of texts."
                f" {REMEDY}"
            )
        tasks.append(tuple(texts))
    lengths, declared = stops - starts, columns.get("length")
    return Description(root, info, starts, lengths, tasks, declared, videos, image_columns)


def _read_episode_columns(
    root: Path, meta: Path, video_columns: Sequence[str]
) -> tuple[dict[str, np.ndarray], list[Any]]:
    """The numbers of `meta/episodes` by column, [e] each, and its cells of tasks, unchecked."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = dict.fromkeys(("episode_index", "dataset_from_index", "dataset_to_index"), pa.int64())
    optional = {"length": pa.int64()}
    for column in video_columns:
        kinds[f"videos/{column}/chunk_index"] = pa.int64()
        kinds[f"videos/{column}/file_index"] = pa.int64()
        kinds[f"videos/{column}/from_timestamp"] = pa.float64()
        optional[f"videos/{column}/to_timestamp"] = pa.float64()
    with decoding(meta, "tables of episodes", REMEDY):
        files = [pq.ParquetFile(file) for file in parquet_files(root, "meta/episodes")]
        present = set.intersection(*(set(file.schema_arrow.names) for file in files))
    missing = [name for name in kinds if name not in present]
    if missing:
        others = sorted(name for name in present if not name.startswith("stats/"))
        raise UserError(
            f"{meta} lacks {listed(missing)}, which LeRobot writes in every dataset of version"
            f" v3.0. It has {listed(others)}."
        )
    kinds |= {name: kind for name, kind in optional.items() if name in present}

    parts = []
    cells: list[Any] = []
    with decoding(meta, "tables of episodes", REMEDY):
        for file in files:
            if "tasks" in present:
                part = file.read([*kinds, "tasks"])
                cells += part["tasks"].to_pylist()
            else:
                part = file.read([*kinds])
                cells += [None] * part.num_rows
            parts.append(part.select(list(kinds)).cast(pa.schema(list(kinds.items()))))
        table = pa.concat_tables(parts)
        empty = [
            f"{name} in row {table[name].is_null().index(True).as_py()}"
            for name in kinds
            if table[name].null_count
        ]
        columns = {name: table[name].to_numpy() for name in kinds}
    require(
        not empty and table.num_rows,
        f"{meta} describes {counted(table.num_rows, 'episode')}; empty cells in:"
        f" {listed(empty) or 'none'}. {REMEDY}",
    )
    return columns, cells


def _validity(
    columns: Mapping[str, np.ndarray], videos: Mapping[str, VideoSpans]
) -> dict[str, tuple[np.ndarray, str]]:
    """By column of `meta/episodes`: which episodes' values can be, bool [e], and what they are."""
    numbers = columns["episode_index"]
    starts, stops = columns["dataset_from_index"], columns["dataset_to_index"]
    before = np.concatenate([[0], stops[:-1]])
    checks = {
        "episode_index": (numbers == np.arange(len(numbers)), "0, 1, 2, …"),
        "dataset_from_index": (starts == before, "the row after the episode before"),
        "dataset_to_index": ((stops > starts) & (stops <= _MOST_FRAMES), "at least one row"),
    }
    for column, spans in videos.items():
        for key, values in (("chunk_index", spans.chunk), ("file_index", spans.file)):
            is_number = (values >= 0) & (values <= _MOST_FRAMES)
            checks[f"videos/{column}/{key}"] = (is_number, "a number")
        is_time = np.isfinite(spans.begin) & (spans.begin >= 0)
        checks[f"videos/{column}/from_timestamp"] = (is_time, "seconds from 0")
    return checks
