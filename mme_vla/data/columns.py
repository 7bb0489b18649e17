"""Further columns of a dataset: labels and weights of samples."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch

from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.lerobot_files import FACTS, parquet_files
from mme_vla.errors import UserError, brief, check_known, listed, require
from mme_vla.types import HistoryTokens, Labels

BOUNDARY = "subtask_boundary"
"""The label that is 1 at the first frame of every sub-task and 0 elsewhere, from the column
`simple_subgoal`.
"""
SUBTASK = "subtask_index"
"""The label that counts the sub-tasks that have begun in an episode so far, from 1."""
FACT = "fact_index"
"""The label that counts the facts that an episode has begun to show so far, from the dataset's
table of facts.
"""
FACT_VISIBLE = "fact_visible"
"""The label that is 1 at frames that show a fact and 0 elsewhere."""


def with_labels(
    selection: HistoryTokens,
    labels: Mapping[str, np.ndarray],
    real: np.ndarray | None = None,
) -> HistoryTokens:
    """A selection, unbatched, with the labels of each token's frame.

    labels: name → values [t] or [t, k] float32 of an episode's frames.
    real: the recorded frame of each frame of a transformed episode (`FrameMap.real`).
    """
    frames = (selection.positions[:, 0] * selection.mask).numpy().astype(np.int64)
    if real is not None:
        frames = real[frames]
    tokens = Labels()
    for name, of_frames in labels.items():
        values = torch.from_numpy(of_frames[frames])
        tokens[name] = values * selection.mask.view(-1, *[1] * (values.ndim - 1))
    return replace(selection, labels=tokens)


def label_column(source: EpisodeSource, name: str, key: str) -> np.ndarray:
    """A label of every frame of a dataset, [rows] or [rows, k] float32.

    A column of numbers, `subtask_boundary`, `subtask_index`, `fact_index`, or `fact_visible`.

    Args:
        key: what names the column, for messages (`data.weights`).

    Raises:
        UserError: no such column, or a value that is missing, not finite or of another size; it
            names the episode. No table of facts, or one that contradicts the dataset.
    """
    if name == BOUNDARY:
        return _boundaries(source, name)
    if name == SUBTASK:
        return _counts(source, _boundaries(source, name))
    if name in (FACT, FACT_VISIBLE):
        begins, is_visible = _facts(source, key)
        return _counts(source, begins) if name == FACT else is_visible
    column = _read(source, name, key)
    values = column.combine_chunks()
    nested = (
        pa.types.is_list(values.type)
        or pa.types.is_large_list(values.type)
        or pa.types.is_fixed_size_list(values.type)
    )
    kind = values.type.value_type if nested else values.type
    require(
        pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind),
        f"{key}: the column {name!r} of {source.name} holds {kind}: a label needs numbers.",
    )
    _check(source, name, key, values.is_null().to_numpy(zero_copy_only=False), "has no value")
    if nested:
        sizes = pc.list_value_length(values).to_numpy(zero_copy_only=False)
        width = max(int(np.bincount(sizes).argmax()), 1)
        _check(source, name, key, sizes != width, f"does not hold {width} numbers")
        exact = values.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
    else:
        exact = values.to_numpy(zero_copy_only=False)
    numbers = exact.astype(np.float32)
    wrong = ~np.isfinite(numbers)
    _check(source, name, key, wrong.any(1) if nested else wrong, "is missing or not finite")
    if pa.types.is_integer(kind):
        with np.errstate(invalid="ignore"):  # beyond the integers' own range
            lost = numbers.astype(exact.dtype) != exact
        problem = "holds a whole number that float32 cannot (beyond 2**24)"
        _check(source, name, key, lost.any(1) if nested else lost, problem)
    return numbers


def weight_column(source: EpisodeSource, name: str) -> np.ndarray:
    """The weight of every frame of a dataset, [rows] float32, 0 or more (`data.weights`)."""
    weights = label_column(source, name, "data.weights")
    require(
        weights.ndim == 1,
        f"data.weights: the column {name!r} of {source.name} needs one number a frame.",
    )
    _check(source, name, "data.weights", weights < 0, "is negative")
    require(
        weights.any(),
        f"data.weights: the column {name!r} of {source.name} is 0 at every frame (float32): nothing"
        " would be learned from it. Leave the dataset out, or correct the column.",
    )
    return weights


def _read(source: EpisodeSource, name: str, key: str) -> Any:
    files = parquet_files(source.root, "data")
    schemas = [set(pq.read_schema(file).names) for file in files]
    check_known(f"column of {source.name} ({key})", name, set.intersection(*schemas))
    tables = [pq.read_table(file, columns=[name]) for file in files]
    kinds = {str(table.schema.field(name).type) for table in tables}
    require(
        len(kinds) == 1,
        f"{key}: the column {name!r} of {source.name} holds {' and '.join(sorted(kinds))} in"
        " different files of data/. Write it with one type.",
    )
    return pa.concat_tables(tables)[name]


def text_column(source: EpisodeSource, name: str, key: str) -> Any:
    """A column of texts of a dataset, [rows] of arrow.

    Raises:
        UserError: no such column, another kind, or a text that is missing or empty in an execution;
            it names the episode.
    """
    texts = _read(source, name, key).combine_chunks()
    require(
        pa.types.is_string(texts.type) or pa.types.is_large_string(texts.type),
        f"{key}: the column {name!r} of {source.name} holds {texts.type}, no texts.",
    )
    is_empty = pc.equal(pc.utf8_length(pc.utf8_trim_whitespace(texts)), 0).fill_null(True)
    first_rows = source.starts + source.exec_starts
    frames = np.arange(len(texts))
    is_executed = frames >= np.repeat(first_rows, source.lengths)
    is_empty = is_empty.to_numpy(zero_copy_only=False) & is_executed
    _check(source, name, key, is_empty, "has no text")
    return texts


def _boundaries(source: EpisodeSource, label: str) -> np.ndarray:
    """The first frames of sub-tasks, [rows] float32: where the text of `simple_subgoal` changes."""
    try:
        subgoals = text_column(source, "simple_subgoal", f"the label {label}")
    except UserError as error:
        if not (source.root / FACTS).is_file():
            raise
        raise UserError(
            f"{error} {source.name} has facts: the label {FACT} counts them"
            f" (memory.label={FACT} for memory=keyframes)."
        ) from None
    codes = subgoals.fill_null("").dictionary_encode().indices.to_numpy()
    begins = np.concatenate([[True], np.diff(codes) != 0])
    begins[source.starts] = True
    return begins.astype(np.float32)


def _counts(source: EpisodeSource, begins: np.ndarray) -> np.ndarray:
    """How many have begun in its episode up to each frame, itself included, [rows] float32.

    begins: how many begin at each frame, [rows].
    """
    begun = np.cumsum(begins)
    before = begun[source.starts] - begins[source.starts]
    return (begun - np.repeat(before, source.lengths)).astype(np.float32)


def _facts(source: EpisodeSource, key: str) -> tuple[np.ndarray, np.ndarray]:
    """How many facts each frame is the first to show, and whether it shows any, [rows] float32."""
    path = source.root / FACTS
    require(
        path.is_file(),
        f"{key}: {source.name} has no {FACTS}. `mme-vla record` writes it with a dataset.",
    )
    kinds = {"episode": np.int64, "from": np.int64, "to": np.int64, "task": str, "fact": str}
    try:
        table = pd.read_csv(path, usecols=list(kinds), dtype=kinds, keep_default_na=False)
    except (ValueError, OverflowError) as error:
        raise UserError(f"{key}: {path} is no table of facts: {brief(error)}.") from None
    begins = np.zeros(source.lengths.sum(), np.float32)
    is_visible = np.zeros_like(begins)
    spans: dict[tuple[int, str], list[tuple[int, int]]] = {}
    rows = table[list(kinds)].itertuples(index=False)
    for line, (episode, first, last, task, fact) in enumerate(rows, start=2):
        require(
            0 <= episode < len(source.lengths) and 0 <= first <= last < source.lengths[episode],
            f"{key}: line {line} of {path} has a fact at frames {first} to {last} of episode"
            f" {episode}, which {source.name} does not have. Record the dataset again.",
        )
        known = source.task(episode)
        require(
            not known or task == known,
            f"{key}: line {line} of {path} is of the task {brief(task)}; episode {episode} of"
            f" {source.name} is one of {known}. Record the dataset again.",
        )
        earlier = spans.setdefault((episode, fact), [])
        require(
            not any(first <= end and begin <= last for begin, end in earlier),
            f"{key}: line {line} of {path} has the fact {brief(fact)} at frames {first} to {last}"
            f" of episode {episode}, where an earlier line has it too. Record the dataset again.",
        )
        earlier.append((first, last))
        start = source.starts[episode]
        begins[start + first] += 1
        is_visible[start + first : start + last + 1] = 1
    return begins, is_visible


def _check(source: EpisodeSource, name: str, key: str, wrong: np.ndarray, problem: str) -> None:
    """Raise an error that names the first frame, and the episodes, of rows that are wrong, [rows]
    bool.
    """
    rows = np.flatnonzero(wrong)
    if not len(rows):
        return
    episode, frame = source.locate(int(rows[0]))
    episodes = (np.unique(np.searchsorted(source.starts, rows, side="right")) - 1).tolist()
    noun = "episode" if len(episodes) == 1 else "episodes"
    raise UserError(
        f"{key}: the column {name!r} of {source.name} {problem} at frame {frame} of episode"
        f" {episode} (in all: {noun} {listed(episodes)}). Correct the column."
    )
