"""The tables and figures of the board, in the terminal, in Markdown, and as one page with sortable
tables.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mme_vla.errors import counted, listed
from mme_vla.evaluation.results.baselines import missing_baselines
from mme_vla.evaluation.results.compare import show_p
from mme_vla.evaluation.results.report import Section, html_page
from mme_vla.evaluation.results.tables import Table, comparison_table, show, span
from mme_vla.extras.nano.board import Board, Row, Separation, published_success
from mme_vla.extras.nano.rows import CHOICES
from mme_vla.utils.style import COLOURS, FAINT, INK, LINE, figure, legend, log_scale, svg

PAINT = {"policy": COLOURS[0], "floor": FAINT, "ceiling": COLOURS[2]}
LOCAL = COLOURS[1]


def ranking(board: Board, brief: bool = False) -> Table:
    """Place, success by suite, and costs of every row; without costs where `brief`."""
    suites = board.protocol.suites
    columns = ["row", "place", "trainings", "success (%)", "95 %", *suites]
    if not brief:
        columns += ["parameters", "GFLOPs an update", "seconds an update"]
        columns += ["CPU minutes of a training"]
    rows: list[list[str]] = []
    strong: set[int] = set()
    for row in board.rows:
        facts = row.facts
        place = ""
        if row.name in board.places:
            number, (low, high) = board.places[row.name]
            place = f"{number} [{low:.0f}, {high:.0f}]"
        trainings = str(len(row.method.trainings)) if facts.trained else "–"
        cells = [row.name, place, trainings, success(board, row), span(board.interval(row))]
        for suite in suites:
            cells.append(f"{board.success(row, board.protocol.choose('suite', suite)):.1f}")
        if not brief:
            gflops = None if facts.update_flops is None else facts.update_flops / 1e9
            cells.append(_cell(facts.parameters, ",.0f"))
            cells.append(_cell(gflops, ".2f"))
            cells.append(_cell(facts.update_s, ".3f"))
            cells.append(_cell(facts.cpu_minutes, ".1f"))
        if row.is_local:
            strong.add(len(rows))
        rows.append(cells)
    return Table(f"Ranking, split {board.split}", columns, rows, strong=strong)


def success(board: Board, row: Row) -> str:
    """A row's success over all tasks ± the deviation between its trainings, in percent."""
    # rounded, so that equal rows read alike
    return show(replace(row.average, mean=board.success(row)))


def tasks(board: Board) -> Table:
    """Success of every row on every task."""
    names = board.protocol.tasks
    rows = []
    for row in board.rows:
        rows.append([row.name, *[f"{board.success(row, [task]):.0f}" for task in names]])
    return Table("Success by task (%)", ["row", *names], rows)


def trainings(board: Board) -> Table:
    """Scenes that each training solves, of rows with several: in all, by suite and by task."""
    scopes = [board.protocol.tasks]
    for suite in board.protocol.suites:
        scopes.append(tuple(board.protocol.choose("suite", suite)))
    for task in board.protocol.tasks:
        scopes.append((task,))
    rows: list[list[str]] = []
    for row in board.rows:
        seeds = []
        for runs in row.method.trainings:
            identity = runs[0].key.training
            if identity is not None:
                seeds.append(identity.seed)
        if len(seeds) < 2:
            continue
        solved_by_task = {task: row.outcomes(task).sum(0) for task in board.protocol.tasks}
        for training, seed in enumerate(seeds):
            cells = [row.name, str(seed)]
            for scope in scopes:
                cells.append(f"{sum(solved_by_task[task][training] for task in scope):g}")
            rows.append(cells)
    columns = ["row", "training seed", "all", *board.protocol.suites, *board.protocol.tasks]
    return Table("Scenes solved by each training", columns, rows)


def separations(board: Board) -> Table:
    """Tasks and budgets at which memories differ, the clearest first."""
    rows = []
    for s in sorted(board.separations, key=lambda s: (s.p, -s.deviation)):
        above = None if s.floor is None else round(s.mean - s.floor)
        below = None if s.ceiling is None else round(s.ceiling - s.mean)
        over_trainings = "–" if s.p_repeated is None else f"{show_p(s.p_repeated)} ({s.repeated})"
        rows.append(
            [
                s.task,
                s.budget or "default",
                str(s.memories),
                f"{s.lowest:.0f} … {s.mean:.0f} … {s.highest:.0f}",
                f"{s.deviation:.1f}",
                _cell(s.noise, ".1f"),
                show_p(s.p),
                over_trainings,
                _cell(above, "d"),
                _cell(below, "d"),
            ]
        )
    columns = [
        "task",
        "tokens",
        "memories",
        "lowest … mean … highest (%)",
        "spread",
        "noise",
        "p",
        "p over trainings",
        "above the floor",
        "below the ceiling",
    ]
    return Table("Whether memories differ on a task", columns, rows)


def separating(board: Board) -> list[str]:
    """How many tasks separate memories, a sentence a budget."""
    by_budget: dict[str, list[Separation]] = {}
    for separation in board.separations:
        by_budget.setdefault(separation.budget, []).append(separation)
    sentences = []
    for budget, tested in by_budget.items():
        tokens = f"At {counted(int(budget), 'token')}" if budget else "At the default budgets"
        differing = [s.task for s in tested if s.p < 0.05]
        sentence = (
            f"{tokens} the {tested[0].memories} trained policies differ in {len(differing)} of"
            f" {counted(len(tested), 'task')} (p < 0.05){_after_colon(differing)}."
        )
        if tested[0].p_repeated is not None:
            differing = [s.task for s in tested if s.p_repeated is not None and s.p_repeated < 0.05]
            sentence += (
                f" Tested over trainings, the {tested[0].repeated} with several differ in"
                f" {len(differing)}{_after_colon(differing)}."
            )
        sentences.append(sentence)
    return sentences


def _after_colon(names: Sequence[str]) -> str:
    return f": {', '.join(names)}" if names else ""


def published(board: Board) -> Table:
    """Success and place of each published method here and in the paper, over all tasks and by
    suite.
    """
    scopes: dict[str, Sequence[str]] = {"all": board.protocol.tasks}
    for suite in board.protocol.suites:
        scopes[suite] = board.protocol.choose("suite", suite)
    pairs = board.published
    rows = [[row.name] for row, _ in pairs]
    columns = ["row"]
    for name, scope in scopes.items():
        columns += [f"{name}, here", f"{name}, paper"]
        measured = np.array([board.success(row, scope) for row, _ in pairs])
        reported = np.array([published_success(method, scope) for _, method in pairs])
        for i, cells in enumerate(rows):
            for values in (measured, reported):
                place = 1 + (values > values[i]).sum()
                cells.append(f"{values[i]:.1f} ({place})")
    return Table("Beside the published ranking: success in percent (place)", columns, rows)


def agreements(board: Board) -> Table:
    """Rank correlations with the published ranking."""
    rows = []
    for a in board.agreements():
        row = [a.scope, str(a.methods)]
        for value, interval in (
            (a.spearman, a.spearman_interval),
            (a.kendall, a.kendall_interval),
        ):
            row += [f"{value:+.2f}", f"[{interval.low:+.2f}, {interval.high:+.2f}]"]
        rows.append(row)
    return Table(
        "Rank correlation with the published success",
        ["", "methods", "Spearman", "95 %", "Kendall", "95 %"],
        rows,
    )


def targets(board: Board) -> Table:
    """The benchmark's targets, reached or not."""
    words = {None: "", True: "yes", False: "no"}
    rows = []
    for target in board.targets():
        reached = words[target.reached]
        rows.append([target.name, target.measured, target.interval, target.test, reached])
    return Table("Targets", ["target", "measured", "95 %", "better : worse", "reached"], rows)


def notes(board: Board) -> list[str]:
    """What a reader of the tables has to know."""
    noise = board.noise()
    single = sum(row.facts.trained and len(row.method.trainings) == 1 for row in board.rows)
    actions = ""
    if board.action_space != CHOICES:
        actions = f" Actions are `{board.action_space}`, not choices."
    lines = [
        f"{counted(len(board.protocol.tasks), 'task')} ×"
        f" {counted(board.protocol.episodes, 'scene')} of split"
        f" `{board.split}`, the same for all rows.{actions}"
    ]
    if noise is None:
        lines.append(
            "No row has two trainings: the noise between trainings is unknown, and intervals are"
            " too narrow."
        )
    else:
        lines.append(
            f"Another training of a row changes its success by {noise:.1f} points (standard"
            f" deviation). Intervals are over scenes and trainings. Rows of one training: {single}."
        )
    if board.apart:
        lines.append(
            f"{listed(row.name for row in board.apart)}: not known to be of the same scenes as the"
            " other rows, since only some records name their scene, or they name different ones."
            " These rows have the same tasks, numbers and seeds, and are compared by score,"
            " unpaired."
        )
    recordings: set[str] = set()
    several = 0
    for row in board.rows:
        recordings |= row.recordings
        several += len(row.recordings) > 1
        if errors := sum(run.outcomes["error"] for run in row.method.runs):
            lines.append(
                f"{row.name}: {counted(errors, 'failure')} by an error of the environment or the"
                " policy."
            )
    lines += missing_baselines(row.name for row in board.rows)
    if len(recordings) > 1:
        lines.append(
            f"{len(recordings)} recordings of the demonstrations (digests"
            f" {listed(sorted(recordings))}). Rows with trainings on more than one: {several}"
            " (`data` of `trained.json`)."
        )
    return lines


def standing(board: Board) -> list[str]:
    """The place of each of the user's rows, a sentence a row."""
    lines = []
    for row in board.ranked:
        place, (low, high) = board.places[row.name]
        if row.is_local:
            lines.append(
                f"{row.name}: place {place} of {len(board.ranked)}, between {low:.0f} and"
                f" {high:.0f} with {100 * board.protocol.confidence:g} % confidence, with"
                f" {success(board, row)} % {span(board.interval(row))}."
            )
    return lines


def success_figure(board: Board) -> str:
    """Success of every row with its interval."""
    rows = board.rows[::-1]
    with figure((7.2, 0.26 * len(rows) + 1.0)) as (canvas, (axes,)):
        for at, row in enumerate(rows):
            low, high = board.interval(row)
            colour = LOCAL if row.is_local else PAINT[row.kind]
            axes.plot([low, high], [at, at], color=colour, lw=1.6)
            axes.plot(board.success(row), at, "o", color=colour, ms=6)
            of_trainings = row.mean(board.protocol.tasks)
            axes.plot(of_trainings, np.full(len(of_trainings), at), "|", color=INK, ms=7)
        axes.set_yticks(range(len(rows)), [row.name for row in rows])
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_xlim(0, 100)
        axes.set_xlabel("success over all tasks (%); strokes: trainings")
        axes.grid(True, axis="x", color=LINE)
        return svg(canvas)


def budget_figure(board: Board) -> str:
    """Success over memory tokens, of the models that have rows of several budgets;
    empty without.
    """
    models: dict[str, list[Row]] = {}
    for row in board.of_kind("policy"):
        if row.facts.budget is not None:
            models.setdefault(row.name.partition("@")[0], []).append(row)
    several = {model: rows for model, rows in models.items() if len(rows) > 1}
    if not several:
        return ""
    every_budget: set[int] = set()
    with figure((5.6, 3.6)) as (canvas, (axes,)):
        for number, (model, rows) in enumerate(several.items()):
            budgets = []
            means = []
            below = []  # from a mean to the lower end of its interval
            above = []
            for row in sorted(rows, key=lambda row: row.facts.budget or 0):
                mean = board.success(row)
                low, high = board.interval(row)
                budgets.append(row.facts.budget or 0)
                means.append(mean)
                below.append(max(mean - low, 0))
                above.append(max(high - mean, 0))
            every_budget.update(budgets)
            axes.errorbar(
                budgets,
                means,
                [below, above],
                fmt="-o",
                ms=5,
                capsize=3,
                color=COLOURS[number % len(COLOURS)],
                label=model,
            )
        log_scale(axes.xaxis, every_budget)
        axes.set_xlabel("memory tokens")
        axes.set_ylabel("success (%)")
        axes.set_ylim(bottom=0)
        legend(canvas, axes, 3)
        return svg(canvas)


def published_figure(board: Board) -> str:
    """Success here over the published success, a point a method; empty without two."""
    if len(board.published) < 2:
        return ""
    with figure((5.6, 3.9)) as (canvas, (axes,)):
        for row, method in board.published:
            x, y = published_success(method, board.protocol.tasks), board.success(row)
            axes.plot(x, y, "o", color=PAINT[row.kind], ms=5)
            axes.annotate(row.name, (x, y), (4, 3), textcoords="offset points", fontsize=7)
        axes.set_xlabel("published success (%)")
        axes.set_ylabel("success here (%)")
        axes.grid(True, axis="both", color=LINE)
        return svg(canvas)


def variants(board: Board) -> list[Table]:
    """Integrations of one memory, and memories with one integration, where there are several."""
    integrations = comparison_table(board.variants("integration"))
    memories = comparison_table(board.variants("memory"))
    tables = [
        replace(integrations, title="Integrations of a memory, percentage points"),
        replace(memories, title="Memories with an integration, percentage points"),
    ]
    return [table for table in tables if table.rows]


def all_tables(board: Board) -> list[Table]:
    """Every table of the board that has rows."""
    pairs = comparison_table(board.neighbours())
    tables = [
        ranking(board),
        targets(board),
        pairs,
        *variants(board),
        tasks(board),
        trainings(board),
        separations(board),
        published(board),
        agreements(board),
    ]
    return [table for table in tables if table.rows]


def page(board: Board) -> str:
    """The board as one page of HTML, which loads nothing."""
    corrected = "P values are corrected by Holm for the number of pairs of a table."
    sections = [
        Section("Ranking", success_figure(board), [ranking(board)], paragraphs=notes(board)),
        Section("Targets", tables=[targets(board)]),
        Section("Neighbours", tables=[comparison_table(board.neighbours())], caption=corrected),
        Section("Memory and integration", tables=variants(board), headed=True, caption=corrected),
        Section("Tasks", tables=[tasks(board)]),
        Section("Trainings", tables=[trainings(board)]),
        Section(
            "Do memories differ?",
            budget_figure(board),
            [separations(board)],
            paragraphs=separating(board),
        ),
    ]
    sections = [section for section in sections if any(table.rows for table in section.tables)]
    if board.published:
        beside = [published(board), agreements(board)]
        sections.append(Section("Beside the published ranking", published_figure(board), beside))
    return html_page("nanoMME-16", sections, counted(len(board.rows), "row"), sortable=True)


def _cell(value: float | None, spec: str) -> str:
    return "–" if value is None else format(value, spec)
