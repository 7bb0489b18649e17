"""The page of a nano run: success beside its brackets, the paired test, minutes and learning curves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mme_vla.evaluation.record_log import find_records, read_folders
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import Method, Results, aggregate
from mme_vla.evaluation.results.compare import Comparison, common_episodes, compare_all
from mme_vla.evaluation.results.intervals import wilson
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.tables import comparison_table, to_markdown
from mme_vla.files import write_atomically
from mme_vla.nano.fitting import learning_curve

PAGE, CURVES = "page.md", "learning.png"
LEVELS = ("easy", "medium", "hard")


def write_page(folder: Path, config: Mapping[str, Any], models: Sequence[str], minutes: Mapping[str, float]) -> Path:
    """Write `page.md` and the plot beside it into the run's folder.

    Args:
        models: the one with memory first. minutes: wall minutes of each stage.
    """
    records = read_folders(find_records([folder / model / config["split"] for model in models]))
    results, comparisons = compared(records, config["task"], config["split"])
    plot_curves({model: learning_curve(folder / model) for model in models}, folder / CURVES)
    parts = [
        f"# {config['task']} on two cores",
        "",
        f"{sum(config['demonstrations'].values())} demonstrations, {config['train']['steps']} updates, split "
        f"`{config['split']}`; each episode once for each of the seeds {', '.join(map(str, config['policy_seeds']))} "
        "of the policy's noise.",
        "",
        success_table(records),
        "",
        *([to_markdown(comparison_table(comparisons))] if comparisons else []),
        *[f"- {comparison.verdict}" for comparison in comparisons],
        *[f"- {note}" for note in results.notes],
        "",
        "| stage | wall minutes |",
        "| --- | ---: |",
        *[f"| {stage} | {spent:.1f} |" for stage, spent in minutes.items()],
        "",
        f"![Loss on held-out demonstrations]({CURVES})",
        "",
    ]
    with write_atomically(folder / PAGE) as draft:
        draft.write_text("\n".join(parts), encoding="utf-8")
    return folder / PAGE


def compared(records: Sequence[EpisodeRecord], task: str, split: str) -> tuple[Results, list[Comparison]]:
    """What the records say of one task, and the first method against each other one that shares episodes with it."""
    protocol = Protocol((task,))
    results = aggregate(records, protocol, split)
    first, *others = results.methods
    pairs: list[tuple[Method, Method]] = [(first, other) for other in others if common_episodes(first, other)]
    return results, compare_all(pairs, protocol)


def success_table(records: Sequence[EpisodeRecord]) -> str:
    """Success of each model, in all and by difficulty: won / run, and Wilson's interval of the distinct episodes."""
    lines = ["| model | " + " | ".join(("all", "95 % interval", *LEVELS)) + " |", "| --- " + "| ---: " * 5 + "|"]
    for model in dict.fromkeys(record.model for record in records):
        own = [record for record in records if record.model == model]
        rate, episodes = _won(own) / len(own), len({record.episode for record in own})
        interval = wilson(rate, episodes)
        levels = [[record for record in own if record.difficulty == level] for level in LEVELS]
        cells = [f"{_won(part)}/{len(part)}" if part else "" for part in (own, *levels)]
        shown = f"{100 * rate:.0f} % ({cells[0]})"
        spread = f"{100 * interval.low:.0f} … {100 * interval.high:.0f} %"
        lines.append("| " + " | ".join((model, shown, spread, *cells[1:])) + " |")
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
