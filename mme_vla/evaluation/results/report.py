"""One self-contained HTML page of results: no script, no address, images inside."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from mme_vla.evaluation.results import plots
from mme_vla.evaluation.results.aggregate import DEFAULT_BUDGET, Results
from mme_vla.evaluation.results.compare import Comparison
from mme_vla.evaluation.results.curves import CAPTION, process_tables
from mme_vla.evaluation.results.paper import chunk_flops
from mme_vla.evaluation.results.tables import Table, comparison_table, detail, overview, runs_table
from mme_vla.evaluation.rollout.subgoals import subgoal_tables
from mme_vla.utils.pages import render


@dataclass(frozen=True)
class Section:
    """A box of a page.

    figure: SVG from `plots.svg`. headed: whether tables stand under their titles. folded: tables behind a summary.
    images: name and WEBP in base64. half: whether it takes half the width, beside another.
    """

    title: str
    figure: str = ""
    tables: Sequence[Table] = ()
    headed: bool = False
    caption: str = ""
    paragraphs: Sequence[str] = ()
    folded: Sequence[tuple[str, Table]] = ()
    images: Sequence[tuple[str, str]] = ()
    half: bool = False


def html_page(title: str, sections: Sequence[Section], subtitle: str = "", notes: Sequence[str] = ()) -> str:
    """One self-contained page of these sections."""
    return render("page.html", title=title, subtitle=subtitle, notes=notes, sections=sections)


def html_report(results: Results, comparisons: Sequence[Comparison], title: str) -> str:
    """The page.

    Args:
        results: of any number of methods. comparisons: shown if there are any. title: of the page.
    """
    protocol = results.protocol
    methods, runs = len(results.methods), sum(len(method.runs) for method in results.methods)
    sub = f"{methods} method{'s' * (methods > 1)}, {runs} run{'s' * (runs > 1)} of "
    sub += f"{len(protocol.averaged)} tasks × {protocol.episodes} episodes · {datetime.now(UTC):%Y-%m-%d}"
    average, whiskers = (
        overview(results),
        f"Whiskers: {100 * protocol.confidence:g} % intervals. Black lines: the paper.",
    )
    difficulty = "Mean over tasks of the episodes of a difficulty."
    rings = "Rings: the paper's averages. Neither subgoal predictors nor the encoding of past frames are counted."
    points = plots.budget_points(results.methods, DEFAULT_BUDGET)
    sections = [
        Section("Overview", tables=[average], caption=f"{average.title}."),
        Section("Suites", plots.bars(results, "suite"), caption=whiskers, half=True),
        Section("Difficulty", plots.bars(results, "difficulty"), caption=difficulty, half=True),
        Section("Functional groups", plots.bars(results, "group", wide=True), caption=whiskers),
        Section("Tasks", plots.heat_map(results), caption="Success rate in percent."),
        Section("Efficiency", plots.efficiency(results, chunk_flops()), caption=rings, half=bool(points)),
    ]
    if points:
        curve = plots.budget_curve(results, points)
        sections.append(Section("Memory budget", curve, caption="Dashed: the paper's sweep.", half=True))
    if comparisons:
        verdicts = "; ".join(comparison.verdict for comparison in comparisons) + "."
        sections.append(Section("Paired comparison", tables=[comparison_table(comparisons)], caption=verdicts))
    if subgoals := subgoal_tables(results):
        text = "Words are right when they equal the environment's, points aside; distances are of the points then."
        sections.append(Section("Subgoals", tables=subgoals, headed=True, caption=text))
    if chains := process_tables(results):
        sections.append(Section("Where the chain broke", tables=chains, headed=True, caption=CAPTION))
    details = [(method.label, detail(method, results)) for method in results.methods]
    sections += [
        Section("Every method in full", folded=details),
        Section("Runs", folded=[(f"{runs} runs", runs_table(results))]),
        Section("How the numbers are made", paragraphs=_method_text(results)),
    ]
    return html_page(title, sections, sub, results.notes)


def _method_text(results: Results) -> list[str]:
    protocol = results.protocol
    errors = "count as failures" if protocol.errors == "failure" else "count as not run"
    return [
        "Means and sample standard deviations (n − 1) are over runs, one run being one checkpoint with one model seed; "
        "suites, groups and the average are means over their tasks within a run first. Only runs that have every "
        f"episode of a figure enter it. Episodes that ended in an error {errors}.",
        f"Intervals ({100 * protocol.confidence:g} %): per task Wilson's, for the number of independent trials that "
        f"all runs are worth; elsewhere a bootstrap over episodes within tasks ({protocol.samples:,} samples, seed "
        f"{protocol.seed}). They describe other episodes of the same tasks, the deviation other seeds.",
        "Comparisons pair the episodes: an exact sign test on the episodes that one method solves in more of its runs "
        "than the other (McNemar's test where each has one run), corrected by Holm for the number of pairs.",
    ]
