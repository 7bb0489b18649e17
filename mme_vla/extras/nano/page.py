"""The page of a nano run: success beside its brackets, the paired test, minutes and learning
curves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, compress
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.envs.rows import DIFFICULTIES
from mme_vla.errors import counted
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import Method, Results, aggregate
from mme_vla.evaluation.results.compare import (
    Comparison,
    compare_all,
    pair_methods,
    why_unpaired,
)
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.statistics import Interval, wilson
from mme_vla.evaluation.results.tables import Table, comparison_table, to_markdown
from mme_vla.extras.nano.evaluating import PLANNER
from mme_vla.extras.nano.fitting import learning_curve
from mme_vla.extras.nano.rows import TRAINED
from mme_vla.extras.nano.settings import NanoRun
from mme_vla.utils import read_json, write_text
from mme_vla.utils.pages import render
from mme_vla.utils.style import figure, legend, log_scale

PAGE, CURVES = "page.md", "learning.png"
FEW_POINTS = 12  # of a curve, below which each has a marker
FEW_EPISODES = 100  # below which a percentage says more than was seen, and counts stand beside it


def write_page(
    folder: Path,
    nano: NanoRun,
    records: Mapping[str, Sequence[EpisodeRecord]],
    without: str | None,
    minutes: Mapping[str, float],
    videos: Sequence[Path],
    runs: Mapping[str, Sequence[Path]],
    demonstrations: int,
) -> Path:
    """Write `page.md` and the plot beside it into the run's folder.

    records: of each model, the one with memory first, and of the oracle planner.
    without: the one without memory, which all others are compared with.
    minutes: of each stage, on the clock.
    videos: one of a success, one of a failure, as far as there are such.
    runs: of each model, the folders of its trainings.
    demonstrations: how many they learned from.
    """
    results, comparisons = compared(records, nano.task, nano.split, without)
    lead = [comparison.verdict for comparison in comparisons]
    if not lead:  # there is no other model to compare the first one with
        first = next(iter(records.values()))
        won = sum(record.success for record in first)
        lead = [f"{first[0].model} {won} of {counted(len(first), 'episode')}"]
    ends = ends_of(runs)
    curves: dict[str, list[dict[str, float]]] = {}
    for model, folders in runs.items():
        for run in folders:
            label = model if len(folders) == 1 else f"{model}, {run.name}"
            curves[label] = learning_curve(run)
    has_curves = plot_curves(curves, folder / CURVES)
    text = render(
        "nano.md",
        config=nano.config,
        demonstrations=demonstrations,
        planner=PLANNER if PLANNER in records else None,
        without=without,
        success=success_table(records, ends, results),
        comparison=to_markdown(pairs_table(comparisons)) if comparisons else "",
        lead=lead,
        notes=results.notes,
        minutes={stage: spent for stage, spent in minutes.items() if round(spent, 1) > 0},
        curves=CURVES if has_curves else None,
        videos=[(video.stem, video.relative_to(folder)) for video in videos],
    )
    write_text(folder / PAGE, text)
    return folder / PAGE


def ends_of(runs: Mapping[str, Sequence[Path]]) -> dict[str, list[Any]]:
    """Of each model, what each of its trainings wrote at its end. runs: the trainings' folders."""
    ends: dict[str, list[Any]] = {}
    for model, folders in runs.items():
        ends[model] = [read_json(run / TRAINED, "a training's end") for run in folders]
    return ends


def outcome_lines(
    records: Mapping[str, Sequence[EpisodeRecord]], ends: Mapping[str, Sequence[Mapping[str, Any]]]
) -> list[str]:
    """What came out, a line a model: how far off its held-out decisions were, and its episodes."""
    lines = []
    for model, model_records in records.items():
        parts = []
        distances = _position_errors(ends.get(model, ()))
        if len(distances):
            centimetres = 100 * np.median(distances)
            parts.append(f"off by {centimetres:.1f} cm on held-out decisions")
        won = sum(record.success for record in model_records)
        parts.append(f"{won} of {counted(len(model_records), 'episode')} solved")
        lines.append(f"{model}: {', '.join(parts)}")
    return lines


def _position_errors(ends: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """How far off held-out decisions were in all trainings of a model, in metres; empty where none
    was measured.
    """
    distances: list[float] = []
    for end in ends:
        distances += end.get("off_by_m") or ()
    return np.array(distances)


def compared(
    records: Mapping[str, Sequence[EpisodeRecord]], task: str, split: str, without: str | None
) -> tuple[Results, list[Comparison]]:
    """What the records say of one task, and each model against the one without memory on the
    episodes of both.

    With none without memory: the first model against each other one.
    """
    # A protocol numbers its episodes from 0; the scenes that can be built have gaps.
    pooled = list(chain.from_iterable(records.values()))
    episodes = sorted({record.episode for record in pooled})
    numbers = {episode: number for number, episode in enumerate(episodes)}
    protocol = Protocol((task,), len(numbers))
    renumbered = [replace(record, episode=numbers[record.episode]) for record in pooled]
    results = aggregate(renumbered, protocol, split)

    methods = {}
    for model, model_records in records.items():
        if model != PLANNER:
            methods[model] = _method(results, model_records[0])
    baseline = methods.pop(next(iter(methods)) if without is None else without)
    pairs = []
    for method in methods.values():
        pair = (baseline, method) if without is None else (method, baseline)
        if pair_methods(*pair).keys:
            pairs.append(pair)
        else:
            results.notes.append(why_unpaired(*pair))
    comparisons = compare_all(pairs, protocol)
    for comparison in comparisons:
        results.notes += comparison.notes
    return results, comparisons


def pairs_table(comparisons: Sequence[Comparison]) -> Table:
    """The table of comparisons; of few episodes with the number solved of each side."""
    table = comparison_table(comparisons)
    for comparison, row in zip(comparisons, table.rows, strict=True):
        if comparison.paired and comparison.episodes < FEW_EPISODES:
            counts = (comparison.first_solved, comparison.second_solved)
            for column, count in zip(("first", "second"), counts, strict=True):
                rate = 100 * count / comparison.episodes
                text = f"{count:.3g} of {comparison.episodes} ({rate:.0f} %)"
                row[table.columns.index(column)] = text
    return table


def _method(results: Results, record: EpisodeRecord) -> Method:
    """The method to which a record's run belongs."""
    for method in results.methods:
        if record.run in [run.key for run in method.runs]:
            return method
    raise KeyError(record.run)


def success_table(
    records: Mapping[str, Sequence[EpisodeRecord]],
    ends: Mapping[str, Sequence[Mapping[str, Any]]],
    results: Results,
) -> str:
    """Success of each model, in all and by difficulty: won / run, and Wilson's interval of the
    distinct episodes.

    Of several trainings: their mean ± deviation, and the interval over episodes and trainings.
    ends: of each trained model, what each training wrote: how far off its held-out decisions to go
    elsewhere were.
    """
    columns = ["memory tokens", "all", "95 % interval", *DIFFICULTIES]
    columns += ["off by, held out", "within 2 cm"]
    rows = []
    for model, model_records in records.items():
        # Success with its interval
        won = sum(record.success for record in model_records)
        n_episodes = len({record.episode for record in model_records})
        rate = won / len(model_records)
        interval = wilson(rate, n_episodes)
        deviation = ""
        average = _method(results, model_records[0]).average
        several = len(ends.get(model, ())) > 1
        if several and average.std is not None and average.interval is not None:
            deviation = f" ± {average.std:.0f}"
            low, high = average.interval
            interval = Interval(low / 100, high / 100)
        cells = [
            model_records[0].model,
            str(model_records[0].memory_budget or ""),
            f"{100 * rate:.0f}{deviation} % ({won}/{len(model_records)})",
            f"{100 * interval.low:.0f} … {100 * interval.high:.0f} %",
        ]
        # The same by difficulty
        for level in DIFFICULTIES:
            outcomes = [record.success for record in model_records if record.difficulty == level]
            cells.append(f"{sum(outcomes)}/{len(outcomes)}" if outcomes else "")
        # Distances on held-out decisions
        distances = _position_errors(ends.get(model, ()))
        if len(distances):
            within = 100 * np.mean(distances <= 0.02)
            cells += [f"{100 * np.median(distances):.1f} cm", f"{within:.0f} %"]
        else:
            cells += ["", ""]
        rows.append(cells)
    # A run of easy scenes has no columns of the others.
    filled = [any(column) for column in zip(*rows, strict=True)]
    rows = [list(compress(cells, filled)) for cells in (["model", *columns], *rows)]
    rows.insert(1, ["---", *["---:"] * (sum(filled) - 1)])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows)


def plot_curves(curves: Mapping[str, Sequence[Mapping[str, float]]], path: Path) -> bool:
    """Draw the loss on held-out demonstrations over updates, a line a training.

    Returns:
        Whether there was a loss to draw.
    """
    from matplotlib.ticker import MaxNLocator

    measured: dict[str, list[tuple[float, float]]] = {}
    losses: list[float] = []
    every_step: set[float] = set()
    for model, curve in curves.items():
        for line in curve:
            if "val/loss" in line:
                measured.setdefault(model, []).append((line["step"], line["val/loss"]))
                losses.append(line["val/loss"])
                every_step.add(line["step"])
    if not measured:
        return False
    with figure((6.4, 3.4)) as (canvas, (axes,)):
        for model, points in measured.items():
            # A line of few points shows which of it was measured.
            marker = "o" if len(points) <= FEW_POINTS else None
            axes.plot(*zip(*points, strict=True), marker=marker, ms=4, label=model)
        if min(losses) > 0 and max(losses) > 10 * min(losses):
            log_scale(axes.yaxis)
        else:
            axes.set_ylim(bottom=0)
            axes.yaxis.set_major_formatter("{x:g}")
        if len(every_step) <= FEW_POINTS // 2:
            axes.set_xticks(sorted(every_step))
        else:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.set_xlabel("updates")
        axes.set_ylabel("loss, held out")
        legend(canvas, axes, 2)
        canvas.savefig(path)
    return True
