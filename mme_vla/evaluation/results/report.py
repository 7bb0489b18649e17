"""One self-contained HTML page of results: no script, no address, images inside."""

from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape

from mme_vla.evaluation.results import plots
from mme_vla.evaluation.results.aggregate import DEFAULT_BUDGET, Results
from mme_vla.evaluation.results.compare import Comparison
from mme_vla.evaluation.results.curves import CAPTION, process_tables
from mme_vla.evaluation.results.paper import chunk_flops
from mme_vla.evaluation.results.tables import Table, comparison_table, detail, overview, runs_table
from mme_vla.evaluation.rollout.subgoals import subgoal_tables

_CSS = """
:root { --ink: #2b2d42; --faint: #6c7689; --line: #e3e6ec; --accent: #1f6f8b; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: var(--ink); background: #f6f7f9; }
body { margin: 0; }
main { max-width: 1120px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 27px; margin: 0 0 2px; } h2 { font-size: 18px; margin: 0 0 10px; }
.sub { color: var(--faint); margin: 0 0 18px; }
section { background: white; border: 1px solid var(--line); border-radius: 10px; padding: 18px 22px; margin: 0 0 18px; }
.two { display: grid; grid-template-columns: 1fr 1fr; gap: 18px; } .two section { margin: 0; }
.two + section { margin-top: 18px; }
svg { max-width: 100%; height: auto; display: block; margin: 0 auto; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; font-variant-numeric: tabular-nums; }
th { text-align: right; color: var(--faint); font-weight: 600; border-bottom: 2px solid var(--line); padding: 5px 9px; }
td { text-align: right; padding: 4px 9px; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
tr.strong td { font-weight: 650; } tr.rule td { border-top: 2px solid var(--line); }
.note { border-left: 4px solid #e07a2f; background: #fff6ee; padding: 8px 14px; margin: 0 0 18px; border-radius: 4px; }
.note p { margin: 2px 0; } .caption { color: var(--faint); font-size: 13px; margin: 8px 0 0; }
details { margin: 0 0 10px; } summary { cursor: pointer; font-weight: 600; }
@media (max-width: 900px) { .two { grid-template-columns: 1fr; } }
"""


def html_report(results: Results, comparisons: Sequence[Comparison], title: str) -> str:
    """The page.

    Args:
        results: of any number of methods. comparisons: shown if there are any. title: of the page.
    """
    protocol = results.protocol
    methods, runs = len(results.methods), sum(len(method.runs) for method in results.methods)
    sub = f"{methods} method{'s' * (methods > 1)}, {runs} run{'s' * (runs > 1)} of "
    sub += f"{len(protocol.averaged)} tasks × {protocol.episodes} episodes · {datetime.now(UTC):%Y-%m-%d}"
    parts = [f"<h1>{escape(title)}</h1><p class=sub>{sub}</p>"]
    if results.notes:
        parts.append("<div class=note>" + "".join(f"<p>{escape(note)}</p>" for note in results.notes) + "</div>")
    parts.append(section("Overview", html_table(overview(results)), overview(results).title + "."))
    whiskers = f"Whiskers: {100 * protocol.confidence:g} % intervals. Black lines: the paper."
    difficulty = "Mean over tasks of the episodes of a difficulty."
    parts.append(
        pair(
            ("Suites", plots.bars(results, "suite"), whiskers),
            ("Difficulty", plots.bars(results, "difficulty"), difficulty),
        )
    )
    parts.append(section("Functional groups", plots.bars(results, "group", wide=True), whiskers))
    parts.append(section("Tasks", plots.heat_map(results), "Success rate in percent."))
    rings = "Rings: the paper's averages. Neither subgoal predictors nor the encoding of past frames are counted."
    cost = ("Efficiency", plots.efficiency(results, chunk_flops()), rings)
    points = plots.budget_points(results.methods, DEFAULT_BUDGET)
    if points:
        curve = plots.budget_curve(results, points)
        parts.append(pair(cost, ("Memory budget", curve, "Dashed: the paper's sweep.")))
    else:
        parts.append(section(*cost))
    if comparisons:
        verdicts = "; ".join(comparison.verdict for comparison in comparisons) + "."
        parts.append(section("Paired comparison", html_table(comparison_table(comparisons)), verdicts))
    subgoals = subgoal_tables(results)
    if subgoals:
        text = "Words are right when they equal the environment's, points aside; distances are of the points then."
        parts.append(section("Subgoals", "".join(f"<h3>{escape(t.title)}</h3>{html_table(t)}" for t in subgoals), text))
    chains = process_tables(results)
    if chains:
        text = "".join(f"<h3>{escape(table.title)}</h3>{html_table(table)}" for table in chains)
        parts.append(section("Where the chain broke", text, CAPTION))
    details = "".join(
        f"<details><summary>{escape(method.label)}</summary>{html_table(detail(method, results))}</details>"
        for method in results.methods
    )
    parts.append(section("Every method in full", details))
    runs_details = f"<details><summary>{runs} runs</summary>{html_table(runs_table(results))}</details>"
    parts.append(section("Runs", runs_details))
    parts.append(section("How the numbers are made", _method_text(results)))
    return document(title, parts)


def document(title: str, parts: Sequence[str]) -> str:
    """A page of these parts, in the report's style."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_CSS}</style></head>\n'
        f"<body><main>{''.join(parts)}</main></body></html>\n"
    )


def _method_text(results: Results) -> str:
    protocol = results.protocol
    errors = "count as failures" if protocol.errors == "failure" else "count as not run"
    return (
        "<p>Means and sample standard deviations (n − 1) are over runs, one run being one checkpoint with one model "
        "seed; suites, groups and the average are means over their tasks within a run first. Only runs that have every "
        f"episode of a figure enter it. Episodes that ended in an error {errors}.</p>"
        f"<p>Intervals ({100 * protocol.confidence:g} %): per task Wilson's, for the number of independent trials that "
        f"all runs are worth; elsewhere a bootstrap over episodes within tasks ({protocol.samples:,} samples, seed "
        f"{protocol.seed}). They speak of other episodes of the same tasks, the deviation of other seeds.</p>"
        "<p>Comparisons pair the episodes: an exact sign test on the episodes that one method solves in more of its "
        "runs than the other (McNemar's test where each has one run), corrected by Holm for the number of pairs.</p>"
    )


def pair(left: tuple[str, str, str], right: tuple[str, str, str]) -> str:
    """Two boxes beside each other, each title, body and caption."""
    return f"<div class=two>{section(*left)}{section(*right)}</div>"


def section(title: str, body: str, caption: str = "") -> str:
    """A box of a page."""
    below = f"<p class=caption>{escape(caption)}</p>" if caption else ""
    return f"<section><h2>{escape(title)}</h2><div class=scroll>{body}</div>{below}</section>"


def html_table(table: Table) -> str:
    """A table of a page."""
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    rows = []
    for i, row in enumerate(table.rows):
        kind = " ".join(name for name, where in (("rule", table.rules), ("strong", table.strong)) if i in where)
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
        rows.append(f'<tr class="{kind}">{cells}</tr>' if kind else f"<tr>{cells}</tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
