"""Which episodes a run is made of, and which of them this process runs."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mme_vla.envs.episodes import choose_episodes as choose_specs
from mme_vla.envs.vector.jobs import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.record_log import RECORDS


@dataclass(frozen=True)
class Shard:
    """One of several processes that share a run."""

    index: int = 0
    count: int = 1

    @property
    def file(self) -> str:
        """Name of the file its records go to."""
        return RECORDS if self.count == 1 else f"episodes-{self.index}of{self.count}.jsonl"


def choose_episodes(tasks: str | Sequence[str] = "all", episodes: Any = None, split: str = "test") -> list[Job]:
    """The episodes of a run, task by task, by the grammar of all commands (`mme_vla.envs.episodes`).

    Raises:
        UserError: an unknown task, split or episode, or none at all.
    """
    return [Job(spec.task, spec.split, spec.episode) for spec in choose_specs(tasks, episodes, split)]


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
