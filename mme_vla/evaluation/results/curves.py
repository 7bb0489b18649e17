"""A curve instead of a point: success over how far a dial of `split=stress:…` is turned; the test
split is its zero.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import pandas as pd

from mme_vla.config.naming import digest
from mme_vla.envs.metadata import BASE, TWIN, read_variant
from mme_vla.envs.subtasks import MOTION, OPERATIONS, ProcessScore
from mme_vla.errors import require
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import EpisodeRecord, RunKey, merge
from mme_vla.evaluation.results.aggregate import Results, record_table
from mme_vla.evaluation.results.statistics import Interval, effective_trials, wilson
from mme_vla.evaluation.results.tables import Table, span, task_tables
from mme_vla.policy.training_identity import TrainingIdentity
from mme_vla.utils.style import COLOURS, LINE, figure, svg


@dataclass(frozen=True)
class Share:
    """Successes among episodes. rate: a mean over tasks, then over runs; interval: of it, over
    distinct episodes; both in percent.
    """

    won: int
    episodes: int
    rate: float
    interval: Interval

    def __str__(self) -> str:
        return f"{self.won}/{self.episodes}"


def count_successes(table: pd.DataFrame, confidence: float) -> Share:
    """Count the successes of a part of `record_table` that has one row at least."""
    success = table["success"]
    of_runs = success.groupby([table["run"], table["task"]], sort=False).mean()
    rate = float(of_runs.groupby(level="run", sort=False).mean().mean())
    splits = np.array([record.split for record in table["record"]])
    # Trainings share the scene of an episode.
    distinct = success.groupby([table["task"], splits, table["episode"]]).mean()
    tasks = [part.to_numpy()[:, None] for _, part in distinct.groupby(level="task")]
    interval = wilson(rate, effective_trials(tasks), confidence)
    return Share(int(success.sum()), len(table), 100 * rate, interval.percent)


Curves = dict[tuple[str, str, str], dict[float, Share]]
"""(run, task, dial) → how far it is turned, ascending → success there; no point where no episode is
at every place of the dial.
"""


class Place(NamedTuple):
    """Where a record lies on a dial: the run at the dial's zero, the dial, how far it is turned,
    and its zero. A record on no dial has an empty one.
    """

    run: RunKey
    dial: str = ""
    turned: float = 0
    zero: float = 0


def run_names(runs: Iterable[RunKey]) -> dict[RunKey, str]:
    """What curves call runs: `str(run)`, and behind it a digest where several would be called the
    same.
    """
    names = {run: str(run) for run in runs}
    counts = Counter(names.values())
    for run, name in names.items():
        if counts[name] > 1:
            training = None if run.training is None else asdict(run.training)
            kind = digest({**run._asdict(), "training": training}, 6)
            names[run] = f"{name}, #{kind}"
    return names


def stress_curves(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Curves:
    """Success over every dial that records were made with; records of the test split are at its
    zero. Twins have curves of their own.
    """

    def place(record: EpisodeRecord) -> Place:
        variant = read_variant(record.split)
        if variant is None or not variant.dial:
            return Place(record.run)
        zero = record.run._replace(split=TWIN if variant.twin else BASE)
        return Place(zero, variant.dial, variant.turned)

    curves = curves_of(merge(records, conflicts), place, confidence)
    require(
        curves,
        "None of these records is of a stress split: evaluate with split=stress:count=2, for"
        " instance.",
    )
    return curves


def curves_of(
    records: Sequence[EpisodeRecord],
    place: Callable[[EpisodeRecord], Place],
    confidence: float = 0.95,
    same_scenes: bool = False,
) -> Curves:
    """Success over every dial.

    A point counts the episodes that the model, of several trainings each, has at every place of the
    dial: one curve is of the same episodes.

    records: merged.
    place: where a record lies; one on no dial is at the zero of its run.
    same_scenes: whether a dial leaves the scene as it is, so that only equal scenes are counted;
        one that changes the scene keeps the episode's number and seed alone.
    """
    table = record_table(records)
    places = [place(record) for record in records]
    names = run_names(at.run for at in places)
    table[list(Place._fields)] = pd.DataFrame(places, columns=Place._fields)
    table["run"] = [names[at.run] for at in places]
    is_placed = table["dial"] != ""
    baselines = dict(list(table[~is_placed].groupby(["run", "task"])))
    curves: Curves = {}
    for (run, task, dial, zero), members in table[is_placed].groupby(
        ["run", "task", "dial", "zero"], sort=False
    ):
        points = dict(list(members.groupby("turned")["record"]))
        if zero not in points and (run, task) in baselines:
            points[zero] = baselines[run, task]["record"]
        sides: list[dict[tuple[TrainingIdentity | None, int], list[EpisodeRecord]]] = []
        for at in points.values():
            side: dict[tuple[TrainingIdentity | None, int], list[EpisodeRecord]] = {}
            for record in at:
                side.setdefault((record.training, record.episode), []).append(record)
            sides.append(side)
        common = set.intersection(*map(set, sides))
        if same_scenes:
            common = set(pair(sides).keys)
        curves[run, task, dial] = {}
        if not common:
            continue
        for turned, side in sorted(zip(points, sides, strict=True), key=itemgetter(0)):
            counted: list[EpisodeRecord] = []
            for key in common:
                counted += side[key]
            share = count_successes(record_table(counted), confidence)
            curves[run, task, dial][turned] = share
    return curves


def stress_table(curves: Curves, title: str = "Success over the dials") -> Table:
    """Every point, a row each, and a note on every curve without a point."""
    rows = []
    notes = []
    for (run, task, dial), points in sorted(curves.items()):
        if not points:
            notes.append(f"{run}, {task}, {dial}: no curve, since no episode is at all its places.")
        for turned, share in points.items():
            cells = [f"{turned:g}", str(share.episodes), f"{share.rate:.1f}", span(share.interval)]
            rows.append([run, task, dial, *cells])
    columns = ["run", "task", "dial", "at", "episodes", "success (%)", "interval"]
    return Table(title, columns, rows, notes=notes)


def stress_figures(
    curves: Curves,
    unit: str = "more than in the benchmark",
    training: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, str]:
    """For each task and dial a curve of every run, as SVG.

    unit: of the dial; empty where the dial's name says it.
    training: task → the range of its training episodes, which is shaded.
    """
    plotted = {curve: points for curve, points in curves.items() if points}
    groups: dict[tuple[str, str], dict[str, Mapping[float, Share]]] = {}
    for _, task, dial in sorted(plotted):
        groups[task, dial] = {}
    # Runs keep the order of the records, and with it their colours.
    for (run, task, dial), points in plotted.items():
        groups[task, dial][run] = points
    figures = {}
    for (task, dial), runs in groups.items():
        label = f"{dial}: {unit}" if unit else dial
        shaded = None if training is None else training[task]
        figures[f"{task}, {dial}"] = curve_figure(runs, label, shaded)
    return figures


def curve_figure(
    runs: Mapping[str, Mapping[float, Share]],
    label: str,
    training: tuple[float, float] | None = None,
) -> str:
    """Success over an amount, a curve of every run, as SVG.

    runs: name → amount → success.
    label: of the amount.
    training: its shaded range.
    """
    labels = distinct_parts(list(runs))
    height = 3.0 + 0.2 * len(runs)
    if training is not None:
        height += 0.2
    with figure((5.6, height)) as (canvas, (axes,)):
        if training is not None:
            axes.axvspan(*training, color=LINE, label="training range")
        for i, (name, points) in enumerate(zip(labels, runs.values(), strict=True)):
            rates = np.array([share.rate for share in points.values()])
            low, high = np.array([share.interval for share in points.values()]).T
            axes.errorbar(
                list(points),
                rates,
                np.maximum([rates - low, high - rates], 0),
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
    names = [run.split(", ") for run in runs]
    shared = set(names[0][1:])
    if len(names) > 1:
        shared = set(names[0]).intersection(*names[1:])
    labels = []
    for parts in names:
        labels.append(", ".join(part for part in parts if part not in shared))
    return labels


CAPTION = (
    "Progress: sub-tasks done, of those there are. Then how many episodes ended by a wrong choice"
    " that is a mistake of memory (which one, where, how many, in what order, how), by another"
    " wrong one, or with the time run out."
)


def process_tables(results: Results) -> list[Table]:
    """Where the chains broke, a table of every method that has scores, over all its runs."""
    columns = ["", "episodes", "progress (%)", "success", *OPERATIONS, MOTION, "stuck"]
    return task_tables(results, "process", "where the chain broke", columns, _row)


def _row(name: str, records: Sequence[EpisodeRecord]) -> list[str]:
    progress: list[float] = []
    ends: Counter[str] = Counter()
    for record in records:
        if record.process is not None:
            score = ProcessScore.from_dict(record.process)
            progress.append(score.done / max(score.of, 1))
            ends[score.operation or score.broke or "success"] += 1
    counts = [str(ends[kind] or "–") for kind in ("success", *OPERATIONS, MOTION, "stuck")]
    return [name, str(len(progress)), f"{100 * np.mean(progress):.1f}", *counts]
