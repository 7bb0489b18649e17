"""Who runs which episode, where several processes share a run: they take the next one from a common file.

`claims.jsonl` lies in the run's folder and is only appended to, under a lock. A claim holds as long as whoever made it
writes the records file of its shard, which the operating system tells (`RecordLog` locks it): what a killed process had
claimed and not finished is taken again.
"""

import fcntl
import hashlib
import json
import os
import socket
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self
from uuid import uuid4

from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError, brief
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord, complete_compositions, finished
from mme_vla.utils import (
    draft_of,
    name_place,
    parse_json,
    read_json,
    read_lines,
    remove_drafts,
    to_json,
    verified,
    with_checksum,
)

RUN_FILE = "run.json"
INDIFFERENT = ("workers", "batch_size", "device", "cache", "key_variable", "base_url", "timeout", "retries", "backoff",
               "requests_per_minute", "input_price", "output_price")  # fmt: skip
"""Options of a model that predicts or plays which do not decide what it says, and may differ when a run continues."""


def fingerprint(settings: Mapping[str, Any]) -> str:
    """SHA-256 of the settings, whatever the order of their keys."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def claim_run(folder: Path, settings: Mapping[str, Any], notes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Begin a run in `folder`, or continue with the one that is there.

    Args:
        settings: plain values that decide the outcomes: checkpoint, seeds, split, step limit, action space, …
        notes: what does not (device, workers, versions); written down when the run begins, never compared.

    Returns:
        What `run.json` holds. Several shards may claim the same folder at once: the first writes it.
    """
    settings = to_json(settings)  # as they will be read back
    content = {
        "settings": settings,
        "fingerprint": fingerprint(settings),
        "notes": dict(notes or {}),
        "begun": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    folder.mkdir(parents=True, exist_ok=True)
    try:
        _write_new(folder / RUN_FILE, json.dumps(with_checksum(content), indent=2, sort_keys=True) + "\n")
        return content
    except FileExistsError:
        _await_content(folder / RUN_FILE)
    there = read_run(folder)
    if there["fingerprint"] != content["fingerprint"]:
        raise UserError(
            f"{folder} holds a run with other settings: {_differences(there['settings'], settings)}. "
            "Resume it with its own settings, or choose another folder."
        )
    return there


def read_run(folder: Path) -> dict[str, Any]:
    """Read a folder's `run.json`."""
    path = folder / RUN_FILE
    content = read_json(path, "a run's settings", finite=False)
    if not isinstance(content.get("settings"), dict) or not isinstance(content.get("fingerprint"), str):
        raise UserError(
            f"{path} is damaged: it lacks settings or their fingerprint; remove it if the records beside "
            "it are of this run."
        )
    if content["fingerprint"] != fingerprint(content["settings"]):
        raise UserError(f"{path} was changed manually: its settings do not have its fingerprint.")
    return verified(content, str(path))


def _write_new(target: Path, text: str) -> None:
    """Write a file that is not there yet.

    Raises:
        FileExistsError: it is.
    """
    remove_drafts(target.parent)
    mine = draft_of(target)
    mine.write_text(text)
    try:
        os.link(mine, target)  # whole or not at all, and never over another's
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        with target.open("x") as file:
            file.write(text)
    finally:
        mine.unlink(missing_ok=True)


def _await_content(path: Path, patience: float = 2) -> None:
    """Without hard links another process may have made the file, but not filled it yet."""
    end = time.monotonic() + patience
    while path.stat().st_size == 0 and time.monotonic() < end:
        time.sleep(0.05)


def _differences(there: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    before, after = _flat(there), _flat(now)
    changed = [key for key in sorted({*before, *after}) if before.get(key, _NOTHING) != after.get(key, _NOTHING)]
    changes = (
        f"{key} was {brief(before.get(key, 'not set'))}, is {brief(after.get(key, 'not set'))}" for key in changed
    )
    return "; ".join(changes)


_NOTHING = object()


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


RECORDS = "episodes.jsonl"
"""Name of a run's file; its shards are called `episodes-<shard>.jsonl`."""


class RecordLog:
    """Appends records to a file, each on disk when `append` returns. A context manager.

    One process a file: the shards of a run write `episodes-<shard>.jsonl` side by side.
    """

    def __init__(self, path: Path) -> None:
        """Open or create `path`, and remove a half-written last line."""
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
        last_line = content.rpartition(b"\n")[2]
        if not last_line:
            return
        try:
            EpisodeRecord.from_json(last_line)
        except UserError:
            warnings.warn(f"{self.path}: removed a half-written last line ({len(last_line)} bytes).", stacklevel=3)
            self._file.truncate(len(content) - len(last_line))
        else:  # only the line's end is missing
            self._file.write(b"\n")


def read_records(path: Path) -> list[EpisodeRecord]:
    """Read a file of records; a half-written last line is ignored with a warning."""
    return read_lines(path, EpisodeRecord.from_dict, "episode records", finite=False)


def read_folders(paths: Iterable[Path]) -> list[EpisodeRecord]:
    """Read files of records; those of one folder belong together (`complete_compositions`)."""
    folders: dict[Path, list[EpisodeRecord]] = {}
    for path in paths:
        folders.setdefault(path.resolve().parent, []).extend(read_records(path))
    return [record for records in folders.values() for record in complete_compositions(records)]


def find_records(paths: Iterable[Path]) -> list[Path]:
    """The files behind a list of files and folders; of a folder, every `episodes*.jsonl` below it."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(path.rglob("episodes*.jsonl"))
            if not inside:
                raise UserError(f"{path} holds no results: no {RECORDS} or episodes-<shard>.jsonl in it or below.")
            files += inside
        elif path.is_file():
            files.append(path)
        else:
            raise UserError(f"{path} does not exist: name files of episode records, or folders with {RECORDS}.")
    return list({path.resolve(): path for path in files}.values())


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


CLAIMS = "claims.jsonl"


class Claims:
    """The claims on a run's episodes, seen by one of its processes."""

    def __init__(self, folder: Path, records: str) -> None:
        """Join the run; whatever an earlier process claimed under the same name is free again.

        Args:
            folder: of the run. records: the name of the file that this process holds and writes its records to.
        """
        self.folder, self.path, self.records = folder, folder / CLAIMS, records
        self.session = f"{socket.gethostname()}-{os.getpid()}-{uuid4().hex[:8]}"
        self._owners: dict[EpisodeKey, str] = {}
        self._files: dict[str, str] = {}  # session → its records
        self._newest: dict[str, str] = {}  # records → the session that holds them
        self._finished: dict[str, set[EpisodeKey]] = {}  # of sessions that have ended
        self._read = 0
        with self._locked() as file:
            self._append(file, {"begin": self.session, "records": records})

    def take(self, waiting: Sequence[Job]) -> Job | None:
        """Claim the first episode that nobody runs or has finished; None where all are taken."""
        alive: dict[str, bool] = {}
        with self._locked() as file:
            for job in waiting:
                key = EpisodeKey(job.task, job.episode)
                owner = self._owners.get(key)
                if owner is not None:
                    if owner not in alive:
                        alive[owner] = self._is_alive(owner)
                    if alive[owner] or key in self._done_by(owner):
                        continue
                self._append(file, {"by": self.session, "task": job.task, "episode": job.episode})
                return job
        return None

    def _is_alive(self, session: str) -> bool:
        records = self._files[session]
        if self._newest[records] != session:
            return False
        return session == self.session or _is_locked(self.folder / records)

    def _done_by(self, session: str) -> set[EpisodeKey]:
        """What a session that has ended finished; its file may have gone on under another session."""
        if session not in self._finished:
            path = self.folder / self._files[session]
            self._finished[session] = finished(read_records(path)) if path.exists() else set()
        return self._finished[session]

    @contextmanager
    def _locked(self) -> Iterator[int]:
        """Hold the file, and know all that is in it."""
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
            new = os.pread(file, os.fstat(file).st_size - self._read, self._read)
            complete, _, incomplete = new.rpartition(b"\n")
            if incomplete:  # a process was killed while it wrote
                os.ftruncate(file, self._read + len(new) - len(incomplete))
            for line in complete.split(b"\n") if complete else ():
                self._note(line)
            self._read += len(new) - len(incomplete)
            yield file
        finally:
            os.close(file)

    def _note(self, line: bytes) -> None:
        claim = parse_json(line, "a claim on an episode")
        if isinstance(claim, dict) and isinstance(claim.get("records"), str):
            self._files[claim["begin"]] = claim["records"]
            self._newest[claim["records"]] = claim["begin"]
        elif isinstance(claim, dict) and claim.get("by") in self._files:
            self._owners[EpisodeKey(claim["task"], claim["episode"])] = claim["by"]
        else:
            raise UserError(
                f"{self.path} is damaged. Remove it while no process of the run is alive: nothing of the run is lost."
            )

    def _append(self, file: int, claim: dict[str, object]) -> None:
        line = json.dumps(claim).encode() + b"\n"
        os.write(file, line)
        os.fsync(file)
        self._note(line)
        self._read += len(line)


def _is_locked(path: Path) -> bool:
    """Whether a process writes to a records file. Where the disk knows no locks, whoever began is taken to continue."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:  # held by another, or no locks
        return True
    finally:
        os.close(file)
    return False
