"""Scenes as rows of values: the 800 of RoboMME-OOD, and files of a user's own. Importing this needs
no simulator.

A file has one JSON object a line: `task`, `spec` (the values, see `scene/values.py`), and
optionally `seed`, `difficulty`, `recovery`, `in_view` (as `split=twin`) and `tier`, which brings
the rules of RoboMME-OOD. Other keys, such as `episode`, are kept and have no effect.
`env.scene_values()` gives the row of any scene.
"""

import json
import lzma
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypedDict

from mme_vla.errors import UserError, brief, did_you_mean, require
from mme_vla.utils import parse_json, read_text

Row = dict[str, Any]
OOD = "ood"
"""The split of RoboMME-OOD; `ood:xhard3` has the episodes of one tier."""
DIFFICULTIES = ("easy", "medium", "hard")
TIERS = tuple(f"xhard{i}" for i in range(1, 6))
SUFFIX = ".jsonl"
_TIER = re.compile(rf"{OOD}(?::(.+))?")
_PARTS = ("layout", "objects", "actions", "initializations")
_OPTIONAL: dict[str, tuple[Any, ...]] = {
    "difficulty": DIFFICULTIES, "recovery": ("z", "xy", None), "in_view": (True, False),
}  # fmt: skip


def is_row_split(split: str) -> bool:
    """Whether the scenes of a split are given as values."""
    return _TIER.fullmatch(split) is not None or split.endswith(SUFFIX)


def rows_of(task: str, split: str, known: tuple[str, ...]) -> list[Row]:
    """The rows of a task in a split, in order; none where the split has none of the task.

    Args:
        task: name of a task.
        split: `ood`, `ood:<tier>`, or the path of a JSONL file.
        known: names of all tasks.

    Raises:
        UserError: an unknown tier, or a file that cannot be read.
    """
    match = _TIER.fullmatch(split)
    if match is None:
        path = Path(split).expanduser()
        require(
            path.is_file(),
            f"split={split}: there is no such file. Name a JSONL file of scenes, one object a"
            " line.",
        )
        return list(_read_file(str(path), path.stat().st_mtime_ns, known).get(task, []))
    tier = match[1]
    rows = _ood().get(task, [])
    if tier is None:
        return list(rows)
    require(
        tier in TIERS,
        f"split={split!r}: there is no tier {tier!r}. {did_you_mean(tier, TIERS)}",
    )
    return [row for row in rows if row["tier"] == tier]


@cache
def _ood() -> dict[str, list[Row]]:
    packed = files("mme_vla").joinpath("assets", "robomme_metadata", "ood.jsonl.xz").read_bytes()
    return _by_task(map(json.loads, lzma.decompress(packed).decode().splitlines()))


@cache
def _read_file(path: str, modified: int, known: tuple[str, ...]) -> dict[str, list[Row]]:
    """Rows by task. modified: time of the last change, so that a changed file is read again."""
    text = read_text(Path(path), "scenes").replace("\r", "\n")
    rows = []
    # Not splitlines(): the values may hold other separators of lines.
    for number, line in enumerate(text.split("\n"), start=1):
        if line.strip():
            where = f"{path}, line {number}"
            rows.append(check_row(parse_json(line, where, object), where, known))
    require(rows, f"{path} has no scenes: write one JSON object a line.")
    return _by_task(rows)


def _by_task(rows: Iterable[Row]) -> dict[str, list[Row]]:
    tasks: dict[str, list[Row]] = {}
    for row in rows:
        tasks.setdefault(row["task"], []).append(row)
    return tasks


def check_row(value: Any, where: str, known: Sequence[str]) -> Row:
    """A row whose own fields are valid; those of `spec` are checked when its scene is built.

    Args:
        value: what was read.
        where: what an error calls it.
        known: names of all tasks.

    Raises:
        UserError: names the field.
    """
    if not isinstance(value, Mapping):
        raise UserError(f"{where} is {brief(value)}; expected an object with task and spec.")
    row = {"seed": 0, **value}
    task = row.get("task")
    if not isinstance(task, str) or task not in known:
        raise UserError(f"{where}: task is {brief(task)}. {did_you_mean(str(task), known)}")
    spec = row.get("spec")
    if not isinstance(spec, Mapping):
        raise UserError(
            f"{where}: spec is {brief(spec)}; expected the values as an object of"
            f" {', '.join(_PARTS)}."
        )
    for part, values in spec.items():
        kind = list if part == "initializations" else dict
        if part not in _PARTS or not isinstance(values, kind):
            raise UserError(
                f"{where}: spec.{part} is {brief(values)}; the parts are {', '.join(_PARTS)}."
            )
    seed = row["seed"]
    is_seed = type(seed) is int and 0 <= seed < 2**31
    require(is_seed, f"{where}: seed is {brief(seed)}; expected a whole number from 0.")
    for name, allowed in _OPTIONAL.items():
        choice = row.get(name, allowed[0])
        require(
            choice in allowed,
            f"{where}: {name} is {brief(choice)}; expected one of {', '.join(map(str, allowed))}.",
        )
    tier = row.get("tier", "")
    require(
        isinstance(tier, str),
        f"{where}: tier is {brief(tier)}; expected a name, such as {TIERS[0]}.",
    )
    return row | {"where": where}


class TaskOptions(TypedDict, total=False):
    """Keyword arguments of a task that make a scene (`envs/task.py`)."""

    seed: int
    difficulty: str | None
    recovery: str | None
    row: Mapping[str, Any]
    in_view: bool
    stress: Mapping[str, int]


def task_options(row: Mapping[str, Any]) -> TaskOptions:
    """The scene that a row describes."""
    return {
        "seed": row["seed"],
        "difficulty": row.get("difficulty", "hard"),
        "row": row,
        "recovery": row.get("recovery"),
        "in_view": bool(row.get("in_view")),
    }
