"""A run of episodes: which ones, where their records go, which are still to be played, and how they compare."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mme_vla.envs.metadata import SPLITS
from mme_vla.envs.metadata import episodes as episodes_of
from mme_vla.envs.task_names import TASK_NAMES
from mme_vla.errors import UserError, did_you_mean
from mme_vla.evaluation.record_log import RECORDS, RecordLog, read_records
from mme_vla.evaluation.records import EpisodeRecord, finished, merge
from mme_vla.evaluation.results.paper import paper_table
from mme_vla.evaluation.run_file import claim_run
from mme_vla.evaluation.suites import PAPER_ORDER
from mme_vla.play.game import ChoiceSession, EpisodeId
from mme_vla.registry import TASKS

ALL = "all"


def make_session(
    episode: EpisodeId, env: str, max_steps: int, max_choices: int, pictures: bool = True
) -> ChoiceSession:
    """The simulator for one episode.

    Args:
        episode: which one. env: `mme_vla` or `official`. max_steps, max_choices: when it has timed out.
        pictures: whether the player looks at them; the official environment renders in any case.

    Raises:
        UserError: as `make_env`.
    """
    from mme_vla.envs import make_env

    render = pictures or env == "official"
    which = (episode.task, episode.split, episode.episode)
    made = make_env(*which, "multi_choice", max_steps=max_steps, env=env, render=render)
    try:
        return ChoiceSession(made, episode, max_choices, pictures)
    except BaseException:
        made.close()
        raise


@dataclass(frozen=True)
class Identity:
    """Under which name a run's records are kept. settings: all that decides its outcomes."""

    model: str
    checkpoint: int | str
    model_seed: int
    max_steps: int
    settings: Mapping[str, Any]


class PlayRun:
    """The episodes of one run and its folder. A context manager; resumes what is there.

    Args:
        folder: of `episodes.jsonl` and `run.json`.
        wanted: episodes to play, in order. identity: whose.
        make: makes the session of an episode.
        retry_errors: play episodes again that ended in an error.

    Raises:
        UserError: the folder holds a run with other settings, or another process writes to it.
    """

    def __init__(
        self,
        folder: Path,
        wanted: Sequence[EpisodeId],
        identity: Identity,
        make: Callable[[EpisodeId], ChoiceSession],
        retry_errors: bool = False,
    ) -> None:
        self.folder, self.identity, self.make = folder, identity, make
        claim_run(folder, identity.settings)
        self._log = RecordLog(folder / RECORDS)
        self.wanted = list(wanted)
        keys = {(which.task, which.episode) for which in self.wanted}
        # Folders below hold runs of their own.
        there = [record for path in sorted(folder.glob("episodes*.jsonl")) for record in read_records(path)]
        self.records = [record for record in merge(there, "last") if (record.task, record.episode) in keys]
        done = finished(self.records, retry_errors)
        self.todo = [which for which in self.wanted if (which.task, which.episode) not in done]

    def save(self, session: ChoiceSession, **extra: Any) -> EpisodeRecord:
        """Write the record of a session that is over."""
        own = self.identity
        return self._keep(
            session.episode, session.record(own.model, own.checkpoint, own.model_seed, own.max_steps, **extra)
        )

    def save_error(
        self, which: EpisodeId, reason: str, session: ChoiceSession | None = None, **extra: Any
    ) -> EpisodeRecord:
        """Write that an episode could not be played to its end.

        Args:
            which: the episode. reason: what broke.
            session: as far as it came; None where it could not even be made.
            extra: more to keep with the record.
        """
        if session is not None:
            if not session.over:
                session.give_up("error", reason)
            return self.save(session, **extra)
        own = self.identity
        record = EpisodeRecord(
            model=own.model, checkpoint=own.checkpoint, model_seed=own.model_seed, max_steps=own.max_steps,
            action_space="multi_choice", task=which.task, episode=which.episode, seed=which.seed,
            difficulty=which.difficulty, split=which.split, outcome="error", steps=0, error=reason,
            extra={"decisions": [], "ended_by": reason, **extra},
        )  # fmt: skip
        return self._keep(which, record)

    def _keep(self, which: EpisodeId, record: EpisodeRecord) -> EpisodeRecord:
        self._log.append(record)
        self.records.append(record)
        if which in self.todo:
            self.todo.remove(which)
        return record

    def summary(self) -> list[tuple[str, int, int, dict[str, float]]]:
        """(task, successes, episodes, the paper's rates by method in percent), tasks in the paper's order."""
        known = {row["method"]: row for row in paper_table("oracle_planner")}
        rows = []
        for task in PAPER_ORDER:
            played = [record for record in merge(self.records, "last") if record.task == task]
            if played:
                paper = {method: float(row[task]) for method, row in known.items()}
                rows.append((task, sum(record.success for record in played), len(played), paper))
        return rows

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._log.close()


def choose_episodes(task: str | Sequence[str], episodes: Any, split: str) -> list[EpisodeId]:
    """The episodes that the command line names, task by task.

    Args:
        task: a name, several, or `all`.
        episodes: numbers of the split: 3, [0, 2], `0-9`, `0-3,7` or `all`.
        split: `train`, `val` or `test`.

    Raises:
        UserError: an unknown task or split, or episodes that the split has not.
    """
    if split not in SPLITS:
        raise UserError(f"Unknown split {split!r}. {did_you_mean(str(split), SPLITS)}")
    names = [name.strip() for name in task.split(",")] if isinstance(task, str) else [str(name) for name in task]
    names = list(PAPER_ORDER) if names == [ALL] else names
    for name in names:
        if name not in TASK_NAMES and name not in TASKS:
            raise UserError(f"Unknown task {name!r}. {did_you_mean(name, [*TASK_NAMES, *TASKS, ALL])}")
    numbers = _numbers(episodes, SPLITS[split], split)
    chosen = []
    for name in dict.fromkeys(names):
        table = episodes_of(name, split)
        chosen += [EpisodeId(name, split, n, table[n].seed, table[n].difficulty) for n in numbers]
    if not chosen:
        raise UserError("There is nothing to play: name at least one task and one episode.")
    return chosen


def _numbers(episodes: Any, count: int, split: str) -> list[int]:
    if episodes == ALL:
        return list(range(count))
    parts = episodes if isinstance(episodes, Sequence) and not isinstance(episodes, str) else str(episodes).split(",")
    numbers: list[int] = []
    for part in parts:
        span = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", str(part))
        if span is None:
            raise UserError(f"episodes={episodes!r} is not understood; write 3, [0,2], 0-9, or all.")
        first, last = int(span[1]), int(span[2] or span[1])
        if first > last or last >= count:
            raise UserError(f"The split {split!r} has the episodes 0 to {count - 1}; asked for {str(part).strip()}.")
        numbers += range(first, last + 1)
    return list(dict.fromkeys(numbers))
