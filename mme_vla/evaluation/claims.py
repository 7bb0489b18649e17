"""Who runs which episode, where several processes share a run: they take the next one from a common file.

`claims.jsonl` lies in the run's folder and is only appended to, under a lock. A claim holds as long as whoever made it
writes the records file of its shard, which the operating system tells (`RecordLog` locks it): what a killed process had
claimed and not finished is taken again.
"""

import fcntl
import json
import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from mme_vla.envs.vector.jobs import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.record_log import read_records
from mme_vla.evaluation.records import EpisodeKey, finished
from mme_vla.files import parse_json

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
        return session == self.session or _is_held(self.folder / records)

    def _done_by(self, session: str) -> set[EpisodeKey]:
        """What a session that has ended finished; its file may have gone on under another session."""
        if session not in self._finished:
            path = self.folder / self._files[session]
            self._finished[session] = finished(read_records(path)) if path.exists() else set()
        return self._finished[session]

    @contextmanager
    def _locked(self) -> Iterator[int]:
        """Hold the file, and know all that stands in it."""
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
            new = os.pread(file, os.fstat(file).st_size - self._read, self._read)
            whole, _, rest = new.rpartition(b"\n")
            if rest:  # a process was killed while it wrote
                os.ftruncate(file, self._read + len(new) - len(rest))
            for line in whole.split(b"\n") if whole else ():
                self._note(line)
            self._read += len(new) - len(rest)
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


def _is_held(path: Path) -> bool:
    """Whether a process writes to a records file. Where the disk knows no locks, whoever began is taken to go on."""
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
