"""The report's figures, as SVG text that is in a page by itself."""

from collections.abc import Sequence

import numpy as np

from mme_vla.evaluation.results import paper
from mme_vla.evaluation.results.aggregate import Figure, Method, Results
from mme_vla.utils.style import (
    CARD,
    COLOURS,
    FAINT,
    INK,
    LINE,
    ON_DARK,
    ON_LIGHT,
    figure,
    legend,
    log_scale,
    svg,
)

FAMILIES = {
    "none": COLOURS[5],
    "symbolic": COLOURS[6],
    "perceptual": COLOURS[0],
    "recurrent": COLOURS[3],
    "prior": COLOURS[4],
}
PALE = 0.35  # opacity of what lacks episodes
MOST_BARS = 8
MOST_TASK_BARS = 6  # tasks that have bars; more are in the heat map
SWEPT = ("framesamp_modul", "tokendrop_modul")  # Models whose memory budget the paper varies


def bars(results: Results, kind: str, wide: bool = False) -> str:
    """Success of every task, suite, functional group or difficulty, a bar a method; black lines are
    the paper's numbers.

    Whiskers are the confidence intervals. A bar without all episodes is pale, and says how many
    there are. Beyond `MOST_BARS` methods the tables and the heat map have to do.
    """
    # The number of a method decides its colour, in all figures.
    having: list[tuple[int, Method]] = []
    for i, method in enumerate(results.methods):
        if any(figure.done for figure in method.figures.get(kind, {}).values()):
            having.append((i, method))
    having = having[:MOST_BARS]
    names: dict[str, None] = {}
    for _, method in having:
        names |= dict.fromkeys(method.figures[kind])
    width = 0.8 / max(len(having), 1)
    with figure((10.4, 3.8) if wide else (5.6, 3.6)) as (canvas, (axes,)):
        lines: list[tuple[float, float]] = []  # place, and the paper's number
        for place, (i, method) in enumerate(having):
            shift = (place - (len(having) - 1) / 2) * width
            points: list[tuple[float, Figure]] = []
            for j, name in enumerate(names):
                estimate = method.figures[kind].get(name)
                if estimate is None:
                    continue
                points.append((j + shift, estimate))
                if estimate.paper is not None:
                    lines.append((j + shift, estimate.paper.mean))
            xs, heights, gaps = _with_intervals(points)
            axes.scatter([], [], s=70, marker="s", color=_colour(i), label=method.label)
            for at, estimate in points:
                if estimate.value is None:
                    continue
                alpha = PALE if estimate.is_pale else 1.0
                axes.bar(at, estimate.value, 0.88 * width, color=_colour(i), alpha=alpha)
                if estimate.is_pale:
                    # At the foot, beside the whisker
                    axes.annotate(
                        f"n={estimate.done}",
                        (at - 0.42 * width, 0),
                        (0, 3),
                        textcoords="offset points",
                        fontsize=8,
                    )
            axes.errorbar(xs, heights, gaps, fmt="none", ecolor=INK, elinewidth=0.9)
        if lines:
            at, means = np.array(lines).T
            half = 0.46 * width
            axes.hlines(means, at - half, at + half, color=INK, lw=2, label="paper")
        # A name of several words is two lines.
        axes.set_xticks(range(len(names)), [name.replace(" ", "\n", 1) for name in names])
        axes.set_ylabel("success (%)")
        axes.set_ylim(0, 100)
        axes.tick_params(axis="x", length=0)
        legend(canvas, axes, 6 if wide else 3)
        return svg(canvas)


def heat_map(results: Results) -> str:
    """Methods × tasks; under each method that the paper reports, the paper's numbers."""
    tasks = results.protocol.tasks
    rows: list[tuple[str, list[float | None]]] = []
    pale: dict[tuple[int, int], int] = {}  # row and column of a pale cell → its episodes
    for method in results.methods:
        figures = [method.figures["task"][task] for task in tasks]
        for column, estimate in enumerate(figures):
            if estimate.is_pale and estimate.value is not None:
                pale[len(rows), column] = estimate.done
        rows.append((method.label, [estimate.value for estimate in figures]))
        if method.paper is not None:
            reported: list[float | None] = []
            for estimate in figures:
                reported.append(None if estimate.paper is None else estimate.paper.mean)
            rows.append(("paper", reported))
    names, cells = zip(*rows, strict=True)
    values = np.array(cells, float)  # None is NaN
    with figure((0.62 * len(tasks) + 2.4, 0.34 * len(rows) + 1.7)) as (canvas, (axes,)):
        opacity = np.ones(values.shape)
        for place in pale:
            opacity[place] = PALE
        axes.imshow(values, cmap="GnBu", vmin=0, vmax=100, aspect="auto", alpha=opacity)
        for i, j in np.ndindex(values.shape):
            text = f"{values[i, j]:.0f}"
            colour = ON_LIGHT
            if np.isnan(values[i, j]):
                text = "–"
                colour = FAINT
            elif (i, j) in pale:
                text += f" ({pale[i, j]})"
            elif values[i, j] > 62:
                colour = ON_DARK
            axes.text(j, i, text, ha="center", va="center", color=colour, fontsize=8.5)
        axes.set_xticks(range(len(tasks)), tasks, rotation=40, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(len(names)), names)
        for label, name in zip(axes.get_yticklabels(), names, strict=True):
            label.set_color(FAINT if name == "paper" else INK)
        axes.grid(False)
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        for edge in range(1, len(names)):
            if names[edge] != "paper":
                axes.axhline(edge - 0.5, color=CARD, lw=3)
        # Between the suites, where the tasks are in their order
        in_order: list[str] = []
        boundaries: list[int] = []
        for suite in results.protocol.suites:
            in_order += results.protocol.choose("suite", suite)
            boundaries.append(len(in_order))
        if in_order == list(tasks):
            for boundary in boundaries:
                if 0 < boundary < len(tasks):
                    axes.axvline(boundary - 0.5, color=CARD, lw=3)
        return svg(canvas)


def efficiency(results: Results, flops: dict[str, float]) -> str:
    """Success over what a chunk costs: one's own models filled, the paper's numbers as rings.

    flops: of a sampled chunk at full size, by model.

    Returns:
        Empty text where no model of one's own has a place.
    """
    placed: list[tuple[int, Method, float]] = []  # number, and the average
    for i, method in enumerate(results.methods):
        mean = method.average.mean
        if mean is not None and method.key.model in flops and method.key.memory_budget is None:
            placed.append((i, method, mean))
    if not placed:
        return ""
    with figure((5.6, 3.9)) as (canvas, (axes,)):
        named = set()
        for known in paper.paper_methods().values():
            if known.model in flops and known.subgoal != "memer":
                label = None
                if known.family not in named:
                    label = f"{_FAMILY_NAMES[known.family]} (paper)"
                    named.add(known.family)
                axes.scatter(
                    flops[known.model] / 1e12,
                    paper.average(known.name).mean,
                    s=38,
                    facecolors="none",
                    edgecolors=FAMILIES[known.family],
                    lw=1.3,
                    label=label,
                )
        for i, method, mean in placed:
            axes.errorbar(
                flops[method.key.model] / 1e12,
                mean,
                method.average.std or 0,
                fmt="o",
                color=_colour(i),
                ecolor=INK,
                elinewidth=0.9,
                ms=7,
                label=method.label,
            )
        axes.set_xlabel("TFLOPs of a sampled chunk at full size (counted)")
        axes.set_ylabel("average success (%)")
        axes.set_ylim(bottom=0)
        axes.margins(x=0.08)
        axes.grid(True, axis="both", color=LINE)
        legend(canvas, axes, 2)
        return svg(canvas)


_FAMILY_NAMES = {
    "none": "no memory",
    "symbolic": "symbolic",
    "perceptual": "perceptual",
    "recurrent": "recurrent",
    "prior": "prior method",
}


def budget_curve(points: dict[str, list[tuple[int, Figure]]]) -> str:
    """Success over the memory budget: the paper's sweep dashed, one's own models with their
    intervals.

    points: as `budget_points` gives them.
    """
    order = list(points)
    with figure((5.6, 3.9)) as (canvas, (axes,)):
        table = paper.paper_table("memory_budget")
        budgets = [int(row["memory_tokens"]) for row in table]
        for marker, model in zip("ov", SWEPT, strict=True):
            values = [float(row[f"{model}_success"]) for row in table]
            colour = _colour(order.index(model)) if model in points else FAINT
            axes.plot(
                budgets,
                values,
                f"--{marker}",
                color=colour,
                mfc=CARD,
                ms=5,
                lw=1.1,
                label=f"{model} (paper)",
            )
        for model, model_points in points.items():
            at, means, gaps = _with_intervals(model_points)
            axes.errorbar(
                at,
                means,
                gaps,
                fmt="-s",
                color=_colour(order.index(model)),
                lw=1.8,
                ms=6,
                capsize=3,
                label=model,
            )
        ticks = {*budgets}
        for model_points in points.values():
            ticks.update(budget for budget, _ in model_points)
        log_scale(axes.xaxis, ticks)
        axes.set_xlabel("memory tokens")
        axes.set_ylabel("average success (%)")
        axes.set_ylim(bottom=0)
        legend(canvas, axes, 2)
        return svg(canvas)


def budget_points(methods: Sequence[Method], default: int) -> dict[str, list[tuple[int, Figure]]]:
    """The average at each budget, ascending, of every model with a sweep, or that the paper swept;
    complete only. Runs with events are left out. Where a budget has several configurations of a
    model, each has a curve of its own.
    """
    points: dict[str, list[tuple[int, Figure]]] = {}
    for method in methods:
        if method.average.mean is not None and method.key.event is None:
            budget = method.key.memory_budget
            name = method.label.replace(f"@{budget}", "")
            points.setdefault(name, []).append((budget or default, method.average))
    sweeps = {}
    for model, model_points in points.items():
        budgets = {budget for budget, _ in model_points}
        if len(budgets) > 1 or model.partition("#")[0] in SWEPT:
            sweeps[model] = sorted(model_points, key=lambda point: point[0])
    return sweeps


def _colour(i: int) -> str:
    return COLOURS[i % len(COLOURS)]


def _with_intervals(
    points: Sequence[tuple[float, Figure]],
) -> tuple[list[float], list[float], np.ndarray]:
    """Of the complete figures: place, mean, and how far their intervals reach below and above it
    [2, n].
    """
    places = []
    means = []
    gaps = []
    for at, estimate in points:
        if estimate.mean is not None and estimate.interval is not None:
            places.append(at)
            means.append(estimate.mean)
            gaps.append(
                (estimate.mean - estimate.interval.low, estimate.interval.high - estimate.mean)
            )
    # An interval of equal outcomes ends at their mean, but for rounding.
    return places, means, np.maximum(gaps, 0).reshape(-1, 2).T
