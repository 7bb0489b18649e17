"""`mme-vla analyse WHAT`: the paper's analyses of what a memory does.

    attention    mass on memory, observation and language, mean and maximum over layers
    modulation   mean and deviation of the predicted scales and biases
    recurrence   TTT's inner losses (RMT's change of slots) along episodes
    selection    which frames and patches are remembered along an episode, as mp4 and contact sheet
    cost         FLOPs of every model at full size, or over the memory budget
    writing      whether the frames that a memory keeps show what tasks depend on, as the simulator
                 knows it

The first three run a policy over recorded episodes: --checkpoint FOLDER, or --model NAME with fresh
weights.
"""

import argparse
import csv
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mme_vla.cli.errors import print_user_errors
from mme_vla.cli.help import argument_parser
from mme_vla.config.plugins import TRUST_FLAG, import_plugins, plugins_of, trust_as_flag
from mme_vla.config.trees import library_files
from mme_vla.errors import UserError, check_choice, counted, require
from mme_vla.policy.sections import PolicySections
from mme_vla.utils import require_replaceable, safe_name, write_atomically, write_text

if TYPE_CHECKING:
    from mme_vla.data.episodes import EpisodeSource
    from mme_vla.extras.probing.analyses.rerun_log import RerunLog
    from mme_vla.extras.probing.analyses.watches import Watch
    from mme_vla.memory.base import Memory
    from mme_vla.policy.mme import MMEPolicy

EXAMPLES = (
    "attention --checkpoint outputs/tokendrop_expert/latest",
    "selection --memory framesamp --episode 0 --output remembered.mp4",
    "cost --models tokendrop_expert pi05",
    "writing --memories framesamp tokendrop oracle random --tasks VideoUnmask --episodes 3",
)
BUDGETS = (64, 128, 256, 512, 1024)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and run one analysis."""
    args = _parser().parse_args(trust_as_flag(sys.argv[1:] if arguments is None else arguments))
    with print_user_errors():
        import_plugins(args.plugins)
        args.run(args)


def attention(args: argparse.Namespace) -> None:
    """Print the table of attention mass; the paper's beside it, where it has this model."""
    from mme_vla.extras.probing.analyses.watches import AttentionWatch

    policy, source, name = _subject(args)
    watch = AttentionWatch(policy)
    chunks = _watch(
        args,
        watch,
        lambda: {f"attention/{part}": mean for part, mean, _ in watch.lap().table()},
        policy,
        source,
    )
    mass = watch.result()
    known = _paper("attention_allocation", name)
    rows = []
    for part, mean, most in mass.table():
        printed = ""
        if f"{part}_mean" in known:
            printed = f"{known[f'{part}_mean']} / {known[f'{part}_max']}"
        rows.append([part, f"{mean:.1f}", f"{most:.1f}", printed])
    _print(
        f"{name}: attention of the action tokens (%), {counted(chunks, 'chunk')} of {source.name}",
        ["", "mean over layers", "maximum over layers", "paper"],
        rows,
    )
    _save(
        args, {"model": name, "chunks": chunks, "parts": mass.parts, "layers": mass.layers.tolist()}
    )


def modulation(args: argparse.Namespace) -> None:
    """Print mean and deviation of scale and bias, by layer and over all."""
    from mme_vla.extras.probing.analyses.watches import ModulationWatch

    policy, source, name = _subject(args)
    watch = ModulationWatch(policy)

    def laps() -> dict[str, float]:
        numbers = {}
        for part, (mean, deviation) in watch.lap().overall.items():
            numbers[f"modulation/{part}_mean"] = mean
            numbers[f"modulation/{part}_deviation"] = deviation
        return numbers

    chunks = _watch(args, watch, laps, policy, source)
    stats = watch.result()
    rows = []
    for i in range(len(stats.scale[0])):
        cells = [f"{mean[i]:.4f} ± {std[i]:.4f}" for mean, std in (stats.scale, stats.bias)]
        rows.append([str(i), *cells])
    rows.append(["all", *(f"{mean:.4f} ± {std:.4f}" for mean, std in stats.overall.values())])
    known = _paper("modulation_stats", name)
    if known:
        cells = ["paper"]
        for part in ("scale", "bias"):
            cells.append(f"{known[f'{part}_mean']} ± {known[f'{part}_std']}")
        rows.append(cells)
    _print(
        f"{name}: what the modulator predicts, {counted(chunks, 'chunk')} of {source.name}",
        ["layer", "scale", "bias"],
        rows,
    )
    _save(args, {"model": name, "chunks": chunks, **stats.overall})


def _watch(
    args: argparse.Namespace,
    watch: "Watch[Any]",
    laps: Callable[[], dict[str, float]],
    policy: "MMEPolicy",
    source: "EpisodeSource",
) -> int:
    """Replay the episodes with a watch and log its laps; how many chunks were chosen."""
    from mme_vla.extras.probing.analyses.replay import replay_all

    with watch, _rerun(args) as log:

        def draw(episode: int, step: int) -> None:
            if log is not None:
                log.views(source, episode, step)
                for name, value in laps().items():
                    log.number(name, value)

        return replay_all(policy, source, args.episodes, args.stride, args.most, draw)


def recurrence(args: argparse.Namespace) -> None:
    """Draw a recurrent memory's numbers along episodes, and write them as CSV."""
    from mme_vla.extras.probing.analyses.replay import recurrence_curves, recurrence_plot

    policy, source, name = _subject(args)
    numbers = range(len(source)) if args.episodes is None else args.episodes
    with _rerun(args) as log:
        # before the replays: a file that cannot be written is an error at once
        episode_curves = []
        for episode in numbers:
            curves = recurrence_curves(policy, source, episode, args.stride)
            episode_curves.append(curves)
            if log is None:
                continue
            for i, frame in enumerate(curves.frames.tolist()):
                log.views(source, curves.episode, frame)
                for key, values in curves.curves.items():
                    log.number(f"recurrence/{key}", values[i])
    path = args.output or Path("outputs/analyse") / f"recurrence_{name}.svg"
    table = _beside(path, ".csv")
    require_replaceable(path, ".svg")
    write_text(path, recurrence_plot(episode_curves, f"{name} on {source.name}"))
    with write_atomically(table) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["episode", "frame", *episode_curves[0].curves])
        for curves in episode_curves:
            for i, frame in enumerate(curves.frames):
                cells = [f"{values[i]:.6g}" for values in curves.curves.values()]
                writer.writerow([curves.episode, frame, *cells])
    rows = []
    for curves in episode_curves:
        for key, values in curves.curves.items():
            summary = [f"{x:.4f}" for x in (values[0], values[-1], values.mean())]
            rows.append([str(curves.episode), key, *summary])
    _print(f"{name} on {source.name}", ["episode", "", "first frame", "last frame", "mean"], rows)
    print(f"wrote {path} and {table}")


def _memory(name: str, args: argparse.Namespace) -> "Memory":
    """A memory of `mme-vla inspect`, with the overrides of `--set`."""
    from mme_vla.cli.inspect import Inspection, build_memory
    from mme_vla.config.composition import compose, resolved

    trees = [args.config_dir] if args.config_dir else []
    config = resolved(compose("inspect", [f"memory={name}", *args.set], extra_dirs=trees))
    import_plugins(plugins_of(config, "the configuration"))
    return build_memory(Inspection.from_config(config))


def selection(args: argparse.Namespace) -> None:
    """Write what a memory remembers along an episode as an mp4, and its last image as PNG."""
    from mme_vla.data.episodes import EpisodeSource
    from mme_vla.extras.probing.analyses.replay import of_one_size, selection_sheets
    from mme_vla.utils.media import write_video

    source = EpisodeSource(args.dataset)
    memory = _memory(args.memory, args)
    sheets = []
    with _rerun(args) as log:
        for step, sheet in selection_sheets(source, args.episode, memory, args.memory, args.every):
            sheets.append(sheet)
            if log is not None:
                log.views(source, args.episode, step)
                log.log_image("remembered", sheet)
    path = (
        args.output
        or Path("outputs/analyse") / f"{source.name}_episode{args.episode}_{args.memory}.mp4"
    )
    last = _beside(path, ".png")
    write_video(of_one_size(sheets), path, fps=args.fps)
    sheets[-1].save(last)
    print(f"wrote {path} ({counted(len(sheets), 'image')}) and {last}")


def cost(args: argparse.Namespace) -> None:
    """Count models at full size; with --budgets, over the memory budget beside the
    paper's success.
    """
    from mme_vla.evaluation.results.paper import paper_table
    from mme_vla.extras.probing.analyses.cost import count_model, write_costs

    known = list(library_files("model"))
    models = known
    if args.models:
        models = args.models
    elif args.budgets is not None:
        models = ["framesamp_modul", "tokendrop_modul"]
    for model in models:
        check_choice("model", model, known)
    if args.budgets is not None:
        require(
            args.output is None,
            "--output writes the table of models: leave out --budgets, or --output.",
        )
        success = {int(row["memory_tokens"]): row for row in paper_table("memory_budget")}
        rows = []
        for model in models:
            for budget in args.budgets or BUDGETS:
                counts = count_model(model, budget, args.backbone)
                flops = [_tera(counts.forward), _tera(counts.chunk)]
                printed = success.get(budget, {}).get(f"{model}_success", "")
                rows.append([model, f"{budget:,}", *flops, printed])
        columns = ["model", "memory tokens", "forward pass", "sampled chunk", "paper's success (%)"]
        return _print("FLOPs over the memory budget", columns, rows)
    costs = []
    rows = []
    for model in models:
        try:
            counts = count_model(model, backbone=args.backbone)
        except UserError as error:
            if args.models:
                raise
            print(f"{model}: not counted. {error}")  # of an installed package
            continue
        costs.append(counts)
        rows.append(
            [
                counts.model,
                str(counts.prompt),
                f"{counts.parameters / 1e6:,.1f} M",
                _tera(counts.forward),
                _tera(counts.chunk),
                _tera(counts.memory),
                "" if counts.streamed is None else _tera(counts.streamed),
                _tera(counts.frames),
            ]
        )
    columns = [
        "model",
        "prompt",
        "parameters",
        "forward pass",
        "sampled chunk",
        "memory",
        "streamed",
        "past frames",
    ]
    _print("FLOPs", columns, rows)
    if args.output:
        write_costs(costs, require_replaceable(args.output, ".csv"))
        print(f"wrote {args.output}")
    return None


def writing(args: argparse.Namespace) -> None:
    """Score what memories keep along demonstrations against the frames that show the facts of each
    task.
    """
    from mme_vla.envs.base import environment
    from mme_vla.envs.episodes import choose_episodes
    from mme_vla.extras.probing.evidence import record_evidence
    from mme_vla.extras.probing.writing import (
        REFERENCES,
        required_frames,
        score_writing,
        writing_table,
    )
    from mme_vla.memory.base import Memory
    from mme_vla.policy.mme import MMEPolicy
    from mme_vla.policy.run_folders import resolve_checkpoint

    environment(args.env).check_installed()
    policy: MMEPolicy | None = None
    selectors: dict[str, Memory | str] = {}
    for name in args.memories:
        selectors[name] = name if name in REFERENCES else _memory(name, args)
    if args.checkpoint is not None:
        policy = MMEPolicy.from_pretrained(
            resolve_checkpoint(args.checkpoint), trust_plugins=args.trust_plugins
        )
        name = str(PolicySections.of(policy.config).name or args.checkpoint.name)
        selectors[name] = policy.require_memory()
    rendered: set[int] = set()
    for selector in selectors.values():
        if not isinstance(selector, str):
            rendered |= required_frames(selector)
    number = int(args.episodes) if args.episodes.isdecimal() else args.episodes
    specs = choose_episodes(args.tasks, number, args.split, args.env)
    episodes = []
    for spec in specs:
        episode = record_evidence(spec, frozenset(rendered), args.env)
        if episode is not None:
            episodes.append(episode)
    if len(episodes) < len(specs):
        print(
            f"Left out: {counted(len(specs) - len(episodes), 'episode')} of {len(specs)}. The scene"
            " cannot be built, or the demonstrator did not succeed."
        )
    trained = None if policy is None else policy.memory
    results = {}
    for name, selector in selectors.items():
        tower = policy if selector is trained else None
        results[name] = score_writing(selector, episodes, tower)
    table = writing_table(results)
    print(table)
    if args.output:
        write_text(_beside(args.output, ".md"), table)
    _save(args, {name: result.to_dict() for name, result in results.items()})


@contextmanager
def _rerun(args: argparse.Namespace) -> "Iterator[RerunLog | None]":
    """The Rerun file that was asked for, if one was."""
    if args.rerun is None:
        yield None
        return
    from mme_vla.extras.probing.analyses.rerun_log import RerunLog

    with RerunLog(args.rerun) as log:
        yield log
    print(f"wrote {args.rerun}: rerun {args.rerun}")


def _subject(args: argparse.Namespace) -> "tuple[MMEPolicy, EpisodeSource, str]":
    """The policy, the episodes it replays, and its name."""
    from mme_vla.config.devices import find_device
    from mme_vla.data.episodes import EpisodeSource
    from mme_vla.policy.build import build_policy
    from mme_vla.policy.mme import MMEPolicy, mme_of
    from mme_vla.policy.run_folders import resolve_checkpoint

    if (args.checkpoint is None) == (args.model is None):
        raise UserError(
            "Name one policy: --checkpoint FOLDER, or --model NAME for one with fresh weights."
        )
    device = find_device(args.device)
    if args.checkpoint is not None:
        policy = MMEPolicy.from_pretrained(
            resolve_checkpoint(args.checkpoint), device=device, trust_plugins=args.trust_plugins
        )
        name = safe_name(
            str(PolicySections.of(policy.config).name or args.checkpoint.name), "the policy's name"
        )
        return policy, EpisodeSource(args.dataset, robot=policy.embodiment), name
    print(
        f"{args.model} with fresh weights: what it shows is where a model starts, not what one"
        " learns."
    )
    policy = mme_of(
        build_policy(
            args.model,
            config_dir=args.config_dir,
            backbone=args.backbone,
            device=device,
        ),
        "This analysis",
    )
    return policy, EpisodeSource(args.dataset, robot=policy.embodiment), args.model


def _paper(table: str, model: str) -> dict[str, str]:
    """The paper's row on a model, or nothing."""
    from mme_vla.evaluation.results.paper import paper_method, paper_table

    method = paper_method(model)
    if method is not None:
        for row in paper_table(table):
            if row["method"] == method.name:
                return row
    return {}


def _print(title: str, columns: Sequence[str], rows: list[list[str]]) -> None:
    from rich.console import Console

    from mme_vla.evaluation.results.tables import Table, print_table

    console = Console()
    print_table(Table(title, columns, rows), console.width if console.is_terminal else 160)


def _save(args: argparse.Namespace, values: dict[str, Any]) -> None:
    if args.output:
        require_replaceable(args.output, ".json")
        write_text(args.output, json.dumps(values, indent=1) + "\n")
        print(f"wrote {args.output}")


def _beside(path: Path, suffix: str) -> Path:
    """The second file of an output; one that is there without the first is somebody's, and not
    replaced.
    """
    other = path.with_suffix(suffix)
    require(
        path.exists() or not other.exists(),
        f"{other} exists, and would be written beside {path}: choose another --output, or remove it"
        " yourself.",
    )
    return other


def _tera(flops: int) -> str:
    return f"{flops / 1e12:.4f} T"


def _parser() -> argparse.ArgumentParser:
    parser = argument_parser("mme-vla analyse", __doc__, EXAMPLES)
    commands = parser.add_subparsers(required=True, metavar="WHAT")

    def command(run: Callable[[argparse.Namespace], None], output: str) -> argparse.ArgumentParser:
        made = commands.add_parser(run.__name__, help=run.__doc__, description=run.__doc__)
        made.set_defaults(run=run)
        made.add_argument("--output", type=Path, help=output)
        made.add_argument(
            "--plugins",
            nargs="+",
            default=[],
            metavar="MODULE",
            help="your own modules, imported first",
        )
        if run is not cost:
            made.add_argument(
                "--config-dir",
                type=Path,
                metavar="DIR",
                help="search YAML files of your own too",
            )
        if run not in (cost, writing):
            made.add_argument(
                "--rerun",
                type=Path,
                help="also for the Rerun viewer, step by step (.rrd; extra viz)",
            )
        return made

    for run, output in (
        (attention, "JSON"),
        (modulation, "JSON"),
        (recurrence, "SVG, with a CSV beside it"),
    ):
        made = command(run, output)
        made.add_argument(
            "--checkpoint", type=Path, help="a checkpoint or run folder of this library"
        )
        made.add_argument(
            TRUST_FLAG,
            action="store_true",
            help="import the plugins that the checkpoint names: its code",
        )
        made.add_argument("--model", help="a model with fresh weights instead")
        made.add_argument("--backbone", default="tiny", help="of --model (default: %(default)s)")
        made.add_argument(
            "--dataset",
            default="sample",
            help="LeRobot v3.0 folder (default: %(default)s, built in)",
        )
        made.add_argument(
            "--episodes", type=int, nargs="+", help="which of its episodes (default: all)"
        )
        made.add_argument(
            "--stride", type=int, default=16, help="steps between two chunks (default: %(default)s)"
        )
        if run is not recurrence:  # its last chunk has all that it read
            made.add_argument(
                "--most", type=int, help="chunks of an episode at most (default: all)"
            )
        made.add_argument("--device", default="cpu")
    made = command(selection, "mp4, with a PNG of its last image beside it")
    made.add_argument(
        "--memory", default="tokendrop", help="a memory of configs/memory (default: %(default)s)"
    )
    made.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="its options, as memory.budget=256",
    )
    made.add_argument("--dataset", default="sample")
    made.add_argument("--episode", type=int, default=0)
    made.add_argument(
        "--every", type=int, default=8, help="steps between two images (default: %(default)s)"
    )
    made.add_argument("--fps", type=int, default=4, help="images a second (default: %(default)s)")
    made = command(writing, "JSON, with the tables beside it as Markdown")
    made.add_argument(
        "--memories", nargs="*", default=["framesamp", "oracle", "random"], metavar="NAME",
        help="memories of configs/memory, and oracle, random, boundaries (default: %(default)s)",
    )  # fmt: skip
    made.add_argument(
        "--set", nargs="*", default=[], metavar="KEY=VALUE", help="their options, as memory.grid=2"
    )
    made.add_argument("--checkpoint", type=Path, help="also the memory of a trained policy")
    made.add_argument(
        TRUST_FLAG,
        action="store_true",
        help="import the plugins that the checkpoint names: its code",
    )
    made.add_argument(
        "--tasks", default="all", help="all, or names with commas (default: %(default)s)"
    )
    made.add_argument(
        "--episodes",
        default="3",
        help="3 for the first three, 0-9 for a range (default: %(default)s)",
    )
    made.add_argument("--split", default="test", help="of the benchmark (default: %(default)s)")
    made.add_argument(
        "--env", default="mme_vla", help="an environment with facts (default: %(default)s)"
    )
    made = command(cost, "CSV")
    made.add_argument("--models", nargs="+", metavar="NAME", help="default: all")
    made.add_argument(
        "--budgets", nargs="*", type=int, help=f"memory budgets; none named: {BUDGETS}"
    )
    made.add_argument("--backbone", help="size (default: each model's full size)")
    return parser
