"""The JSON lines of a probe: one a step and arm, one an entry, and one where a recorded episode is
done.
"""

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from mme_vla.config.sections import read_section
from mme_vla.errors import UserError, brief
from mme_vla.utils import parse_json, read_lines, verified, with_checksum

LINES = "offline*.jsonl"  # The files of all shards


@dataclass(frozen=True)
class MomentLine:
    """An arm at a step of a recorded episode.

    phase: number of the sub-task, 0 for the first.
    subgoal: its text.
    dial: the arm's value of its dial.
    entries: how many there were.
    touched: ages of those that the arm changed. change, spread,
    distance: see `Change`.
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

    def __post_init__(self) -> None:
        if not all(type(age) is int for age in self.touched):
            raise UserError(f"touched={brief(self.touched)} must be a list of whole numbers.")


@dataclass(frozen=True)
class EntryLine:
    """How the chunk changes without one entry.

    slot: its index.
    time: its frame.
    age: frames since then.
    video: whether it is from the conditioning video.
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


@dataclass(frozen=True)
class DoneLine:
    """The end of a recorded episode's lines."""

    recording: str


Line = MomentLine | EntryLine
_KINDS: dict[str, type[Line | DoneLine]] = {
    "moment": MomentLine,
    "entry": EntryLine,
    "done": DoneLine,
}
_NAMES = {kind: name for name, kind in _KINDS.items()}


def append(path: Path, lines: Iterable[Line], recording: str) -> None:
    """Add all lines of a recorded episode at once, and that it is done."""
    text = ""
    for line in [*lines, DoneLine(recording)]:
        row = with_checksum({"kind": _NAMES[type(line)], **asdict(line)})
        text += json.dumps(row, separators=(",", ":")) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        content = path.read_bytes()
        length = _complete_length(content)
        file.truncate(length)
        file.write(b"\n" * (length > 0 and content[length - 1 : length] != b"\n") + text.encode())
        file.flush()
        os.fsync(file.fileno())


def _complete_length(content: bytes) -> int:
    """How many bytes there are up to the last recorded episode that is done: what follows was cut
    off.
    """
    start = content.rfind(b'{"kind":"done"')
    if start < 0:
        return 0
    end = content.find(b"\n", start) + 1
    if end:
        return end
    try:
        _from_dict(verified(parse_json(content[start:], "the line"), "the line"))
    except UserError:
        return _complete_length(content[:start])
    return len(content)


def read(path: Path) -> tuple[list[Line], set[str]]:
    """The lines of recorded episodes that are done, and which these are; nothing where there is no
    file.
    """
    if not path.exists():
        return [], set()
    pending: dict[str, list[Line]] = {}
    done: dict[str, list[Line]] = {}
    for line in read_lines(path, _from_dict, "lines of a probe"):
        if isinstance(line, DoneLine):
            done[line.recording] = pending.pop(line.recording, [])
        else:
            pending.setdefault(line.recording, []).append(line)
    return list(chain.from_iterable(done.values())), set(done)


def read_all(folder: Path) -> list[Line]:
    """The lines of every shard."""
    lines: list[Line] = []
    for path in sorted(folder.glob(LINES)):
        lines += read(path)[0]
    return lines


def _from_dict(row: dict[str, Any]) -> Line | DoneLine:
    name = row.pop("kind", None)
    if name not in _NAMES.values():
        raise UserError(f"kind={brief(name)} must be {', '.join(_KINDS)}.")
    return read_section(_KINDS[name], row, "line")
