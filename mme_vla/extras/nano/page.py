"""The page of a nano run: success beside its brackets, the paired test, minutes and learning
curves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.envs.rows import DIFFICULTIES
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import Method, Results, aggregate
from mme_vla.evaluation.results.compare import (
    Comparison,
    common_episodes,
    compare_all,
    why_unpaired,
)
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.statistics import Interval, wilson
from mme_vla.evaluation.results.tables import comparison_table, to_markdown
from mme_vla.extras.nano.evaluating import PLANNER
from mme_vla.extras.nano.fitting import learning_curve
from mme_vla.extras.nano.rows import TRAINED
from mme_vla.utils import read_json, write_atomically
from mme_vla.utils.pages import render

PAGE, CURVES = "page.md", "learning.png"


def write_page(
    folder: Path,
    config: Mapping[str, Any],
    records: Mapping[str, Sequence[EpisodeRecord]],
    without: str | None,
    minutes: Mapping[str, float],
    videos: Sequence[Path],
    runs: Mapping[str, Sequence[Path]],
    demonstrations: int,
) -> Path:
    """Write `page.md` and the plot beside it into the run's folder.

    records: of each model, the one with memory first, and of the oracle planner. without: the one
    without memory, which all others are compared with. minutes: of each stage, on the clock.
    videos: one of a success, one of a failure, as far as there are such. runs: of each model, the
    folders of its trainings. demonstrations: how many they learned from.
    """
    ends = {
        model: [read_json(run / TRAINED, "a training's end") for run in folders]
        for model, folders in runs.items()
    }
    results, comparisons = compared(records, config["task"], config["split"], without)
    curves = {
        model if len(folders) == 1 else f"{model}, {run.name}": learning_curve(run)
        for model, folders in runs.items() for run in folders
    }  # fmt: skip
    plot_curves(curves, folder / CURVES)
    text = render(
        "nano.md",
        config=config,
        demonstrations=demonstrations,
        seeds=str(config["policy_seed"]),
        planner=PLANNER,
        without=without,
        success=success_table(records, ends, results),
        comparison=to_markdown(comparison_table(comparisons)) if comparisons else "",
        verdicts=[comparison.verdict for comparison in comparisons],
        notes=results.notes,
        minutes=minutes,
        curves=CURVES,
        videos=[(video.stem, video.relative_to(folder)) for video in videos],
    )
    with write_atomically(folder / PAGE) as draft:
        draft.write_text(text, encoding="utf-8")
    return folder / PAGE


def compared(
    records: Mapping[str, Sequence[EpisodeRecord]], task: str, split: str, without: str | None
) -> tuple[Results, list[Comparison]]:
    """What the records say of one task, and each model against the one without memory on the
    episodes of both.

    With none without memory: the first model against each other one.
    """
    every = [record for model_records in records.values() for record in model_records]
    numbers = {
        episode: number
        for number, episode in enumerate(sorted({record.episode for record in every}))
    }
    every = [replace(record, episode=numbers[record.episode]) for record in every]
    protocol = Protocol((task,), len(numbers))
    results = aggregate(every, protocol, split)
    methods = {
        model: _method(results, model_records[0])
        for model, model_records in records.items()
        if model != PLANNER
    }
    fixed = next(iter(methods)) if without is None else without
    others = [method for model, method in methods.items() if model != fixed]
    pairs = [
        (methods[fixed], other) if without is None else (other, methods[fixed]) for other in others
    ]
    results.notes += [why_unpaired(*pair) for pair in pairs if not common_episodes(*pair)]
    comparisons = compare_all([pair for pair in pairs if common_episodes(*pair)], protocol)
    results.notes += [note for comparison in comparisons for note in comparison.notes]
    return results, comparisons


def _method(results: Results, record: EpisodeRecord) -> Method:
    return next(
        method for method in results.methods if any(run.key == record.run for run in method.runs)
    )


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
    columns = (
        "memory tokens",
        "all",
        "95 % interval",
        *DIFFICULTIES,
        "off by, held out",
        "within 2 cm",
    )
    lines = ["| model | " + " | ".join(columns) + " |", "| --- " + "| ---: " * len(columns) + "|"]
    for model, model_records in records.items():
        rate, episodes = (
            _won(model_records) / len(model_records),
            len({record.episode for record in model_records}),
        )
        interval = wilson(rate, episodes)
        levels = [
            [record for record in model_records if record.difficulty == level]
            for level in DIFFICULTIES
        ]
        cells = [f"{_won(part)}/{len(part)}" if part else "" for part in (model_records, *levels)]
        deviation = ""
        average = _method(results, model_records[0]).average
        if (
            len(ends.get(model, ())) > 1
            and average.std is not None
            and average.interval is not None
        ):
            deviation, interval = (
                f" ± {average.std:.0f}",
                Interval(*(value / 100 for value in average.interval)),
            )
        success = f"{100 * rate:.0f}{deviation} % ({cells[0]})"
        confidence = f"{100 * interval.low:.0f} … {100 * interval.high:.0f} %"
        measured = [
            end["off_by_m"] for end in ends.get(model, ()) if end.get("off_by_m") is not None
        ]
        off = np.concatenate(measured) if measured else None
        errors = (
            ("", "")
            if off is None
            else (f"{100 * np.median(off):.1f} cm", f"{100 * np.mean(off <= 0.02):.0f} %")
        )
        row = (
            model_records[0].model,
            model_records[0].memory_budget or "",
            success,
            confidence,
            *cells[1:],
            *errors,
        )
        lines.append("| " + " | ".join(map(str, row)) + " |")
    return "\n".join(lines)


def _won(records: Sequence[EpisodeRecord]) -> int:
    return sum(record.success for record in records)


def plot_curves(curves: Mapping[str, Sequence[Mapping[str, float]]], path: Path) -> None:
    """The loss on held-out demonstrations against updates, a line a model."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.2), dpi=120)
    for model, curve in curves.items():
        points = [(line["step"], line["val/loss"]) for line in curve if "val/loss" in line]
        axes.plot(*zip(*points, strict=True), label=model) if points else None
    axes.set(xlabel="updates", ylabel="loss on held-out demonstrations", yscale="log")
    axes.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)
