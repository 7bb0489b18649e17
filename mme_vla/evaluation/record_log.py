"""Files of episode records: one line of JSON an episode, written the moment it ends.

A file is only ever appended to, so a killed run has lost at most the line it was writing: reading ignores that line
with a warning, and the next append removes it.
"""

import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord, complete_compositions
from mme_vla.files import name_place, read_bytes

RECORDS = "episodes.jsonl"
"""Name of a run's file; its shards are called `episodes-<shard>.jsonl`."""
LOG_LIMIT = 2**30
"""Most bytes of one file."""


class RecordLog:
    """Appends records to a file, each on disk when `append` returns. A context manager.

    One process a file: the shards of a run write `episodes-<shard>.jsonl` side by side.
    """

    def __init__(self, path: Path) -> None:
        """Open or create `path`, and remove a half-written last line.

        Raises:
            UserError: another process is writing to it.
        """
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: IO[bytes] = path.open("ab+")
        try:
            _lock(self._file, path)
            self._repair()
        except BaseException:
            self._file.close()
            raise

    def append(self, record: EpisodeRecord) -> None:
        """Write one record."""
        self._file.write(record.to_json().encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        name_place(error, self.path)
        try:
            self.close()
        except OSError:  # what a full disk did not take is tried once more on closing
            if error is None:
                raise

    def _repair(self) -> None:
        self._file.seek(0)
        content = self._file.read()
        rest = content.rpartition(b"\n")[2]
        if not rest:
            return
        try:
            EpisodeRecord.from_json(rest)
        except UserError:
            warnings.warn(f"{self.path}: removed a half-written last line ({len(rest)} bytes).", stacklevel=3)
            self._file.truncate(len(content) - len(rest))
        else:  # only the line's end is missing
            self._file.write(b"\n")


def read_records(path: Path) -> list[EpisodeRecord]:
    """Read a file of records; a half-written last line is ignored with a warning.

    Raises:
        UserError: the file is not there, or another line is not a record.
    """
    content = read_bytes(path, "episode records", LOG_LIMIT)
    *lines, rest = content.split(b"\n")
    records = []
    for number, line in enumerate([*lines, rest], 1):
        if not line.strip():
            continue
        try:
            records.append(EpisodeRecord.from_json(line))
        except UserError as error:
            if number > len(lines):
                warnings.warn(f"{path}: ignored a half-written last line ({len(line)} bytes).", stacklevel=2)
                continue
            raise UserError(f"{path}, line {number}, is not an episode record: {error}") from None
    return records


def read_folders(paths: Iterable[Path]) -> list[EpisodeRecord]:
    """Read files of records; those of one folder belong together (`complete_compositions`).

    Raises:
        UserError: as `read_records`.
    """
    folders: dict[Path, list[EpisodeRecord]] = {}
    for path in paths:
        folders.setdefault(path.resolve().parent, []).extend(read_records(path))
    return [record for records in folders.values() for record in complete_compositions(records)]


def find_records(paths: Iterable[Path]) -> list[Path]:
    """The files behind a list of files and folders; of a folder, every `episodes*.jsonl` below it.

    Raises:
        UserError: a path is not there, or a folder holds no records.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(path.rglob("episodes*.jsonl"))
            if not inside:
                raise UserError(f"{path} holds no results: no {RECORDS} or episodes-<shard>.jsonl in it or below.")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise UserError(f"{path} does not exist: name files of episode records, or folders with {RECORDS}.")
    return list({path.resolve(): path for path in found}.values())


def _lock(file: IO[bytes], path: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not on this system
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UserError(
            f"{path} is being written by another process; give every shard a file of its own, episodes-<shard>.jsonl."
        ) from None
    except OSError:  # a file system without locks
        return
