"""Which episodes a run is made of, and which of them this process runs."""

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mme_vla.envs import metadata
from mme_vla.envs.task_names import TASK_NAMES
from mme_vla.envs.vector.jobs import Job
from mme_vla.errors import UserError, did_you_mean
from mme_vla.evaluation.record_log import RECORDS
from mme_vla.registry import TASKS


@dataclass(frozen=True)
class Shard:
    """One of several processes that share a run."""

    index: int = 0
    count: int = 1

    @property
    def file(self) -> str:
        """Name of the file its records go to."""
        return RECORDS if self.count == 1 else f"episodes-{self.index}of{self.count}.jsonl"


def choose_episodes(
    tasks: str | Sequence[str] = "all", episodes: int | Sequence[int] | None = None, split: str = "test"
) -> list[Job]:
    """The episodes of a run, task by task.

    Args:
        tasks: `all` of the benchmark, a name, or a list of names; tasks of the user's own are named.
        episodes: of every task: None for all of the split, a number for the first so many, or a list of them.

    Raises:
        UserError: an unknown task, split or episode, or none at all.
    """
    names = list(TASK_NAMES) if tasks == "all" else [tasks] if isinstance(tasks, str) else [str(t) for t in tasks]
    if not names:
        raise UserError("tasks=[] names no task; expected all, a task or a list of tasks.")
    for name in names:
        if name not in TASK_NAMES and name not in TASKS:
            raise UserError(f"Unknown task {name!r}. {did_you_mean(name, [*TASK_NAMES, *TASKS, 'all'])}")
    if len(set(names)) < len(names):
        raise UserError(f"tasks={names} names a task twice.")
    return [Job(name, split, number) for name in names for number in _numbers(name, episodes, split)]


def _numbers(task: str, episodes: int | Sequence[int] | None, split: str) -> list[int]:
    known = len(metadata.episodes(task, split))
    if episodes is None:
        return list(range(known))
    if isinstance(episodes, int) and not isinstance(episodes, bool):
        if not 1 <= episodes <= known:
            raise UserError(f"episodes={episodes} asks for the first {episodes}; {task} has {known} in {split!r}.")
        return list(range(episodes))
    if isinstance(episodes, str) or not isinstance(episodes, Sequence):
        raise UserError(f"episodes={episodes!r}; expected a number, or a list such as [0,1,2].")
    if not episodes or len(set(episodes)) < len(episodes):
        raise UserError(f"episodes={list(episodes)} must name each episode once, and at least one.")
    return [metadata.episode(task, split, number).episode for number in episodes]


def choose_shard(text: str | None, environment: Mapping[str, str] | None = None) -> Shard:
    """Read `0/4` (the first of four), or what torchrun says of this process.

    Args:
        text: wins over the environment. environment: by default the process's own.

    Raises:
        UserError: no two numbers, or the first not below the second.
    """
    environment = os.environ if environment is None else environment
    if text is None:
        if "RANK" not in environment or "WORLD_SIZE" not in environment:
            return Shard()
        text = f"{environment['RANK']}/{environment['WORLD_SIZE']}"
    found = re.fullmatch(r"(\d+)/(\d+)", str(text))
    shard = Shard(int(found[1]), int(found[2])) if found else Shard(1, 0)
    if shard.index >= shard.count:
        raise UserError(f"shard={text!r}; expected <index>/<count> counted from 0, such as 0/4 … 3/4.")
    return shard


def take_share(jobs: Sequence[Job], shard: Shard) -> list[Job]:
    """This shard's part of the episodes, in their order.

    Who runs what is decided by a hash of each episode, so that every shard gets its share of every task and difficulty.
    """
    mixed = sorted(jobs, key=lambda job: hashlib.sha256(str(job).encode()).digest())
    mine = set(mixed[shard.index :: shard.count])
    return [job for job in jobs if job in mine]
