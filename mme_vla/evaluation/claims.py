"""Several processes that share a run: which of them runs an episode (`claims/` in its folder)."""

import fcntl
import json
import os
import re
import socket
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from urllib.parse import quote, unquote

from mme_vla.config.sections import PositiveInt, read_section
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError, brief
from mme_vla.evaluation.records import EpisodeKey, finished, read_records
from mme_vla.evaluation.store import RECORDS, await_content, write_new
from mme_vla.utils import is_alive, read_json

CLAIMS = "claims"  # Folder of a run's claims
_CLAIM = re.compile(r"(?P<task>.+)-(?P<episode>\d+)\.(?P<number>\d+)\.json")
_RECORDS = re.compile(r"episodes(-\d+of\d+)?\.jsonl")


@dataclass(frozen=True)
class Shard:
    """One of several processes that share a run."""

    index: int = 0
    count: int = 1

    @property
    def file(self) -> str:
        """Name of the file its records go to."""
        return RECORDS if self.count == 1 else f"episodes-{self.index}of{self.count}.jsonl"


ALONE = Shard()


def check_sharing(folder: Path, records: str) -> None:
    """Make sure that all processes of a run share it, or one runs it alone.

    folder: of the run.
    records: the name of the file that this process holds.

    Raises:
        UserError: another process runs all of its episodes, or this one would.
    """
    for path in sorted(folder.glob("episodes*.jsonl")):
        is_other_kind = (path.name == RECORDS) != (records == RECORDS)
        if is_other_kind and _is_locked(path):
            raise UserError(
                f"{path} is being written by another process: of several that run {folder} each"
                " needs shard=<index>/<count>."
            )


def choose_shard(text: str | None) -> Shard:
    """Read `0/4` (the first of four); without a text, the rank of this process under torchrun."""
    if text is None:
        if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
            return Shard()
        text = f"{os.environ['RANK']}/{os.environ['WORLD_SIZE']}"
    match = re.fullmatch(r"(\d+)/(\d+)", str(text))
    if match is None or int(match[1]) >= int(match[2]):
        raise UserError(
            f"shard={text!r}; expected <index>/<count> counted from 0, such as 0/4 … 3/4."
        )
    return Shard(int(match[1]), int(match[2]))


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
        """Whether the claim's process is alive, or has finished the episode.

        finished_by: of each file of records, what it has; None while its process is alive.
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
                write_new(path, json.dumps(asdict(claim)) + "\n")
            except FileExistsError:
                is_first = False
        if not is_first:
            claim = _read_claim(path)
        self._newest[key] = number, claim
        return is_first


def _read_claim(path: Path) -> Claim:
    await_content(path)
    try:
        return read_section(Claim, read_json(path, "a claim on an episode", limit=4096))
    except UserError as error:
        raise UserError(
            f"{path} is damaged: {error} Remove the folder {path.parent} while no process of the"
            " run is alive: nothing of the run is lost."
        ) from None


def _finished_in(path: Path) -> set[EpisodeKey]:
    return finished(read_records(path)) if path.exists() else set()


def _is_locked(path: Path, claim: Claim | None = None) -> bool:
    """Whether a process writes to a file of records.

    Where the file system has no locks, the process of a claim is looked up by its number on this
    machine, and is alive on others.
    """
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    except OSError:
        if claim is None:
            return False
        return claim.host != socket.gethostname() or is_alive(claim.process)
    return False


class Waiting:
    """Episodes in the order they begin.

    jobs: all that are left.
    claims: where other processes run the same ones; each then begins what it could claim.
    """

    def __init__(self, jobs: Iterable[Job] = (), claims: Claims | None = None) -> None:
        self._jobs = list(jobs)
        self._claims = claims
        self._again: list[Job] = []

    def take(self) -> Job | None:
        """The next episode to begin, if there is one; those tried again come last."""
        job = None
        if self._claims is not None:
            job = self._claims.take(self._jobs)
            if job is not None:
                self._jobs.remove(job)
        elif self._jobs:
            job = self._jobs.pop(0)
        if job is None and self._again:
            job = self._again.pop(0)
        return job

    def put_back(self, job: Job) -> None:
        """Have an episode run once more, by this process."""
        self._again.append(job)
