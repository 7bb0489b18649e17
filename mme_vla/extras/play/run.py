"""A run of episodes: which ones, where their records go, which are still to be played, and how they
compare.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.scene_hash import NOT_BUILT
from mme_vla.evaluation.records import EpisodeRecord, RecordLog, finished, merge, read_records
from mme_vla.evaluation.results.paper import paper_table
from mme_vla.evaluation.results.scopes import PAPER_ORDER
from mme_vla.evaluation.store import RECORDS, begin_run
from mme_vla.extras.play.game import ChoiceSession


def make_session(
    episode: EpisodeSpec,
    env: str,
    limit_of: Callable[[str], int],
    max_choices: int | None,
    images: bool = True,
) -> ChoiceSession:
    """The simulator for one episode.

    episode: which one.
    env: name of the environment.
    limit_of: the steps of a task after which it has timed out.
    max_choices: the choices; None: any number.
    images: whether the player reads them.
    """
    from mme_vla.envs.base import CHOICES, open_episode

    which = (episode.task, episode.split, episode.episode)
    limit = limit_of(episode.task)
    made = open_episode(env, *which, action_space=CHOICES, max_steps=limit, render=images)
    try:
        return ChoiceSession(made, episode, max_choices, images, max_steps=limit)
    except BaseException:
        made.close()
        raise


@dataclass(frozen=True)
class Identity:
    """Under which name a run's records are kept. settings: all that decides its outcomes. limits:
    task → steps, where it is not `max_steps`. of_policy: what else the records of a policy say of
    it, by their fields.
    """

    model: str
    checkpoint: int | str
    model_seed: int
    max_steps: int
    settings: Mapping[str, Any]
    limits: Mapping[str, int] = field(default_factory=dict)
    of_policy: Mapping[str, Any] = field(default_factory=dict)

    def limit_of(self, task: str) -> int:
        """Steps after which an episode of a task is a timeout."""
        return self.limits.get(task, self.max_steps)


class PlayRun:
    """The episodes of one run and its folder. A context manager; resumes what is there.

    Args:
        folder: of `episodes.jsonl` and `run.json`.
        episodes: to play, in order.
        identity: of the records.
        make: makes the session of an episode.
        retry_errors: play episodes again that ended in an error.
    """

    def __init__(
        self,
        folder: Path,
        episodes: Sequence[EpisodeSpec],
        identity: Identity,
        make: Callable[[EpisodeSpec], ChoiceSession],
        retry_errors: bool = False,
    ) -> None:
        self.folder, self.identity, self.make = folder, identity, make
        begin_run(folder, identity.settings)
        self._log = RecordLog(folder / RECORDS)
        self.episodes = list(episodes)
        keys = {(which.task, which.episode) for which in self.episodes}
        # Folders below hold runs of their own.
        there: list[EpisodeRecord] = []
        for path in sorted(folder.glob("episodes*.jsonl")):
            there += read_records(path)
        self.records = []
        for record in merge(there, "last"):
            if (record.task, record.episode) in keys:
                self.records.append(record)
        done = finished(self.records, retry_errors)
        self.todo = [which for which in self.episodes if (which.task, which.episode) not in done]

    def save(self, session: ChoiceSession, **extra: Any) -> EpisodeRecord:
        """Write the record of a session that is over."""
        identity = self.identity
        return self._keep(
            session.episode,
            session.record(
                identity.model,
                identity.checkpoint,
                identity.model_seed,
                identity.limit_of(session.episode.task),
                **extra,
            ),
        )

    def save_error(
        self, which: EpisodeSpec, reason: str, session: ChoiceSession | None = None, **extra: Any
    ) -> EpisodeRecord:
        """Write that an episode could not be played to its end.

        which: the episode.
        reason: what broke.
        session: as far as it came; None where it could not even be made.
        extra: more to keep with the record.
        """
        if session is not None:
            if not session.over:
                session.give_up("error", reason)
            return self.save(session, **extra)
        identity = self.identity
        record = EpisodeRecord(
            model=identity.model,
            checkpoint=identity.checkpoint,
            model_seed=identity.model_seed,
            max_steps=identity.limit_of(which.task),
            action_space="multi_choice",
            task=which.task,
            episode=which.episode,
            seed=which.seed,
            difficulty=which.difficulty,
            split=which.split,
            outcome="error",
            steps=0,
            error=reason,
            scene=NOT_BUILT,
            extra={"decisions": [], "ended_by": reason, **extra},
        )
        return self._keep(which, record)

    def _keep(self, which: EpisodeSpec, record: EpisodeRecord) -> EpisodeRecord:
        record = replace(record, **self.identity.of_policy)
        self._log.append(record)
        self.records.append(record)
        if which in self.todo:
            self.todo.remove(which)
        return record

    def summary(self) -> list[tuple[str, int, int, dict[str, float]]]:
        """(task, successes, episodes, the paper's rates by method in percent), tasks in the paper's
        order.

        The user's own tasks come last, without rates.
        """
        known = {row["method"]: row for row in paper_table("oracle_planner")}
        outcomes: dict[str, list[bool]] = {task: [] for task in PAPER_ORDER}
        for record in merge(self.records, "last"):
            outcomes.setdefault(record.task, []).append(record.success)
        rows = []
        for task, played in outcomes.items():
            if played:
                paper = {method: float(row[task]) for method, row in known.items() if task in row}
                rows.append((task, sum(played), len(played), paper))
        return rows

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._log.close()
