"""The result tables, and their spellings: terminal, Markdown, LaTeX, CSV."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from mme_vla.errors import counted, printable
from mme_vla.evaluation.records import OUTCOMES, EpisodeRecord
from mme_vla.evaluation.results.aggregate import Figure, Method, Results, Run, by_training
from mme_vla.evaluation.results.baselines import is_standing
from mme_vla.evaluation.results.compare import Comparison, show_p
from mme_vla.evaluation.results.scopes import GROUPING, PAPER_SEEDS, scopes
from mme_vla.evaluation.results.statistics import Interval
from mme_vla.utils.pages import escape_markdown


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
    name: str,
    title: str,
    columns: Sequence[str],
    row: Callable[[str, Sequence[EpisodeRecord]], list[str]],
) -> list[Table]:
    """A table of every method whose records have a score in the field `name`: a row for each task
    that has any, and one for all.
    """
    tables = []
    for method in results.methods:
        has_score = [getattr(record, name) is not None for record in method.table["record"]]
        table = method.table[has_score]
        if table.empty:
            continue
        by_task = table.groupby("task")["record"]
        rows = []
        for task in results.protocol.tasks:
            if task in by_task.groups:
                rows.append(row(task, list(by_task.get_group(task))))
        rows.append(row("all", list(table["record"])))
        last = len(rows) - 1
        tables.append(Table(f"{method.label}: {title}", columns, rows, {last}, {last}))
    return tables


def show(figure: Figure) -> str:
    """A figure as text: mean ± deviation, or the rate so far and how many episodes it is of.

    A mean without the incomplete runs states its number of runs.
    """
    if figure.mean is None:
        rate = "–" if figure.partial is None else f"{figure.partial:.1f}"
        return f"{rate} ({figure.done:,} of {figure.expected:,})"
    text = show_mean(figure.mean, figure.std)
    if figure.complete < figure.runs:
        text += f" ({figure.complete} of {counted(figure.runs, 'run')})"
    return text


def show_mean(mean: float, std: float | None) -> str:
    """A mean and its deviation, where there is one."""
    if std is None:
        return f"{mean:.2f}"
    return f"{mean:.2f} ± {std:.2f}"


def span(interval: Interval | None) -> str:
    """A confidence interval as text."""
    return "" if interval is None else f"[{interval.low:.1f}, {interval.high:.1f}]"


def show_paper(figure: Figure) -> str:
    """What the paper reports for a figure."""
    if figure.paper is None:
        return ""
    return show_mean(figure.paper.mean, figure.paper.std)


def overview(results: Results) -> Table:
    """Methods × suites, as the paper's suite table; of a single suite the average alone."""
    suites = results.protocol.suites
    if len(suites) == 1:
        suites = []
    averaged = results.protocol.averaged
    level = f"{100 * results.protocol.confidence:g} %"
    nested = any(len(method.trainings) > 1 for method in results.methods)
    reported = any(method.average.paper for method in results.methods)
    over = "runs"
    average_name = averaged[0] if len(averaged) == 1 else "average"
    columns = ["method", "runs", "episodes", *suites, average_name, level]
    if reported:
        columns.append("paper")
    if nested:
        over = "trainings, or over the runs of one"
        columns.insert(1, "trainings")
    rows = []
    for method in results.methods:
        average = method.average
        episodes = f"{average.done:,}"
        if average.done < average.expected:
            episodes += f" of {average.expected:,}"
        row = [method.label, str(average.runs), episodes]
        if nested:
            row.insert(1, str(len(method.trainings)))
        row += [show(method.figures["suite"][suite]) for suite in suites]
        row += [show(average), span(average.interval)]
        if reported:
            row.append(show_paper(average))
        rows.append(row)
    title = "Success rate (%)"
    if any(len(method.runs) > 1 for method in results.methods):
        title += f", mean ± sample standard deviation over {over}"
    return Table(title, columns, rows, _before_baselines(results))


def _before_baselines(results: Results) -> set[int]:
    """The first row of a standing baseline, where other methods stand above it."""
    standing = [is_standing(method.key.model) for method in results.methods]
    return {standing.index(True)} if len(set(standing)) == 2 else set()


def grouping_tables(results: Results) -> list[Table]:
    """Methods × groups, a table for each further grouping that an environment has."""
    tables = []
    for title, grouping in results.protocol.groupings.items():
        groups = list(dict.fromkeys(grouping.values()))
        rows = []
        for method in results.methods:
            figures = method.figures.get(GROUPING + title, {})
            row = [method.label]
            for group in groups:
                row.append(show(figures[group]) if group in figures else "")
            rows.append(row)
        rules = _before_baselines(results)
        tables.append(Table(f"Success rate (%) by {title}", ["method", *groups], rows, rules))
    return tables


def detail(method: Method, results: Results) -> Table:
    """One method: tasks by suite, suites, functional groups, difficulties, average, beside the
    paper's numbers.

    What has a single task here, and more in the benchmark, is left out beside that task.
    """
    protocol = results.protocol
    level = f"{100 * protocol.confidence:g} %"
    reported = any(figure.paper for figure in method.figures["task"].values())
    rows: list[list[str]] = []
    rules, strong = set(), set()

    def add(name: str, figure: Figure, mark: bool = False) -> None:
        gap = ""
        if figure.mean is not None and figure.paper is not None:
            gap = f"{figure.mean - figure.paper.mean:+.2f}"
        if mark:
            strong.add(len(rows))
        row = [name, show(figure), f"{figure.done:,}", span(figure.interval)]
        if reported:
            row += [show_paper(figure), gap]
        rows.append(row)

    for suite in protocol.suites:
        tasks = protocol.choose("suite", suite)
        for task in tasks:
            add(task, method.figures["task"][task])
        if len(tasks) > 1:
            add(suite, method.figures["suite"][suite], True)
            rules.add(len(rows))
    rules.add(len(rows))
    for scope in scopes(protocol):
        if scope.kind == "group" and (len(scope.tasks) > 1 or protocol.is_benchmark):
            add(scope.name, method.figures["group"][scope.name])
    rules.add(len(rows))
    difficulties = method.figures.get("difficulty", {})
    if len(difficulties) > 1:
        for name, figure in difficulties.items():
            add(name, figure)
    rules.add(len(rows))
    if len(protocol.averaged) > 1:
        add("average", method.average, True)
    columns = ["", "success (%)", "episodes", level]
    if reported:
        columns += ["paper", "difference"]
    title = f"{method.label}: {counted(len(method.runs), 'run')}"
    return Table(title, columns, rows, rules - {len(rows)}, strong)


def runs_table(results: Results) -> Table:
    """Every run: how far it is, how its episodes ended, and its average over the tasks."""
    columns = ["method", "checkpoint", "seed", "episodes"]
    counts: Counter[str] = Counter()
    named = False
    for method in results.methods:
        for run in method.runs:
            counts.update(run.outcomes)
            named = named or run.key.training is not None
    outcome_names = ["success", *(name for name in OUTCOMES[1:] if counts[name])]
    columns += [*outcome_names, "average (%)"]
    if named:
        columns.insert(1, "training seed")
    rows = []
    for method in results.methods:
        for run in method.runs:
            outcomes = run.outcomes
            row = [method.label, str(run.key.checkpoint), str(run.key.model_seed)]
            row.append(f"{len(run.averaged)} of {run.expected}")
            row += [str(outcomes[name]) for name in outcome_names]
            if run.complete:
                rates = [np.mean(run.successes(task) or []) for task in results.protocol.averaged]
                row.append(f"{100 * np.mean(rates):.2f}")
            else:
                row.append("incomplete")
            if named:
                row.insert(1, str(run.key.training.seed) if run.key.training else "")
            rows.append(row)
    return Table("Runs", columns, rows)


def comparison_table(comparisons: Sequence[Comparison]) -> Table:
    """Differences of pairs, on their common episodes."""
    rows = []
    for c in comparisons:
        episodes = f"{c.episodes}"
        if c.episodes < c.expected:
            episodes += f" of {c.expected}"
        significant = "no"
        if c.significant:
            significant = "yes"
        elif not c.testable:
            significant = "too few episodes"
        rows.append(
            [
                f"{c.first} − {c.second}",
                episodes,
                f"{c.first_rate:.2f}",
                f"{c.second_rate:.2f}",
                f"{c.difference:+.2f}",
                f"[{c.interval.low:+.1f}, {c.interval.high:+.1f}]",
                c.better_worse,
                show_p(c.corrected),
                significant,
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
    checkpoints: dict[int | str, list[Run]] = {}
    for run in method.runs:
        checkpoints.setdefault(run.key.checkpoint, []).append(run)
    order = {seed: i for i, seed in enumerate(PAPER_SEEDS)}
    tables = []
    for checkpoint, runs in checkpoints.items():
        runs.sort(key=lambda run: (order.get(run.key.model_seed, len(order)), run.key.model_seed))
        several = len(by_training(runs)) > 1
        columns = ["Task"]
        for run in runs:
            name = f"Seed {run.key.model_seed}"
            if several and run.key.training:
                name = f"Training {run.key.training.seed}, {name}"
            columns.append(name)
        columns.append("Average")
        # Rates of the tasks [tasks, runs], NaN of an incomplete one; NaN of one makes averages NaN.
        tasks = results.protocol.averaged
        rates = pd.DataFrame(index=tasks, columns=range(len(runs)), dtype=float)
        for number, run in enumerate(runs):
            for task in tasks:
                outcomes = run.successes(task)
                if outcomes is not None:
                    rates.loc[task, number] = 100 * sum(outcomes) / len(outcomes)
        rates.loc["**Average**"] = rates.mean(skipna=False)
        rates["Average"] = rates.mean(axis=1, skipna=False)
        rows = []
        for name, values in rates.iterrows():
            cells = ["incomplete" if pd.isna(value) else f"{value:.2f}" for value in values]
            if name in tasks:
                for number, run in enumerate(runs):
                    if pd.isna(values[number]):
                        done = sum(key.task == name for key in run.records)
                        expected = len(results.protocol.numbers_of(name))
                        cells[number] = f"{done} of {counted(expected, 'episode')}"
            rows.append([str(name), *cells])
        tables.append(Table(f"{method.label}, checkpoint {checkpoint}", columns, rows))
    return tables


_NAME = 18  # Characters of a table's first column that are not broken into lines
_LONGEST = 24  # Characters of any other cell that are not
_PADDING = 3  # Characters of a column beside its text


def print_table(table: Table, width: int) -> None:
    """Print for people, `width` characters wide: columns that do not fit follow below, with the
    first one again. No number is ever cut, and no escape sequence of a name is obeyed.
    """
    # What each column needs: its cells, and the words of its heading
    columns = list(zip(table.columns, *table.rows, strict=True))
    needs = []
    for heading, *cells in columns:
        longest = max((cell_len(printable(cell)) for cell in cells), default=0)
        words = [cell_len(printable(word)) for word in heading.split()]
        needs.append(max([min(longest, _LONGEST), *words]))
    name = max(cell_len(printable(cell)) for cell in columns[0])
    least = min(name, _NAME)

    # As many columns as fit at a time
    blocks: list[list[int]] = [[]]
    used = least + _PADDING + 1
    for number in range(1, len(columns)):
        need = needs[number] + _PADDING
        if blocks[-1] and used + need > width:
            blocks.append([])
            used = least + _PADDING + 1
        blocks[-1].append(number)
        used += need

    console = Console(width=10_000)
    console.print(Text(printable(table.title), style="bold italic"), soft_wrap=True)
    for block in blocks:
        widths = [needs[number] for number in block]
        remaining = width - sum(widths) - _PADDING * len(widths) - _PADDING - 1
        first = max(least, min(name, remaining))
        console.print(_to_rich(table, [0, *block], [first, *widths]))


def _to_rich(table: Table, columns: Sequence[int], widths: Sequence[int]) -> RichTable:
    """Some of the columns, of these widths."""
    rendered = RichTable()
    for column, width in zip(columns, widths, strict=True):
        rendered.add_column(
            Text(printable(table.columns[column])),
            justify="left" if column == 0 else "right",
            overflow="fold",
            width=width,
        )
    for i, row in enumerate(table.rows):
        if i in table.rules:
            rendered.add_section()
        cells = [Text(printable(row[column])) for column in columns]
        rendered.add_row(*cells, style="bold" if i in table.strong else None)
    return rendered


def to_markdown(table: Table) -> str:
    """A Markdown table under its title."""
    lines = [table.columns, [":---", *["---:"] * (len(table.columns) - 1)], *table.rows]
    body = "\n".join("| " + " | ".join(map(escape_markdown, line)) + " |" for line in lines)
    return f"### {escape_markdown(table.title)}\n\n{body}\n"


_LATEX = str.maketrans(
    {
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
)


def to_latex(table: Table) -> str:
    """A LaTeX table (package booktabs)."""
    rows = []
    for number, row in enumerate(table.rows):
        cells = [cell.translate(_LATEX) for cell in row]
        if number in table.strong:
            cells = [rf"\textbf{{{cell}}}" if cell else "" for cell in cells]
        if number in table.rules:
            cells[0] = "\\midrule\n" + cells[0]
        rows.append(cells)
    frame = pd.DataFrame(rows, columns=[column.translate(_LATEX) for column in table.columns])
    return frame.style.hide(axis="index").to_latex(
        column_format="l" + "r" * (len(table.columns) - 1),
        hrules=True,
        position_float="centering",
        caption=table.title.translate(_LATEX),
    )


def _no_formula(text: str) -> str:
    text = " ".join(text.split())  # a name with a line break would begin another row
    if text.startswith(("=", "+", "-", "@")):
        return f"'{text}"
    return text


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
    rows = []
    for method in results.methods:
        for kind, figures in method.figures.items():
            for name, figure in figures.items():
                names = map(_no_formula, (method.label, kind, name))
                low, high = figure.interval or (None, None)
                reported = figure.paper or (None, None)
                counts = (figure.runs, figure.complete, figure.done, figure.expected)
                rows.append([*names, figure.mean, figure.std, low, high, *counts, *reported])
    frame = pd.DataFrame(rows, columns=CSV_COLUMNS)
    return str(frame.to_csv(index=False, float_format="%.4f", lineterminator="\n"))
