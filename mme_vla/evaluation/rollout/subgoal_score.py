"""Predicted subgoals against the environment's own: whether the words are right, and how far the points are off."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import numpy as np

from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import Method, Results
from mme_vla.evaluation.results.tables import Table
from mme_vla.subgoal.words.parsing import mark_points

EXTRA = "subgoals"
"""Where a record keeps its score, in `EpisodeRecord.extra`."""


@dataclass
class SubgoalScore:
    """Counts over the subgoals of an episode, one whenever the policy acted.

    A subgoal counts as right when its words are, points aside; points are compared where the words are right.

    chunks: times the policy acted. judged: of these, how often the environment had a subgoal to compare with.
    right: how often the words were the environment's. points, distance: points compared, and the sum of their distances
    in pixels of the front picture. asked: questions to a model. problems: unusable answers by kind.
    """

    chunks: int = 0
    judged: int = 0
    right: int = 0
    points: int = 0
    distance: float = 0.0
    asked: int = 0
    problems: Counter[str] = field(default_factory=Counter)

    def add(self, said: str | None, meant: str | None, asked: bool = False, problem: str = "") -> None:
        """Count one subgoal.

        Args:
            said: the policy's subgoal; None while there is none. meant: the environment's; None where it has none.
        """
        self.chunks += 1
        self.asked += asked
        if problem:
            self.problems[problem] += 1
        if meant is None:
            return
        self.judged += 1
        distances = point_distances(said, meant)
        if distances is not None:
            self.right += 1
            self.points += len(distances)
            self.distance += float(np.sum(distances))

    def __add__(self, other: "SubgoalScore") -> "SubgoalScore":
        counts = {name: getattr(self, name) + getattr(other, name) for name in asdict(self)}
        return SubgoalScore(**counts)

    @property
    def accuracy(self) -> float | None:
        """Share of right words, in percent; None where nothing could be judged."""
        return 100 * self.right / self.judged if self.judged else None

    @property
    def mean_distance(self) -> float | None:
        """Mean distance of points in pixels, where the words are right; None without such points."""
        return self.distance / self.points if self.points else None

    def show(self) -> tuple[str, str]:
        """Accuracy and distance with their units, for a terminal."""
        accuracy, distance = self.accuracy, self.mean_distance
        return "–" if accuracy is None else f"{accuracy:.1f} %", "–" if distance is None else f"{distance:.1f} px"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for a record."""
        return {**asdict(self), "distance": round(self.distance, 2), "problems": dict(self.problems)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Read what `to_dict` wrote.

        Raises:
            UserError: it is not a score.
        """
        try:
            return cls(**{**values, "problems": Counter(values["problems"])})
        except (TypeError, KeyError) as error:
            raise UserError(f"extra.{EXTRA} of a record is not a score of subgoals: {error}") from None


def score_of(record: EpisodeRecord) -> SubgoalScore | None:
    """What a record says of its subgoals; None for an episode without a predictor.

    Raises:
        UserError: the score is damaged.
    """
    values = record.extra.get(EXTRA)
    return None if values is None else SubgoalScore.from_dict(values)


def total_score(records: Iterable[EpisodeRecord]) -> SubgoalScore | None:
    """The sum over the episodes that have a score; None if none has."""
    scores = [score for record in records if (score := score_of(record)) is not None]
    return sum(scores, SubgoalScore()) if scores else None


def point_distances(said: str | None, meant: str) -> list[float] | None:
    """Distances in pixels between the points of two subgoals, in order; None if their words differ."""
    if said is None:
        return None
    (said_words, said_points), (meant_words, meant_points) = mark_points(said), mark_points(meant)
    if _plain(said_words) != _plain(meant_words) or len(said_points) != len(meant_points):
        return None
    return [float(np.hypot(a - c, b - d)) for (a, b), (c, d) in zip(said_points, meant_points, strict=True)]


def subgoal_tables(results: Results) -> list[Table]:
    """Subgoals of every method that has a predictor."""
    return [table for method in results.methods if (table := subgoal_table(method, results))]


def subgoal_table(method: Method, results: Results) -> Table | None:
    """Subgoals of one method per task, over all its runs; None for a method without."""
    records = [record for run in method.runs for record in run.records.values() if EXTRA in record.extra]
    if not records:
        return None
    by_task = {task: [r for r in records if r.task == task] for task in results.protocol.tasks}
    rows = [_row(task, members) for task, members in by_task.items() if members]
    rows.append(_row("all", records))
    columns = ["", "episodes", "subgoals", "right words (%)", "distance (pixels)", "asked", "unusable answers"]
    title = f"{method.label}: subgoals beside the environment's own"
    return Table(title, columns, rows, {len(rows) - 1}, {len(rows) - 1})


def _row(name: str, records: Sequence[EpisodeRecord]) -> list[str]:
    total = total_score(records) or SubgoalScore()
    problems = ", ".join(f"{count} {kind}" for kind, count in sorted(total.problems.items())) or "0"
    figures = ["–" if value is None else f"{value:.1f}" for value in (total.accuracy, total.mean_distance)]
    return [name, str(len(records)), str(total.judged), *figures, str(total.asked), problems]


def _plain(words: str) -> str:
    return " ".join(words.lower().split()).rstrip(".")
