"""Predicted subgoals against the environment's own: whether the text is right, and how far the
points are off.
"""

import json
import shutil
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import Results
from mme_vla.evaluation.results.tables import Table, task_tables
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode
from mme_vla.subgoal.oracle import online_subgoal
from mme_vla.subgoal.text import mark_points


@dataclass
class SubgoalScore:
    """Counts over the subgoals of an episode, one whenever the policy acted.

    A subgoal is right when its text without points is; points are compared where the text is right.

    chunks: times the policy acted.
    judged: of these, how often the environment had a subgoal to compare with.
    right: how often the text was the environment's.
    points, distance: points compared, and the sum of their distances in pixels of the front image.
    asked: questions to a model.
    problems: unusable replies by kind.
    """

    chunks: int = 0
    judged: int = 0
    right: int = 0
    points: int = 0
    distance: float = 0.0
    asked: int = 0
    problems: Counter[str] = field(default_factory=Counter)

    def add(
        self, predicted: str | None, meant: str | None, queried: bool = False, problem: str = ""
    ) -> None:
        """Count one subgoal.

        predicted: the policy's subgoal; None while there is none.
        meant: the environment's; None where it has none.
        """
        self.chunks += 1
        self.asked += queried
        if problem:
            self.problems[problem] += 1
        if meant is None:
            return
        self.judged += 1
        distances = point_distances(predicted, meant)
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
        """Mean distance of points in pixels, where the words are right; None without
        such points.
        """
        return self.distance / self.points if self.points else None

    def show(self) -> list[str]:
        """Accuracy and distance as cells of a table."""
        values = (self.accuracy, self.mean_distance)
        return ["–" if value is None else f"{value:.1f}" for value in values]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for a record."""
        return {
            **asdict(self),
            "distance": round(self.distance, 2),
            "problems": dict(self.problems),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Read what `to_dict` wrote."""
        try:
            return cls(**{**values, "problems": Counter(values["problems"])})
        except (TypeError, KeyError) as error:
            raise UserError(f"subgoals of a record is not a score of subgoals: {error}") from None


def total_score(records: Iterable[EpisodeRecord]) -> SubgoalScore | None:
    """The sum over the episodes that had a predictor; None if none had."""
    total = None
    for record in records:
        if record.subgoals is not None:
            total = (total or SubgoalScore()) + SubgoalScore.from_dict(record.subgoals)
    return total


def point_distances(predicted: str | None, meant: str) -> list[float] | None:
    """Distances in pixels between the points of two subgoals, in order; None if their
    words differ.
    """
    if predicted is None:
        return None
    words, points = mark_points(predicted)
    meant_words, meant_points = mark_points(meant)
    if _normalised(words) != _normalised(meant_words) or len(points) != len(meant_points):
        return None
    distances = []
    for (x, y), (meant_x, meant_y) in zip(points, meant_points, strict=True):
        distances.append(float(np.hypot(x - meant_x, y - meant_y)))
    return distances


def subgoal_tables(results: Results) -> list[Table]:
    """Subgoals of every method that has a predictor, per task, over all its runs."""
    columns = [
        "", "episodes", "subgoals", "right words (%)", "distance (pixels)", "asked",
        "unusable answers",
    ]  # fmt: skip
    return task_tables(results, "subgoals", "subgoals beside the environment's own", columns, _row)


def _row(name: str, records: Sequence[EpisodeRecord]) -> list[str]:
    total = total_score(records) or SubgoalScore()
    cells = [name, str(len(records)), str(total.judged), *total.show(), str(total.asked)]
    problems = [f"{count} {kind}" for kind, count in sorted(total.problems.items())]
    cells.append(", ".join(problems) or "0")
    return cells


def _normalised(words: str) -> str:
    return " ".join(words.lower().split()).rstrip(".")


SUBGOALS = "subgoals"  # Name of the folder within a run


class SubgoalTrace:
    """Scores the subgoals of an episode and, given a folder, writes them down as they come.

    `<folder>/<name>.jsonl` has a line for each time the policy acted, `<folder>/<name>/<step>.jpg`
    the image it acted on. A subgoal that was kept, or came in the background, is older:
    `asked_step` is the step of its question. What an earlier try of the same episode left there is
    replaced.

    kind: `simple` or `grounded`.
    folder: None keeps the score alone.
    name: of the episode.
    """

    def __init__(self, kind: str, folder: Path | None, name: str) -> None:
        self.score = SubgoalScore()
        self._kind = kind
        self._name = name
        self._file: Path | None = None
        self._meant: str | None = None
        self._begun = time.perf_counter()
        if folder is not None:
            shutil.rmtree(folder / name, ignore_errors=True)
            (folder / name).mkdir(parents=True, exist_ok=True)
            self._file = folder / f"{name}.jsonl"
            self._file.write_bytes(b"")

    def add(self, episode: SubgoalEpisode, subgoal: Subgoal, latency_s: float) -> None:
        """Note the subgoal that the policy acts on now.

        episode: as the predictor knows it, its last frame and report the current ones.
        latency_s: seconds the policy waited for it.
        """
        # Between two sub-tasks the environment names none, and the last one stays, as in training.
        self._meant = online_subgoal(episode.info, self._kind) or self._meant
        self.score.add(subgoal.text, self._meant, subgoal.queried, subgoal.problem)
        if self._file is None:
            return
        from PIL import Image

        image_name = f"{self._name}/{episode.step:05d}.jpg"
        Image.fromarray(episode.frame).save(self._file.parent / image_name, quality=90)
        line = {
            "step": episode.step,
            "seconds": round(time.perf_counter() - self._begun, 3),
            "latency_s": round(latency_s, 4),
            "when": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "text": subgoal.text,
            "points": subgoal.points,
            "oracle": self._meant,
            "asked": subgoal.queried,
            "asked_step": episode.query_step,
            "answer": subgoal.reply,
            "problem": subgoal.problem,
            "image": image_name,
        }
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")
