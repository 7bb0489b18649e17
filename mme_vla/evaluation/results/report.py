"""Reports: one self-contained HTML page with its images inside, and the training details of a
submission.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from mme_vla.config.naming import DEFAULT_BUDGET, flat
from mme_vla.errors import counted
from mme_vla.evaluation.records import checkpoint_number
from mme_vla.evaluation.results import plots
from mme_vla.evaluation.results.aggregate import Figure, Method, Results, Run
from mme_vla.evaluation.results.compare import Comparison
from mme_vla.evaluation.results.curves import CAPTION, process_tables
from mme_vla.evaluation.results.paper import chunk_flops
from mme_vla.evaluation.results.tables import (
    Table,
    comparison_table,
    detail,
    grouping_tables,
    overview,
    runs_table,
)
from mme_vla.evaluation.rollout.subgoals import subgoal_tables
from mme_vla.evaluation.store import RUN_FILE, read_run
from mme_vla.policy.sections import PolicySections
from mme_vla.utils.pages import render


@dataclass(frozen=True)
class Section:
    """A box of a page.

    figure: SVG from `plots.svg`.
    headed: whether tables stand under their titles.
    folded: tables behind a summary.
    images: name and WEBP in base64.
    terms: words that its tables and figure use, and what each means.
    links: texts and addresses below the figures.
    half: whether it takes half the width, beside another.
    """

    title: str
    figure: str = ""
    tables: Sequence[Table] = ()
    headed: bool = False
    caption: str = ""
    paragraphs: Sequence[str] = ()
    folded: Sequence[tuple[str, Table]] = ()
    images: Sequence[tuple[str, str]] = ()
    terms: Sequence[tuple[str, str]] = ()
    links: Sequence[tuple[str, str]] = ()
    half: bool = False


def html_page(
    title: str,
    sections: Sequence[Section],
    subtitle: str = "",
    notes: Sequence[str] = (),
    sortable: bool = False,
    lead: str = "",
    footnotes: Sequence[str] = (),
) -> str:
    """One self-contained page of these sections. notes: warnings. sortable: whether a click on a
    heading sorts its table. lead: what was found, in a sentence. footnotes: small print.
    """
    return render(
        "page.html",
        title=title,
        subtitle=subtitle,
        notes=notes,
        sections=sections,
        sortable=sortable,
        lead=lead,
        footnotes=footnotes,
    )


def html_report(results: Results, comparisons: Sequence[Comparison], title: str) -> str:
    """The page. results: of any number of methods. comparisons: shown if there are any. title: of
    the page.
    """
    protocol = results.protocol
    runs = sum(len(method.runs) for method in results.methods)
    subtitle = (
        f"{counted(len(results.methods), 'method')}, {counted(runs, 'run')} of {protocol.extent} ·"
        f" {datetime.now(UTC):%Y-%m-%d}"
    )
    average = overview(results)
    whiskers = f"Whiskers: {100 * protocol.confidence:g} % intervals."
    if any(method.paper for method in results.methods):
        whiskers += " Lines across: the paper."
    levels: set[str] = set()
    has_pale = False
    for method in results.methods:
        levels.update(method.figures.get("difficulty", {}))
        for figure in method.figures["task"].values():
            has_pale = has_pale or figure.is_pale
    pale = ""
    pale_cells = ""
    if has_pale:
        pale = " Pale: not all episodes of the split; n: how many."
        pale_cells = " Pale: not all episodes of the split; in brackets how many."
    difficulty = "Mean over tasks of the episodes of a difficulty."
    rings = (
        "Rings: the paper's averages. Neither subgoal predictors nor the encoding of past frames"
        " are counted."
    )
    sections = [Section("Overview", tables=[average], caption=f"{average.title}.")]

    # A chart is left out where it has one bar a method, or the same bars as the one of the tasks.
    n_tasks = len(protocol.tasks)
    has_suites = 1 < len(protocol.suites) < n_tasks
    has_groups = 1 < len(results.methods[0].figures.get("group", {})) < n_tasks
    if has_suites:
        chart = plots.bars(results, "suite")
        sections.append(Section("Suites", chart, caption=whiskers + pale, half=len(levels) > 1))
    if len(levels) > 1:
        chart = plots.bars(results, "difficulty")
        sections.append(Section("Difficulty", chart, caption=difficulty + pale, half=has_suites))
    if has_groups:
        chart = plots.bars(results, "group", wide=True)
        sections.append(Section("Functional groups", chart, caption=whiskers + pale))
    if n_tasks <= plots.MOST_TASK_BARS and len(results.methods) <= plots.MOST_BARS:
        chart = plots.bars(results, "task", wide=n_tasks > 2)
        sections.append(Section("Tasks", chart, caption=whiskers + pale))
    else:
        text = f"Success rate in percent.{pale_cells}"
        sections.append(Section("Tasks", plots.heat_map(results), caption=text))
    if groupings := grouping_tables(results):
        sections.append(Section("Groups of tasks", tables=groupings, headed=True))

    # Averages beside the paper's: of the whole benchmark alone
    points: dict[str, list[tuple[int, Figure]]] = {}
    if protocol.is_benchmark:
        points = plots.budget_points(results.methods, DEFAULT_BUDGET)
        if chart := plots.efficiency(results, chunk_flops()):
            sections.append(Section("Efficiency", chart, caption=rings, half=bool(points)))
    if points:
        curve = plots.budget_curve(points)
        sections.append(
            Section("Memory budget", curve, caption="Dashed: the paper's sweep.", half=True)
        )
    if comparisons:
        sections.append(Section("Paired comparison", tables=[comparison_table(comparisons)]))
    if subgoals := subgoal_tables(results):
        text = (
            "Words are right when they equal the environment's, points aside; distances are of the"
            " points then."
        )
        sections.append(Section("Subgoals", tables=subgoals, headed=True, caption=text))
    if chains := process_tables(results):
        sections.append(
            Section("Where the chain broke", tables=chains, headed=True, caption=CAPTION)
        )
    details = []
    for method in results.methods:
        table = detail(method, results)
        if len(table.rows) > 1:  # one row is in the overview
            details.append((method.label, table))
    if details:
        sections.append(Section("Every method in full", folded=details))
    sections += [
        Section("Runs", folded=[(counted(runs, "run"), runs_table(results))]),
        Section("How the numbers are made", paragraphs=_method_text(results)),
    ]
    lead = " ".join(conclude(results, comparisons))
    return html_page(title, sections, subtitle, results.notes, lead=lead)


def conclude(results: Results, comparisons: Sequence[Comparison]) -> list[str]:
    """What the results say, of comparisons their verdicts, else of the best method."""
    if comparisons:
        return [f"{comparison.verdict}." for comparison in comparisons]
    protocol = results.protocol
    methods = [method for method in results.methods if method.average.value is not None]
    # Methods without all episodes may be of different ones.
    ranked = [method for method in methods if method.average.mean is not None]
    kind = "methods" if len(ranked) == len(methods) else "complete methods"
    if not ranked and len(methods) > 1:
        return [f"None of {len(methods)} methods has all its episodes yet, so none is ranked."]
    ranked = ranked or methods
    ranked.sort(key=lambda method: -(method.average.value or 0))
    if not ranked:
        return []
    best = ranked[0]
    n_episodes = protocol.count(protocol.averaged)
    if best.average.mean is None:
        n_episodes = best.average.done
    tasks = counted(len(protocol.averaged), "task")
    if len(protocol.averaged) == 1:
        tasks = protocol.averaged[0]
    text = f"{best.label} solves {best.average.value:.1f} %"
    lengths = {len(protocol.numbers_of(task)) for task in protocol.averaged}
    if len(lengths) == 1 or best.average.mean is None:
        text += f" of {counted(n_episodes, 'episode')} of {tasks}"
    else:  # a mean over tasks of unequal numbers of episodes is no share of all episodes
        text += f" on average over {tasks}, {counted(n_episodes, 'episode')} in all"
    if best.average.interval is not None:
        low, high = best.average.interval
        text += f" ({100 * protocol.confidence:g} % interval {low:.1f} to {high:.1f})"
    others = ranked[1:]
    rate = round(best.average.value or 0, 6)
    equals = [method.label for method in others if round(method.average.value or 0, 6) == rate]
    if equals:
        text += f", as many as {' and '.join(equals)}"
    elif others:
        text += f", the most of {len(ranked)} {kind}; next is {others[0].label} with"
        text += f" {others[0].average.value:.1f} %"
    return [f"{text}."]


def _method_text(results: Results) -> list[str]:
    protocol = results.protocol
    errors = "count as failures" if protocol.errors == "failure" else "count as not run"
    return [
        (
            "Means and sample standard deviations (n − 1) are over runs, one run being one"
            " checkpoint with one model seed; suites, groups and the average are means over their"
            " tasks within a run first. Only runs that have every episode of a figure enter it."
            f" Episodes that ended in an error {errors}."
        ),
        (
            f"Intervals ({100 * protocol.confidence:g} %) are Wilson's, for the number of"
            " independent episodes that all runs and tasks are worth. With several trainings they"
            " are at least as wide as Student's t for other trainings (degrees of freedom by Welch"
            " and Satterthwaite). They describe other episodes of the same tasks, the deviation"
            " other seeds."
        ),
        (
            "Comparisons pair the episodes of the same scenes: an exact sign test on the episodes"
            " that one method solves in more of its runs than the other (McNemar's test where each"
            " has one run), corrected by Holm for the number of pairs. The interval of a difference"
            " is the wider of Tango's score interval and the exact one of the sign test."
        ),
    ]


UNKNOWN = "not recorded with these results: state it manually"
RECIPE = {
    "steps": "updates",
    "batch_size": "samples an update",
    "lr": "peak learning rate",
    "warmup": "warm-up updates",
    "ema": "decay of the averaged weights",
    "weight_decay": "weight decay",
}
"""Settings of a training worth stating, and what they are called."""


def policy_facts(config: Mapping[str, Any]) -> dict[str, Any]:
    """What a policy's configuration states of it and of its training, for the notes of a run;
    nothing of a served policy, whose parts are the server's.
    """
    if "served" in config:
        return {}
    sections = PolicySections.of(config)
    return {
        "memory": dict(sections.memory) or None,
        "integration": dict(sections.integration) or None,
        "data": sections.card.get("data"),
        "recipe": sections.card.get("recipe"),
    }


def read_runs(records: Iterable[Path]) -> list[dict[str, Any]]:
    """The `run.json` beside files of records, each once; records without one are passed over."""
    folders = dict.fromkeys(path.parent for path in records)
    return [read_run(folder) for folder in folders if (folder / RUN_FILE).is_file()]


# Settings that differ between runs of a model; those of the first four are never averaged
_IDENTITY = ["model", "split", "event", "subgoal.name", "checkpoint", "seed", "policy", "source"]
_RULES = ["max_actions", "only_possible"]


def mixed_settings(records: Iterable[Path]) -> list[str]:
    """A sentence for each model whose folders have several settings, and for each split whose runs
    have several rules.
    """
    runs = [flat(run["settings"]) for run in read_runs(records) if "policy" in run["settings"]]
    table = pd.DataFrame(runs, dtype=object)  # without players
    others = table.columns.difference([*_IDENTITY, *_RULES, "max_steps"])  # records have that
    table = table.reindex(columns=[*_IDENTITY, *_RULES, *others]).astype(str)
    notes = []
    for names, columns, text in (
        (_IDENTITY[:4], others, "{}: its folders have other settings ({}). Name those of one."),
        (["split"], _RULES, "Rules of runs on {} differ: {}."),
    ):
        for key, members in table.groupby(names):
            settings = members[columns]
            settings = settings.loc[:, settings.nunique() > 1].replace("nan", "none")
            values = "; ".join(
                f"{name} {' and '.join(sorted(set(settings[name])))}" for name in settings
            )
            if values:
                notes.append(text.format(", ".join(key[:2]), values))
    return notes


def training_details(methods: Sequence[Method], runs: Sequence[Mapping[str, Any]]) -> str:
    """The section `Training details` of a submission, in Markdown."""
    policies = []
    for method in methods:
        checkpoints: dict[int | str, list[Run]] = {}
        for run in method.runs:
            checkpoints.setdefault(run.key.checkpoint, []).append(run)
        for checkpoint, members in checkpoints.items():
            # What the notes of a run of this policy say of it
            facts = None
            for content in runs:
                settings = content["settings"]
                notes = content.get("notes") or {}
                is_same = (
                    settings.get("model") == method.key.model
                    and checkpoint_number(settings.get("checkpoint", "")) == checkpoint
                    and method.key.composition in (notes.get("composition"), None)
                )
                if is_same and notes.get("policy"):
                    facts = notes["policy"]
                    break
            seeds = sorted({run.key.model_seed for run in members})
            record = next(iter(members[0].records.values()))
            evaluation = (
                f"split {record.split}, {record.action_space} actions, at most {record.max_steps}"
                f" steps, model seeds {', '.join(map(str, seeds))}"
            )
            title = f"{method.label}, checkpoint {checkpoint}"
            policies.append({"title": title, "facts": [*_lines(facts), ("evaluation", evaluation)]})
    return render("training.md", policies=policies)


def _lines(facts: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    if facts is None:
        return [("policy", UNKNOWN), ("training", UNKNOWN)]
    memory = facts.get("memory")
    policy = "no memory"
    if memory:
        policy = f"memory {memory.get('name', 'without a name')}"
        if memory.get("budget") is not None:
            policy += f", {_text(memory['budget'])} tokens"
    integration = facts.get("integration")
    if integration:
        policy += f", integration {integration.get('name', 'without a name')}"
    recipe = facts.get("recipe")
    if not recipe:
        return [("policy", policy), ("training", UNKNOWN)]
    training = str(recipe)
    if isinstance(recipe, Mapping):
        stated = []
        for name, words in RECIPE.items():
            if recipe.get(name) is not None:
                stated.append(f"{words} {_text(recipe[name])}")
        training = ", ".join(stated) or UNKNOWN
    return [("policy", policy), ("data", str(facts.get("data") or UNKNOWN)), ("training", training)]


def _text(value: Any) -> str:
    """A number in its shortest form; anything else (YAML reads `1e-4` as text) as it is."""
    return f"{value:g}" if isinstance(value, int | float) else str(value)
