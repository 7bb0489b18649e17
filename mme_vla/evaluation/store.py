"""The files of a run's folder: settings (`run.json`), where its records are (`episodes.jsonl`), and
claims (`claims/`).
"""

import fcntl
import json
import os
import re
import socket
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from mme_vla.config.naming import digest, flat
from mme_vla.config.sections import PositiveInt, read_section
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError, brief, require
from mme_vla.evaluation.records import (
    EpisodeKey,
    EpisodeRecord,
    complete_compositions,
    finished,
    read_records,
)
from mme_vla.evaluation.records import RecordLog as RecordLog
from mme_vla.utils import (
    draft_of,
    is_alive,
    is_draft,
    read_json,
    remove_drafts,
    to_json,
    verified,
    with_checksum,
)

RUN_FILE = "run.json"
INDIFFERENT = (
    "workers",
    "batch_size",
    "device",
    "cache",
    "key_variable",
    "base_url",
    "timeout",
    "retries",
)
"""Options of a model that predicts or plays which do not affect its output, and may differ when a
run continues.
"""


def fingerprint(settings: Mapping[str, Any]) -> str:
    """SHA-256 of the settings, whatever the order of their keys."""
    return digest(settings, 64)


def claim_run(
    folder: Path, settings: Mapping[str, Any], notes: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Begin a run in `folder`, or continue with the one that is there.

    settings: plain values that decide the outcomes.
    notes: what does not decide them; written down when the run begins, never compared.

    Returns:
        What `run.json` holds. Several shards may claim the same folder at once: the first writes
        it.
    """
    for packed in sorted(folder.glob("episodes*.jsonl.xz")):
        raise UserError(
            f"{packed} is compressed, and a run continues with plain records: unpack it (xz -d), or"
            " choose another folder."
        )
    settings = to_json(settings)  # as they will be read back
    content = {
        "settings": settings,
        "fingerprint": fingerprint(settings),
        "notes": dict(notes or {}),
        "begun": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    folder.mkdir(parents=True, exist_ok=True)
    try:
        _write_new(
            folder / RUN_FILE, json.dumps(with_checksum(content), indent=2, sort_keys=True) + "\n"
        )
        return content
    except FileExistsError:
        _await_content(folder / RUN_FILE)
    there = read_run(folder)
    if there["fingerprint"] != content["fingerprint"]:
        earlier, later = flat(there["settings"]), flat(settings)
        changes = []
        for key in sorted({*earlier, *later}):
            old, new = earlier.get(key, "not set"), later.get(key, "not set")
            if old != new:
                changes.append(f"{key} was {brief(old)}, is {brief(new)}")
        raise UserError(
            f"{folder} holds a run with other settings: {'; '.join(changes)}. Resume it with its"
            " own settings, or choose another folder."
        )
    return there


def check_run_folder(folder: Path) -> None:
    """Make sure that a folder is new, empty, or holds a run already.

    Raises:
        UserError: it holds something else.
    """
    if (folder / RUN_FILE).exists() or any(folder.glob("episodes*.jsonl")):
        return
    require(
        not folder.exists() or folder.is_dir(),
        f"output={folder} is a file: name a folder.",
    )
    # another process that shares the run may be writing its first file
    is_empty = not folder.exists() or all(map(is_draft, folder.iterdir()))
    require(
        is_empty,
        f"output={folder} holds files, but no run of this command: choose a new folder, or an"
        " empty one.",
    )


def read_run(folder: Path) -> dict[str, Any]:
    """Read a folder's `run.json`."""
    path = folder / RUN_FILE
    content = read_json(path, "a run's settings", finite=False)
    require(
        content.get("fingerprint") == fingerprint(content.get("settings", {})),
        f"{path} is damaged or was changed manually: its settings do not have its fingerprint."
        " Remove it if the records beside it are of this run.",
    )
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
    # Without hard links another process may have made the file, but not filled it yet.
    end = time.monotonic() + patience
    while path.stat().st_size == 0 and time.monotonic() < end:
        time.sleep(0.05)


RECORDS = "episodes.jsonl"  # Name of a run's file; its shards are called `episodes-<shard>.jsonl`


def read_folders(paths: Iterable[Path]) -> list[EpisodeRecord]:
    """Read files of records; those of one folder belong together (`complete_compositions`)."""
    folders: dict[Path, list[EpisodeRecord]] = {}
    for path in paths:
        folders.setdefault(path.resolve().parent, []).extend(read_records(path))
    completed = []
    for records in folders.values():
        completed += complete_compositions(records)
    return completed


def find_records(paths: Iterable[Path]) -> list[Path]:
    """The files behind a list of files and folders; of a folder, every `episodes*.jsonl`, or
    `.jsonl.xz`, below it.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_file():
            files.append(path)
            continue
        if not path.is_dir():
            raise UserError(f"{path} does not exist: name files of records, or folders.")
        below = sorted([*path.rglob("episodes*.jsonl"), *path.rglob("episodes*.jsonl.xz")])
        if not below:
            raise UserError(
                f"{path} holds no results: no {RECORDS} or episodes-<shard>.jsonl in it or below."
            )
        files += below
    return list({path.resolve(): path for path in files}.values())


CLAIMS = "claims"  # Folder of a run's claims
_CLAIM = re.compile(r"(?P<task>.+)-(?P<episode>\d+)\.(?P<number>\d+)\.json")
_RECORDS = re.compile(r"episodes(-\d+of\d+)?\.jsonl")


@dataclass(frozen=True)
class Claim:
    """One process's claim on an episode.

    records: name of the file that the process holds and writes its records to; None gives the
        episode back.
    host, process: of the writer, for file systems without locks.
    """

    records: str | None
    host: str = field(default_factory=socket.gethostname)
    process: PositiveInt = field(default_factory=os.getpid)

    def __post_init__(self) -> None:
        if self.records is not None and not _RECORDS.fullmatch(self.records):
            raise UserError(
                f"records={brief(self.records)} must name a file of records, such as {RECORDS}."
            )


class Claims:
    """The claims on a run's episodes, as one of its processes sees them.

    `claims/<task>-<episode>.<n>.json` is claim number n on an episode. Each is created exclusively
    and never changed or removed, so that two processes never hold the same one, on network file
    systems too. The newest claim counts. It holds while its process locks its file of records, and
    where that file has the episode's result.
    """

    def __init__(self, folder: Path, records: str) -> None:
        """Join the run. Gives back what an earlier process with the same file of records had not
        finished.

        folder: of the run.
        records: the name of the file that this process holds and writes its records to.
        """
        self.folder = folder
        self.records = records
        self._newest: dict[EpisodeKey, tuple[int, Claim]] = {}
        for path in sorted((folder / CLAIMS).glob("[!.]*.json")):
            match = _CLAIM.fullmatch(path.name)
            if match is None:
                continue
            key = EpisodeKey(unquote(match["task"]), int(match["episode"]))
            number = int(match["number"])
            newest, _ = self._newest.get(key, (-1, None))
            if number > newest:
                self._newest[key] = number, _read_claim(path)
        done = _finished_in(folder / records)
        for key, (number, claim) in list(self._newest.items()):
            if claim.records == records and key not in done:
                self._create(key, number + 1, Claim(None))

    def take(self, waiting: Sequence[Job]) -> Job | None:
        """Claim the first episode that no process runs or has finished; None where all
        are taken.
        """
        finished_by: dict[str, set[EpisodeKey] | None] = {}
        for job in waiting:
            key = EpisodeKey(job.task, job.episode)
            while True:
                number, claim = self._newest.get(key, (-1, None))
                if claim is not None and self._holds(claim, key, finished_by):
                    break
                if self._create(key, number + 1, Claim(self.records)):
                    return job
        return None

    def _holds(
        self, claim: Claim, key: EpisodeKey, finished_by: dict[str, set[EpisodeKey] | None]
    ) -> bool:
        """Whether the claim's process is alive (None in `finished_by`) or has finished
        the episode.
        """
        records = claim.records
        if records is None:
            return False
        if records not in finished_by:
            path = self.folder / records
            is_running = records == self.records or _is_locked(path, claim)
            finished_by[records] = None if is_running else _finished_in(path)
        done = finished_by[records]
        return done is None or key in done

    def _create(self, key: EpisodeKey, number: int, claim: Claim) -> bool:
        """Write a claim; False where another process was first, whose claim is noted."""
        path = self.folder / CLAIMS / f"{quote(key.task, safe='')}-{key.episode}.{number}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        is_first = not path.exists()  # checking costs less than a draft that is not needed
        if is_first:
            try:
                _write_new(path, json.dumps(asdict(claim)) + "\n")
            except FileExistsError:
                is_first = False
        if not is_first:
            claim = _read_claim(path)
        self._newest[key] = number, claim
        return is_first


def _read_claim(path: Path) -> Claim:
    _await_content(path)
    try:
        return read_section(Claim, read_json(path, "a claim on an episode", limit=4096))
    except UserError as error:
        raise UserError(
            f"{path} is damaged: {error} Remove the folder {path.parent} while no process of the"
            " run is alive: nothing of the run is lost."
        ) from None


def _finished_in(path: Path) -> set[EpisodeKey]:
    return finished(read_records(path)) if path.exists() else set()


def _is_locked(path: Path, claim: Claim) -> bool:
    """Whether a process writes to a file of records.

    Where the file system has no locks, a process of this machine is looked up by its number, and
    others are alive.
    """
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    except OSError:
        return claim.host != socket.gethostname() or is_alive(claim.process)
    return False
