"""The JSON lines beneath a probe: one a moment and arm, one an entry, and one where a recorded episode is done."""

import json
import os
import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from mme_vla.errors import UserError
from mme_vla.utils import parse_json, read_bytes

LINES = "offline*.jsonl"
"""The files of all shards."""
LIMIT = 2**30
DONE = b'{"kind":"done"'


@dataclass(frozen=True)
class MomentLine:
    """An arm at a moment of a recorded episode.

    phase: number of the sub-task, 0 for the first; subgoal: its words. dial: where the arm stands on its dial.
    entries: how many there were. touched: ages of those that the arm changed. change, spread, distance: see `Change`.
    """

    recording: str
    task: str
    step: int
    phase: int
    subgoal: str
    arm: str
    dial: float | None
    entries: int
    touched: list[int]
    change: float
    spread: float
    distance: float


@dataclass(frozen=True)
class EntryLine:
    """What one entry matters at a moment: how the chunk changes without it.

    slot: its place; time: its frame; age: how long ago. video: whether it is from the conditioning video.
    """

    recording: str
    task: str
    step: int
    phase: int
    store: str
    slot: int
    time: int
    age: int
    video: bool
    change: float
    spread: float


Line = MomentLine | EntryLine
_KINDS: dict[str, type[Line]] = {"moment": MomentLine, "entry": EntryLine}
_NAMES = {kind: name for name, kind in _KINDS.items()}


def append(path: Path, lines: Iterable[Line], recording: str) -> None:
    """Add all lines of a recorded episode at once, and that it is done."""
    rows = [{"kind": _NAMES[type(line)], **asdict(line)} for line in lines]
    rows.append({"kind": "done", "recording": recording})
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        file.truncate(_complete_length(path.read_bytes()))
        file.write("".join(json.dumps(row, separators=(",", ":")) + "\n" for row in rows).encode())
        file.flush()
        os.fsync(file.fileno())


def _complete_length(content: bytes) -> int:
    """How many bytes there are up to the last recorded episode that is done: what follows was cut off."""
    end = length = 0
    for line in content.splitlines(keepends=True):
        end += len(line)
        length = end if line.startswith(DONE) and line.endswith(b"\n") else length
    return length


def read(path: Path) -> tuple[list[Line], set[str]]:
    """The lines of recorded episodes that are done, and which these are; nothing where there is no file."""
    if not path.is_file():
        return [], set()
    *complete, incomplete = read_bytes(path, "lines of a probe", LIMIT).split(b"\n")
    if incomplete.strip():
        warnings.warn(f"{path}: ignored a half-written last line.", stacklevel=2)
    pending: dict[str, list[Line]] = {}
    done: dict[str, list[Line]] = {}
    for number, line in enumerate(complete, 1):
        row = parse_json(line, f"{path}, line {number},")
        if row.get("kind") == "done":
            done[row["recording"]] = pending.pop(row["recording"], [])
        else:
            read_line = _line(row, f"{path}, line {number}")
            pending.setdefault(read_line.recording, []).append(read_line)
    return [line for lines in done.values() for line in lines], set(done)


def read_all(folder: Path) -> list[Line]:
    """The lines of every shard."""
    return [line for path in sorted(folder.glob(LINES)) for line in read(path)[0]]


def _line(row: dict[str, Any], where: str) -> Line:
    kind = _KINDS.get(str(row.pop("kind", "")))
    if kind is None or set(row) != {field.name for field in fields(kind)}:
        raise UserError(f"{where} is no line of a probe: its fields are {', '.join(sorted(row))}.")
    return kind(**row)
