"""What a whole run consists of, and the sets of tasks that figures are made over."""

from dataclasses import dataclass
from typing import NamedTuple

from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeKey
from mme_vla.evaluation.suites import GROUPS, PAPER_ORDER, SUITES, TASK_FACTS, TEST_EPISODES, task_facts


@dataclass(frozen=True)
class Protocol:
    """What a whole run consists of, and how its figures are made.

    tasks, episodes: a run is complete with episodes 0 … episodes − 1 of every task.
    errors: whether an episode that ended in an error is a `failure`, as in the official evaluation, or `missing`.
    confidence, samples, seed: of the intervals; samples and seed are the bootstrap's.
    """

    tasks: tuple[str, ...] = PAPER_ORDER
    episodes: int = TEST_EPISODES
    errors: str = "failure"
    confidence: float = 0.95
    samples: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        for task in self.tasks:
            task_facts(task)
        if not self.tasks or len(set(self.tasks)) < len(self.tasks):
            raise UserError(f"tasks={list(self.tasks)} must name at least one task, each once.")
        if self.episodes < 1:
            raise UserError(f"episodes={self.episodes} must be at least 1: how many a task has.")
        if self.errors not in ("failure", "missing"):
            raise UserError(f"errors={self.errors!r} must be failure or missing.")
        if not 0 < self.confidence < 1:
            raise UserError(f"confidence={self.confidence} must lie between 0 and 1, for instance 0.95.")

    def expects(self, key: EpisodeKey) -> bool:
        return key.task in self.tasks and 0 <= key.episode < self.episodes

    def choose(self, attribute: str, value: str) -> list[str]:
        """The tasks of a suite or group that take part."""
        return [task for task in self.tasks if getattr(TASK_FACTS[task], attribute) == value]


class Scope(NamedTuple):
    """What a figure is about: `kind` is task, suite, group, difficulty or average."""

    kind: str
    name: str
    tasks: tuple[str, ...]


def scopes(protocol: Protocol) -> list[Scope]:
    """Everything figures are made of, whole tasks at a time (difficulties cut across them)."""
    found = [Scope("task", task, (task,)) for task in protocol.tasks]
    found += [Scope("suite", suite, tuple(protocol.choose("suite", suite))) for suite in SUITES]
    found += [Scope("group", group, tuple(protocol.choose("group", group))) for group in GROUPS]
    found += [Scope("average", "average", protocol.tasks)]
    return [scope for scope in found if scope.tasks]
