"""The result tables, and their spellings: terminal, Markdown, LaTeX, CSV."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mme_vla.errors import printable
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import Figure, Interval, Method, Results, by_training
from mme_vla.evaluation.results.compare import Comparison, show_p
from mme_vla.evaluation.results.scopes import PAPER_SEEDS
from mme_vla.utils.pages import escape_markdown

if TYPE_CHECKING:
    from rich.table import Table as RichTable


@dataclass
class Table:
    """A table of text. rules: rows before which a line is printed. strong: rows in bold. notes:
    sentences below it.
    """

    title: str
    columns: Sequence[str]
    rows: list[list[str]]
    rules: set[int] = field(default_factory=set)
    strong: set[int] = field(default_factory=set)
    notes: Sequence[str] = ()


def task_tables(
    results: Results,
    key: str,
    title: str,
    columns: Sequence[str],
    row: Callable[[str, Sequence[EpisodeRecord]], list[str]],
) -> list[Table]:
    """A table of every method whose records have `extra[key]`: a row for each task that has any,
    and one for all.
    """
    tables = []
    for method in results.methods:
        records = [
            record for run in method.runs for record in run.records.values() if key in record.extra
        ]
        by_task = {task: [r for r in records if r.task == task] for task in results.protocol.tasks}
        rows = [row(task, members) for task, members in by_task.items() if members]
        if records:
            rows.append(row("all", records))
            tables.append(
                Table(f"{method.label}: {title}", columns, rows, {len(rows) - 1}, {len(rows) - 1})
            )
    return tables


def show(figure: Figure, short: bool = False) -> str:
    """A figure as text: mean ± deviation, or how far it is.

    A mean without the incomplete runs states its number of runs.
    """
    if figure.mean is None:
        if short:
            return f"incomplete ({figure.done:,} of {figure.expected:,})"
        partial = "" if figure.partial is None else f" ({figure.partial:.1f} so far)"
        return f"{figure.done:,} of {figure.expected:,} episodes{partial}"
    text = f"{figure.mean:.2f}" + ("" if figure.std is None else f" ± {figure.std:.2f}")
    return (
        text
        if figure.complete == figure.runs
        else f"{text} ({figure.complete} of {figure.runs} runs)"
    )


def span(interval: Interval | None) -> str:
    """A confidence interval as text."""
    return "" if interval is None else f"[{interval.low:.1f}, {interval.high:.1f}]"


def show_paper(figure: Figure) -> str:
    """What the paper reports for a figure."""
    if figure.paper is None:
        return ""
    return f"{figure.paper.mean:.2f}" + (
        "" if figure.paper.std is None else f" ± {figure.paper.std:.2f}"
    )


def overview(results: Results) -> Table:
    """Methods × suites, as the paper's suite table."""
    suites = results.protocol.suites
    level = f"{100 * results.protocol.confidence:g} %"
    nested = any(len(method.trainings) > 1 for method in results.methods)
    columns = [
        "method",
        *(["trainings"] if nested else []),
        "runs",
        "episodes",
        *suites,
        "average",
        level,
        "paper",
    ]
    rows = []
    for method in results.methods:
        average = method.average
        episodes = (
            f"{average.done:,}"
            if average.done == average.expected
            else f"{average.done:,} of {average.expected:,}"
        )
        cells = [show(method.figures["suite"][suite], short=True) for suite in suites]
        figures = [show(average, short=True), span(average.interval), show_paper(average)]
        trainings = [str(len(method.trainings))] if nested else []
        rows.append([method.label, *trainings, str(average.runs), episodes, *cells, *figures])
    over = "trainings, or over the runs of one" if nested else "runs"
    return Table(f"Success rate (%), mean ± sample standard deviation over {over}", columns, rows)


def detail(method: Method, results: Results) -> Table:
    """One method: tasks by suite, suites, functional groups, difficulties, average, beside the
    paper's numbers.
    """
    level = f"{100 * results.protocol.confidence:g} %"
    rows: list[list[str]] = []
    rules, strong = set(), set()

    def add(name: str, figure: Figure, mark: bool = False) -> None:
        gap = (
            ""
            if figure.mean is None or figure.paper is None
            else f"{figure.mean - figure.paper.mean:+.2f}"
        )
        if mark:
            strong.add(len(rows))
        rows.append([name, show(figure), span(figure.interval), show_paper(figure), gap])

    for suite in results.protocol.suites:
        for task in results.protocol.choose("suite", suite):
            add(task, method.figures["task"][task])
        add(suite, method.figures["suite"][suite], True)
        rules.add(len(rows))
    for kind in ("group", "difficulty"):
        for name, figure in method.figures.get(kind, {}).items():
            add(name, figure)
        rules.add(len(rows))
    add("average", method.average, True)
    title = f"{method.label}: {len(method.runs)} runs"
    return Table(
        title, ["", "success (%)", level, "paper", "difference"], rows, rules - {len(rows)}, strong
    )


def runs_table(results: Results) -> Table:
    """Every run: how far it is, how its episodes ended, and its average."""
    rows = []
    named = any(run.key.training for method in results.methods for run in method.runs)
    for method in results.methods:
        for run in method.runs:
            outcomes = run.outcomes
            rate = (
                f"{100 * outcomes['success'] / run.expected:.2f}" if run.complete else "incomplete"
            )
            done = f"{len(run.averaged)} of {run.expected}"
            counts = [str(outcomes[name]) for name in ("success", "fail", "timeout", "error")]
            seed = [str(run.key.training.seed) if run.key.training else ""] if named else []
            rows.append(
                [
                    method.label,
                    *seed,
                    str(run.key.checkpoint),
                    str(run.key.model_seed),
                    done,
                    *counts,
                    rate,
                ]
            )
    trained = ["training seed"] if named else []
    ends = ["episodes", "success", "fail", "timeout", "error", "average (%)"]
    columns = ["method", *trained, "checkpoint", "seed", *ends]
    return Table("Runs", columns, rows)


def comparison_table(comparisons: Sequence[Comparison]) -> Table:
    """Differences of pairs, on their common episodes."""
    rows = []
    for c in comparisons:
        paired = f"{c.episodes}" if c.episodes == c.expected else f"{c.episodes} of {c.expected}"
        rows.append(
            [
                f"{c.first} − {c.second}",
                paired,
                f"{c.first_rate:.2f}",
                f"{c.second_rate:.2f}",
                f"{c.difference:+.2f}",
                f"[{c.interval.low:+.1f}, {c.interval.high:+.1f}]",
                c.better_worse,
                show_p(c.corrected),
                "yes" if c.significant else "no",
            ]
        )
    columns = [
        "pair",
        "episodes",
        "first",
        "second",
        "difference",
        "interval",
        "better : worse",
        "p",
        "significant",
    ]
    return Table("Paired comparison, percentage points", columns, rows)


def leaderboard(method: Method, results: Results) -> list[Table]:
    """The leaderboard's format: for each checkpoint, tasks × model seeds, and their average.

    Cells of a run that lacks episodes of a task say how many there are, and have no average.
    """
    tables = []
    for checkpoint in dict.fromkeys(run.key.checkpoint for run in method.runs):
        runs = [run for run in method.runs if run.key.checkpoint == checkpoint]
        order = {seed: i for i, seed in enumerate(PAPER_SEEDS)}
        runs.sort(key=lambda run: (order.get(run.key.model_seed, len(order)), run.key.model_seed))
        several = len(by_training(runs)) > 1
        names = [
            f"Training {run.key.training.seed}, " if several and run.key.training else ""
            for run in runs
        ]
        seeds = [f"{name}Seed {run.key.model_seed}" for name, run in zip(names, runs, strict=True)]
        columns = ["Task", *seeds, "Average"]
        values: list[list[float | str]] = []
        for task in results.protocol.averaged:
            row: list[float | str] = []
            for run in runs:
                outcomes = run.successes(task)
                done = sum(key.task == task for key in run.records)
                row.append(
                    f"{done} of {results.protocol.episodes} episodes"
                    if outcomes is None
                    else 100 * sum(outcomes) / len(outcomes)
                )
            values.append(row)
        run_columns = [[row[i] for row in values] for i in range(len(runs))]
        values.append([_mean(column) for column in run_columns])
        labels = [*results.protocol.averaged, "**Average**"]
        rows = [
            [name, *map(_percent, row), _percent(_mean(row))]
            for name, row in zip(labels, values, strict=True)
        ]
        tables.append(Table(f"{method.label}, checkpoint {checkpoint}", columns, rows))
    return tables


def _mean(values: Sequence[float | str]) -> float | str:
    numbers = [value for value in values if isinstance(value, float)]
    return sum(numbers) / len(numbers) if len(numbers) == len(values) else "incomplete"


def _percent(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.2f}"


def to_rich(table: Table) -> "RichTable":
    """For the terminal, which obeys no escape sequence of a name."""
    from rich.table import Table as RichTable
    from rich.text import Text

    made = RichTable(title=Text(printable(table.title)), title_justify="left", title_style="bold")
    for i, column in enumerate(table.columns):
        made.add_column(
            Text(printable(column)), justify="left" if i == 0 else "right", overflow="fold"
        )
    for i, row in enumerate(table.rows):
        if i in table.rules:
            made.add_section()
        made.add_row(
            *(Text(printable(cell)) for cell in row), style="bold" if i in table.strong else None
        )
    return made


def print_table(table: Table, width: int) -> None:
    """Print for people: `width` columns, or as many as the table needs, so that no number is ever
    cut.
    """
    from rich.console import Console

    made = to_rich(table)
    needed = Console(width=10_000).measure(made).maximum
    Console(width=max(width, needed)).print(made)


def to_markdown(table: Table) -> str:
    """A Markdown table under its title."""
    lines = [table.columns, [":---", *["---:"] * (len(table.columns) - 1)], *table.rows]
    body = "\n".join("| " + " | ".join(map(escape_markdown, line)) + " |" for line in lines)
    return f"### {escape_markdown(table.title)}\n\n{body}\n"


_LATEX = {
    "\\": r"\textbackslash{}",
    "_": r"\_",
    "%": r"\%",
    "&": r"\&",
    "#": r"\#",
    "±": r"$\pm$",
    "−": "$-$",
    "<": "$<$",
    ">": "$>$",
    "π": r"$\pi$",
    "$": r"\$",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


def to_latex(table: Table) -> str:
    """A LaTeX table (package booktabs)."""

    def line(cells: Sequence[str], strong: bool = False) -> str:
        escaped = ("".join(_LATEX.get(letter, letter) for letter in cell) for cell in cells)
        return (
            " & ".join(rf"\textbf{{{cell}}}" if strong and cell else cell for cell in escaped)
            + r" \\"
        )

    body = []
    for i, row in enumerate(table.rows):
        body += [r"\midrule"] * (i in table.rules) + [line(row, i in table.strong)]
    caption = line([table.title]).removesuffix(r" \\")
    return "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{caption}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}",
            r"\toprule",
            line(table.columns),
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _no_formula(text: str) -> str:
    text = " ".join(text.split())  # a name with a line break would begin another row
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


CSV_COLUMNS = (
    "method",
    "kind",
    "name",
    "mean",
    "std",
    "low",
    "high",
    "runs",
    "complete_runs",
    "episodes",
    "expected_episodes",
    "paper_mean",
    "paper_std",
)


def to_csv(results: Results) -> str:
    """Every figure as a row of numbers; names that a spreadsheet would run as formulas get an
    apostrophe first.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for method in results.methods:
        for kind, figures in method.figures.items():
            for name, f in figures.items():
                low, high = f.interval or (None, None)
                reported = f.paper or (None, None)
                numbers = [
                    f.mean,
                    f.std,
                    low,
                    high,
                    f.runs,
                    f.complete,
                    f.done,
                    f.expected,
                    *reported,
                ]
                cells = [
                    f"{n:.4f}" if isinstance(n, float) else ("" if n is None else str(n))
                    for n in numbers
                ]
                writer.writerow([*map(_no_formula, (method.label, kind, name)), *cells])
    return out.getvalue()
