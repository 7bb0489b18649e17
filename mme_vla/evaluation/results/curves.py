"""A curve instead of a point: success over how far a dial of `split=stress:…` is turned; the test
split is its zero.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mme_vla.envs.metadata import BASE, read_variant
from mme_vla.envs.subtasks import MOTION, OPERATIONS, ProcessScore
from mme_vla.errors import require
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import EpisodeRecord, RunKey, merge
from mme_vla.evaluation.results.aggregate import Interval, Results, wilson
from mme_vla.evaluation.results.plots import COLOURS, figure, svg
from mme_vla.evaluation.results.tables import Table, task_tables


@dataclass(frozen=True)
class Point:
    """Success of a model on a task at one place of a dial. interval: Wilson's, over distinct
    episodes; in percent.
    """

    turned: float
    won: int
    episodes: int
    interval: Interval

    @property
    def rate(self) -> float:
        """In percent."""
        return 100 * self.won / self.episodes


Curves = dict[tuple[str, str, str], list[Point]]  # (model, task, dial) → points, ascending


class Place(NamedTuple):
    """Where a record lies on a dial: the run at the dial's zero, the dial, how far it is turned,
    and its zero.
    """

    run: RunKey
    dial: str
    turned: float
    zero: float = 0


def stress_curves(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Curves:
    """Success over every dial that records were made with; records of the test split are at its
    zero.
    """

    def place(record: EpisodeRecord) -> Place | None:
        variant = read_variant(record.split)
        if variant is None or not variant.dial:
            return None
        return Place(record.run._replace(split=BASE), variant.dial, variant.turned)

    curves = curves_of(merge(records, conflicts), place, confidence)
    require(
        curves,
        "None of these records is of a stress split: evaluate with split=stress:count=2, for"
        " instance.",
    )
    return curves


def curves_of(
    records: Sequence[EpisodeRecord],
    place: Callable[[EpisodeRecord], Place | None],
    confidence: float = 0.95,
    same_scenes: bool = False,
) -> Curves:
    """Success over every dial.

    A point counts the episodes that the model has at every place of the dial: one curve is of the
    same episodes.

    records: merged. place: where a record lies; None for a record that lies on none, or at the
    zero. same_scenes:
        whether a dial leaves the scene as it is, so that only equal scenes are counted; one that
        changes the scene keeps the episode's number and seed alone.
    """
    groups: dict[tuple[str, str, str, float], dict[float, list[EpisodeRecord]]] = {}
    for record in records:
        if (at := place(record)) is not None:
            group = groups.setdefault((str(at.run), record.task, at.dial, at.zero), {})
            group.setdefault(at.turned, []).append(record)
    curves: Curves = {}
    for (run, task, dial, zero), places in groups.items():
        baseline = [r for r in records if r.task == task and str(r.run) == run]
        if baseline and zero not in places:
            places[zero] = baseline
        common = set.intersection(*({r.episode for r in there} for there in places.values()))
        if same_scenes:
            common = set(pair([_by_episode(there) for there in places.values()]).keys)
        curves[run, task, dial] = [
            _point(turned, [r for r in there if r.episode in common], confidence)
            for turned, there in sorted(places.items())
            if common
        ]
    return {name: points for name, points in curves.items() if points}


def _by_episode(records: Sequence[EpisodeRecord]) -> dict[int, list[EpisodeRecord]]:
    episodes: dict[int, list[EpisodeRecord]] = {}
    for record in records:
        episodes.setdefault(record.episode, []).append(record)
    return episodes


def _point(turned: float, records: Sequence[EpisodeRecord], confidence: float) -> Point:
    won = sum(record.success for record in records)
    low, high = wilson(won / len(records), len({record.episode for record in records}), confidence)
    return Point(turned, won, len(records), Interval(100 * low, 100 * high))


def stress_table(curves: Curves, title: str = "Success over the dials") -> Table:
    """Every point, a row each."""
    rows = []
    for (run, task, dial), points in sorted(curves.items()):
        for p in points:
            interval = f"[{p.interval.low:.1f}, {p.interval.high:.1f}]"
            rows.append(
                [run, task, dial, f"{p.turned:g}", str(p.episodes), f"{p.rate:.1f}", interval]
            )
    return Table(title, ["run", "task", "dial", "at", "episodes", "success (%)", "interval"], rows)


def stress_figures(curves: Curves, unit: str = "more than in the benchmark") -> dict[str, str]:
    """For each task and dial a curve of every run, as SVG."""
    figures = {}
    for task, dial in dict.fromkeys((task, dial) for _, task, dial in sorted(curves)):
        runs = {
            run: [(p.turned, p.rate, p.interval) for p in points]
            for (run, its, of), points in curves.items()
            if (its, of) == (task, dial)
        }
        figures[f"{task}, {dial}"] = curve_figure(runs, f"{dial}: {unit}")
    return figures


def curve_figure(
    runs: Mapping[str, Sequence[tuple[float, float, Interval]]],
    label: str,
    training: tuple[float, float] | None = None,
) -> str:
    """Success over an amount, a curve of every run, as SVG.

    runs: name → amount, success in percent and its interval. label: of the amount. training: its
    shaded range.
    """
    with figure((5.6, 3.0 + 0.2 * (len(runs) + (training is not None)))) as (canvas, (axes,)):
        if training is not None:
            axes.axvspan(*training, color="0.9", label="training range")
        for i, (name, points) in enumerate(
            zip(distinct_parts(list(runs)), runs.values(), strict=True)
        ):
            amounts, rates, intervals = zip(*points, strict=True)
            below = [
                max(rate - interval.low, 0) for rate, interval in zip(rates, intervals, strict=True)
            ]
            above = [
                max(interval.high - rate, 0)
                for rate, interval in zip(rates, intervals, strict=True)
            ]
            axes.errorbar(
                amounts,
                rates,
                [below, above],
                fmt="-o",
                ms=5,
                capsize=3,
                color=COLOURS[i % len(COLOURS)],
                label=name,
            )
        axes.set_xlabel(label)
        axes.set_ylabel("success (%)")
        axes.set_ylim(0, 100)
        canvas.legend(fontsize=8, loc="outside lower left")
        return svg(canvas)


def distinct_parts(runs: Sequence[str]) -> list[str]:
    """The names of runs without what all of them share, for a legend; of one run its first part,
    the model.
    """
    parts = [run.split(", ") for run in runs]
    shared = set.intersection(*map(set, parts)) if len(parts) > 1 else set(parts[0][1:])
    return [", ".join(part for part in its if part not in shared) for its in parts]


EXTRA = "process"  # Where a record keeps it
CAPTION = (
    "Progress: sub-tasks done, of those there are. Then how many episodes ended by a wrong choice"
    " that is a mistake of memory (which one, where, how many, in what order, how), by another"
    " wrong one, or with the time run out."
)


def process_of(record: EpisodeRecord) -> ProcessScore | None:
    """The score in a record; None for episodes whose environment reports none."""
    value = record.extra.get(EXTRA)
    return None if value is None else ProcessScore.from_dict(value)


def process_tables(results: Results) -> list[Table]:
    """Where the chains broke, a table of every method that has scores, over all its runs."""
    columns = ["", "episodes", "progress (%)", "success", *OPERATIONS, MOTION, "stuck"]
    return task_tables(results, EXTRA, "where the chain broke", columns, _row)


def _row(name: str, records: Sequence[EpisodeRecord]) -> list[str]:
    scores = [score for record in records if (score := process_of(record)) is not None]
    progress = 100 * np.mean([score.done / max(score.of, 1) for score in scores])
    ends = Counter(score.operation or score.broke or "success" for score in scores)
    counts = [ends[kind] for kind in ("success", *OPERATIONS, MOTION, "stuck")]
    return [
        name,
        str(len(scores)),
        f"{progress:.1f}",
        *("–" if not count else str(count) for count in counts),
    ]
