"""`mme-vla results RUN…`: from episode records to tables and a report, beside the paper's
numbers.

RUN is a file of episode records, or a folder with `episodes*.jsonl` in it or below; shards and runs
are merged.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from mme_vla.cli.errors import print_user_errors
from mme_vla.cli.help import argument_parser
from mme_vla.config.plugins import TRUST_FLAG, import_plugins, trust_as_flag
from mme_vla.envs.episodes import ALL, GRAMMAR, check_episodes, choose_numbers, read_episodes
from mme_vla.envs.make import ROBOMME
from mme_vla.envs.metadata import FURTHER_SPLITS, HARD, HARD_EPISODES
from mme_vla.errors import UserError, counted, printable, require
from mme_vla.evaluation.records import EpisodeRecord, merge
from mme_vla.evaluation.results import ood
from mme_vla.evaluation.results.aggregate import Method, Results, aggregate, select, setting_notes
from mme_vla.evaluation.results.baselines import missing_baselines
from mme_vla.evaluation.results.compare import (
    Comparison,
    compare_all,
    pair_methods,
    why_unpaired,
)
from mme_vla.evaluation.results.curves import (
    process_tables,
    stress_curves,
    stress_figures,
    stress_table,
)
from mme_vla.evaluation.results.events import event_curves, event_table, matched_methods
from mme_vla.evaluation.results.paper import demo_records
from mme_vla.evaluation.results.report import (
    Section,
    conclude,
    html_page,
    html_report,
    mixed_settings,
    read_runs,
    training_details,
)
from mme_vla.evaluation.results.scopes import (
    PAPER_ORDER,
    TASK_FACTS,
    TEST_EPISODES,
    Protocol,
    tasks_of,
)
from mme_vla.evaluation.results.tables import (
    Table,
    comparison_table,
    detail,
    grouping_tables,
    leaderboard,
    overview,
    print_table,
    runs_table,
    to_csv,
    to_latex,
    to_markdown,
)
from mme_vla.evaluation.rollout.subgoals import subgoal_tables
from mme_vla.evaluation.store import files_below, find_records, read_folders
from mme_vla.utils import require_replaceable, write_text
from mme_vla.utils.pages import escape_markdown, render

DEMO = (
    ("pi05", None),
    ("groundsg", "qwenvl"),
    ("tokendrop_modul", None),
    ("framesamp_modul", None),
    ("ttt_expert", None),
)


EXAMPLES = (
    "outputs/evaluation --html report.html",
    "runs/a runs/b --compare framesamp_modul pi05",
    "--demo --brief",
)
VERIFY_EXAMPLES = (
    "outputs/evaluation/framesamp_modul/80000/seed42",
    "receipt.json --checkpoint downloads/step_080000",
    "outputs/blink --plugins blink",
)


DIFFERS, NOT_COMPARED = 1, 3  # exit codes of `verify`; 2 is a mistake in the command


def main(arguments: Sequence[str] | None = None) -> None:
    """Read, aggregate, compare, print, write; or check receipts."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["verify"]:
        command, args = verify, _verify_parser().parse_args(trust_as_flag(words[1:]))
    else:
        command, args = run, _parser().parse_intermixed_args(words)
    with print_user_errors():
        command(args)


def verify(args: argparse.Namespace) -> None:
    """Check receipts, print what differs and what was not compared.

    Ends with code 1 if anything differs, else with 3 if anything was not compared.
    """
    from mme_vla.evaluation import receipts

    import_plugins(args.plugins)
    paths = files_below(args.receipt, "receipt*.json")
    if args.receipt.is_file():
        paths = [args.receipt]
    require(
        paths,
        f"{args.receipt} holds no receipt: name a receipt.json, or a folder with one in it or"
        " below.",
    )
    words = set()
    for path in paths:
        result = receipts.verify(path, args.checkpoint, not args.no_scenes, args.trust_plugins)
        words.add(result.word)
        print(f"{path}: {result.word}")
        lines = list(result.differences)
        lines += [f"not compared: {line}" for line in result.not_compared]
        lines += [f"note: {line}" for line in result.notes]
        for line in lines:
            print(f"  {printable(line)}")
    # Results read these as well.
    for path in files_below(args.receipt, "episodes*.jsonl", "episodes*.jsonl.xz"):
        if not any(path.parent.glob("receipt*.json")):
            words.add("not compared")
            print(printable(f"{path}: not compared"))
            print("  not compared: records: no receipt is beside them.")
    if "differs" in words:
        raise SystemExit(DIFFERS)
    if "not compared" in words:
        raise SystemExit(NOT_COMPARED)


def run(args: argparse.Namespace) -> None:
    """Do what the parsed command line says."""
    if args.demo == bool(args.runs):
        raise UserError(
            "Name files or folders of episode records, or --demo for synthetic ones (not both)."
        )
    # What is no earlier output, such as records, is not written over.
    for path, suffixes in (
        (args.csv, (".csv", ".txt")),
        (args.latex, (".tex", ".txt")),
        (args.markdown, (".md", ".txt")),
        (args.html, (".html", ".htm")),
    ):
        if path is not None:
            require_replaceable(path, *suffixes)
    if args.episodes is not None:
        check_episodes(read_episodes(args.episodes), "--episodes")
    records = demo_records(DEMO) if args.demo else read_folders(find_records(args.runs))
    silent = []
    for path in args.runs:
        # A shard may have ended no episode; a folder is of a whole run.
        is_silent = path.is_dir() and not any(f.stat().st_size for f in find_records([path]))
        if is_silent or not records:
            silent.append(str(path))
    message = f"{', '.join(silent)}: no episode has ended there yet"
    require(bool(records), f"{message}, so there is nothing to show. Continue the evaluation.")
    if silent:
        print(f"{message}. The results are those of the others.", file=sys.stderr)
    protocol = _protocol(records, args)
    if args.title is None:
        is_benchmark = any(task in TASK_FACTS for task in protocol.tasks)
        args.title = "RoboMME results" if is_benchmark else "Results"
    if view := _view(args):
        records, _ = select(records, protocol, args.split)
        show_view(view, records, args)
        return
    results = aggregate(records, protocol, args.split, args.conflicts)
    if any(record.made_up for record in records):
        results.notes.insert(
            0, "Made-up records, sampled from the paper's rates: not a result of anything."
        )
    comparisons = compare_all(_pairs(results, args.compare), protocol)
    for comparison in comparisons:
        results.notes += comparison.notes
    results.notes += mixed_settings(find_records(args.runs))
    console = Console()
    for table in _tables(results, comparisons, detailed=not args.brief):
        print_table(table, console.width)
    for sentence in conclude(results, comparisons):
        console.print(printable(sentence), markup=False, highlight=False, soft_wrap=True)
    for note in results.notes:
        console.print(printable(f"• {note}"), markup=False, highlight=False, soft_wrap=True)
    for path in write(results, comparisons, args):
        console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)


def _protocol(records: Sequence[EpisodeRecord], args: argparse.Namespace) -> Protocol:
    """What counts: by default what has records; with `--all`, or by name, what a run is to have."""
    of_split = [record for record in records if args.split in (None, record.split)]
    full = _episodes(records, args.split)
    recorded = Protocol.of_records(of_split or records, full)
    tasks = recorded.tasks
    if args.tasks is not None:
        names: list[str] = []
        for word in args.tasks:  # as `tasks=` takes them
            names += [name.strip() for name in word.strip("[]").split(",") if name.strip()]
        tasks = tuple(names)
        if names == [ALL]:
            tasks = PAPER_ORDER
    elif args.all:
        tasks = tasks_of(records)
    if args.episodes is not None:
        last = max(record.episode for record in records)
        named = choose_numbers(read_episodes(args.episodes), max(full, last + 1), "the split")
        numbers = dict.fromkeys(tasks, tuple(named))
    elif args.all:
        numbers = {}
    else:
        # A task that is named and has no records is to have all episodes.
        numbers = {task: recorded.numbers[task] for task in tasks if task in recorded.numbers}
    return replace(
        recorded,
        tasks=tasks,
        numbers=numbers,
        errors=args.errors,
        confidence=args.confidence,
    )


def _view(args: argparse.Namespace) -> str:
    """The view that is asked for, if any; refuses two at once, and options that it would leave
    unused.
    """
    views = [name for name in ("stress", "events", "ood") if getattr(args, name)]
    require(len(views) < 2, f"{' and '.join(f'--{name}' for name in views)}: name one of them.")
    if not views:
        return ""
    names = ["csv", "latex", "compare", "all", "brief"]
    if args.stress:
        names.append("split")  # its curves are over splits
    unused = [f"--{name}" for name in names if getattr(args, name) != _parser().get_default(name)]
    require(
        not unused,
        f"{' and '.join(unused)}: not with --{views[0]}, which takes --tasks, --episodes,"
        " --errors, --markdown and --html.",
    )
    return views[0]


def _episodes(records: Sequence[EpisodeRecord], split: str | None) -> int:
    """Episodes of a task in the split that the records are of; of other environments as many as
    there are records.
    """
    of_split = [record for record in records if split in (None, record.split)]
    others = [r.episode for r in of_split if r.suite or r.env not in (None, ROBOMME)]
    if others and not any(record.task in TASK_FACTS for record in records):
        return 1 + max(others)
    known = {**FURTHER_SPLITS, HARD: HARD_EPISODES}
    counts = {known.get(str(record.split), TEST_EPISODES) for record in of_split}
    return counts.pop() if len(counts) == 1 else TEST_EPISODES


def show_view(view: str, records: Sequence[EpisodeRecord], args: argparse.Namespace) -> None:
    """Print the tables of a view that have rows, and all notes, and write them, with figures, where
    a file is named.
    """
    how = records, args.confidence, args.conflicts
    tables: list[Table | None]
    if view == "stress":
        curves = stress_curves(*how)
        tables = [stress_table(curves)]
        figures = stress_figures(curves)
        caption = "Episodes that every place of the dial has."
    elif view == "events":
        curves = event_curves(*how)
        tables = [
            event_table(records, args.conflicts),
            stress_table(curves, "Success over the length of events"),
        ]
        figures = stress_figures(curves, "control steps, frames or factor")
        caption = "Episodes that every length has."
    else:
        curves = ood.extrapolation(*how)
        tables = [
            *ood.tier_tables(*how),
            ood.hard_table(*how),
            ood.twin_table(*how),
            ood.extrapolation_table(curves),
        ]
        require(
            any(tables),
            "None of these records is of RoboMME-OOD, the hard test episodes or a twin, or has an"
            " amount.",
        )
        figures = ood.extrapolation_figures(curves)
        caption = "All splits of a run together; the training range is shaded."
    notes: list[str] = []
    blocks: list[str] = []
    sections = [Section(name, figure, caption=caption) for name, figure in figures.items()]
    for table in filter(None, tables):
        notes += table.notes
        if table.rows:
            print_table(table, Console().width)
            blocks.append(to_markdown(table))
            sections.append(Section(table.title, tables=[table]))
    notes += setting_notes(records)
    notes += mixed_settings(find_records(args.runs))
    errors = sum(record.outcome == "error" for record in merge(records, args.conflicts))
    if errors:
        notes.append(f"{counted(errors, 'episode')} ended in an error, which counts as a failure.")
    notes += missing_baselines(record.model for record in records)
    for note in notes:
        print(f"• {printable(note)}")
    texts: dict[Path, str] = {}
    if args.markdown:
        lines = [f"- {escape_markdown(note)}\n" for note in notes]
        texts[args.markdown] = "\n".join([*blocks, "".join(lines)])
    if args.html:
        texts[args.html] = html_page(args.title, sections, notes=notes)
    _write(texts)


def _write(texts: dict[Path, str]) -> None:
    for path, text in texts.items():
        write_text(path, text)


def write(results: Results, comparisons: list[Comparison], args: argparse.Namespace) -> list[Path]:
    """Write the files asked for; return their paths."""
    texts: dict[Path, str] = {}
    if args.csv:
        texts[args.csv] = to_csv(results)
    if args.latex:
        texts[args.latex] = "\n".join(map(to_latex, _tables(results, comparisons)))
    if args.markdown:
        tables = [overview(results), *grouping_tables(results)]
        for method in results.methods:
            tables += leaderboard(method, results)
        tables += [*process_tables(results), *subgoal_tables(results)]
        texts[args.markdown] = render(
            "results.md",
            tables=map(to_markdown, tables),
            training=training_details(results.methods, read_runs(find_records(args.runs))),
            comparisons=[to_markdown(comparison_table(comparisons))] if comparisons else [],
            notes=results.notes,
        )
    if args.html:
        texts[args.html] = html_report(results, comparisons, args.title)
    _write(texts)
    return list(texts)


def _tables(results: Results, comparisons: list[Comparison], detailed: bool = True) -> list[Table]:
    """The tables of the terminal, the outcome first."""
    tables = [overview(results), *grouping_tables(results)]
    if comparisons:
        tables.append(comparison_table(comparisons))
    if not detailed:
        return tables
    for method in results.methods:
        table = detail(method, results)
        if len(table.rows) > 1:  # one row is in the overview
            tables.append(table)
    return [*tables, *process_tables(results), *subgoal_tables(results), runs_table(results)]


def _pairs(
    results: Results, requested: Sequence[Sequence[str]] | None
) -> list[tuple[Method, Method]]:
    """The pairs asked for; unasked, events and their matched arms, or two methods alone that share
    episodes.
    """
    if requested is not None:
        return [(results.method(first), results.method(second)) for first, second in requested]
    candidates = matched_methods(results)
    if not candidates and len(results.methods) == 2:
        candidates = [(results.methods[0], results.methods[1])]
    pairs = []
    for pair in candidates:
        if pair_methods(*pair).keys:
            pairs.append(pair)
        else:
            results.notes.append(why_unpaired(*pair))
    return pairs


def _verify_parser() -> argparse.ArgumentParser:
    parser = argument_parser(
        "mme-vla results verify", "Check receipts of runs, without a network.", VERIFY_EXAMPLES
    )
    parser.add_argument(
        "receipt", type=Path, help="receipt.json, or a folder with receipts in it or below"
    )
    parser.add_argument(
        "--checkpoint", type=Path, help="its folder on this machine, if another than in the receipt"
    )
    parser.add_argument(
        "--no-scenes",
        action="store_true",
        help="do not build the scenes here (0.1 s each); they count as not compared",
    )
    parser.add_argument(
        "--plugins",
        nargs="+",
        default=[],
        metavar="MODULE",
        help="your own modules, of the environment for example, imported first",
    )
    parser.add_argument(
        TRUST_FLAG,
        action="store_true",
        help="import what receipts name of installed packages: their code",
    )
    return parser


def _parser() -> argparse.ArgumentParser:
    parser = argument_parser("mme-vla results", __doc__, EXAMPLES)
    parser.add_argument(
        "runs", nargs="*", type=Path, metavar="RUN", help="file of episode records, or folder"
    )
    parser.add_argument(
        "--compare",
        nargs=2,
        action="append",
        metavar=("A", "B"),
        help="pair two methods; repeatable",
    )
    parser.add_argument("--csv", type=Path, help="every figure, one a row")
    parser.add_argument("--latex", type=Path, help="tables for a paper (booktabs)")
    parser.add_argument("--markdown", type=Path, help="tables in the leaderboard's format")
    parser.add_argument("--html", type=Path, help="one self-contained page with plots")
    parser.add_argument(
        "--title", help="of the page (default: RoboMME results, of other tasks Results)"
    )
    parser.add_argument(
        "--stress", action="store_true", help="success over the dials of split=stress:… instead"
    )
    parser.add_argument(
        "--events", action="store_true", help="runs with event=… beside their matched arms instead"
    )
    parser.add_argument(
        "--ood",
        action="store_true",
        help="RoboMME-OOD by tier beside published figures, twins, extrapolation",
    )
    parser.add_argument("--brief", action="store_true", help="print the overview only")
    parser.add_argument(
        "--all",
        action="store_true",
        help="the whole benchmark, with what is missing (default: what has records)",
    )
    parser.add_argument(
        "--tasks",
        nargs="+",
        metavar="TASK",
        help="these alone, such as StopCube,BinFill, or all 16 (default: those with records)",
    )
    parser.add_argument("--episodes", help=f"of each task: {GRAMMAR} (default: those with records)")
    parser.add_argument(
        "--split", help="one of them, such as test, where there are records of several"
    )
    parser.add_argument(
        "--errors",
        default="failure",
        choices=("failure", "missing"),
        help="episodes that ended in an error count as failures (default), or as not run",
    )
    parser.add_argument(
        "--conflicts",
        default="refuse",
        choices=("refuse", "first", "last"),
        help="an episode evaluated twice with different outcomes (default: %(default)s)",
    )
    parser.add_argument(
        "--confidence", type=float, default=0.95, help="level of intervals and tests"
    )
    for name in ("--samples", "--seed"):  # of a bootstrap that earlier versions had; not read
        parser.add_argument(name, type=int, help=argparse.SUPPRESS)
    parser.add_argument(
        "--demo", action="store_true", help="synthetic records with the paper's success rates"
    )
    return parser
