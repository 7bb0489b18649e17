"""`mme-vla weights SRC DST`: a checkpoint from one format to another.

Words after the two places are overrides of configs/policy.yaml, as for every command; a checkpoint
of ours brings its own configuration. The full backbone is assumed unless `backbone=…` says
otherwise.
"""

import math
import re
import shutil
import sys
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import torch

from mme_vla.cli.errors import print_user_errors
from mme_vla.cli.help import argument_parser
from mme_vla.config.plugins import TRUST_FLAG, import_trusted, trust_as_flag
from mme_vla.errors import UserError, counted, listed, require
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_from_config, build_processor
from mme_vla.policy.saving import CONFIG, build_saved, check_processor, policy_class
from mme_vla.policy.tensor_files import DTYPES, assign_tensors, dtype_of
from mme_vla.processing.base import STATS_FILE, load_processor
from mme_vla.weights.load import adapter_of, read_as
from mme_vla.weights.source import Source, formats, method_formats, open_source
from mme_vla.weights.statistics import read_stats
from mme_vla.weights.tables import Adapter
from mme_vla.weights.writers import check_target, write_policy


def print_mapping(policy: Policy, source: Source, to: str) -> None:
    """Print which tensor becomes which, and the lists of unread, tied and derived ones. Numbered
    layers are one line.
    """
    names = formats()
    print(f"{source.folder} ({names[source.format]}) → {names[to]}; every tensor fits.")
    sides = {source.format: "read", to: "written"}
    sides.pop("ours", None)
    if not sides:
        print("Both sides have the same names.")
    for fmt, title in sides.items():
        adapter = adapter_of(fmt, policy)
        print(f"{title}: {len(adapter.needed())} tensors ↔ {len(adapter.table)} of ours")
        for heading, lines in _lists(adapter, policy).items():
            print(f"{title}, {heading}:" if lines else f"{title}, {heading}: none")
            for line in lines:
                print(f"  {line}")


def _lists(adapter: Adapter, policy: Policy) -> dict[str, list[str]]:
    """Heading → lines."""
    shapes = adapter.shapes(policy.state_dict())
    mapped: Counter[str] = Counter()
    for target, pieces in adapter.table.items():
        for piece in pieces:
            line = f"{_starred(piece.path)} [{_shape(shapes[piece.path])}] → {_starred(target)}"
            # A pattern with the same two sides only says how many axes there are.
            left, _, right = piece.pattern.partition("->")
            if left.strip() != right.strip():
                line += f" by {piece.pattern}"
            mapped[line] += 1
    unread = []
    for gap in adapter.unread:
        part = "whole" if gap.layer is None else f"layer {gap.layer}"
        size = counted(math.prod(gap.shape), "parameter")
        unread.append(f"{gap.path}, {part} [{_shape(gap.shape)}], {size}")
    derived = []
    for constant in adapter.derived:
        derived.append(f"{constant.path} [{_shape(tuple(constant.make().shape))}]")
    return {
        "mapped": [f"{line}, {counted(count, 'tensor')}" for line, count in mapped.items()],
        "unread (no action depends on them: dropped when read, zeros when written)": unread,
        "tied (copies)": [f"{name} is {copied}" for name, copied in adapter.tied.items()],
        "derived (recomputed constants)": derived,
    }


def _starred(name: str) -> str:
    return re.sub(r"(?<=\.)\d+(?=\.)", "*", name)


def _shape(shape: tuple[int, ...]) -> str:
    return "×".join(map(str, shape)) or "scalar"


EXAMPLES = (
    "lerobot/pi05_base base                         # to ours",
    "runs/modul/79999 modul model=framesamp_modul   # a released JAX run",
    "base for_lerobot --to lerobot",
    "base - --to openpi --dry-run                   # the mapping alone",
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line and convert; a mistake of the user's ends with a sentence
    and code 2.
    """
    parser = argument_parser("mme-vla weights", __doc__, EXAMPLES)
    parser.add_argument(
        "source", help="folder, safetensors file, Orbax run or step, or owner/name on the hub"
    )
    parser.add_argument(
        "destination", help="new folder; never one that exists ('-' with --dry-run)"
    )
    parser.add_argument("overrides", nargs="*", help="model=…, backbone=…, memory.budget=…")
    parser.add_argument(
        "--to", default="ours", choices=list(formats()), help="format to write (default: ours)"
    )
    parser.add_argument(
        "--dtype", default="float32", choices=list(DTYPES), help="what weights are stored in"
    )
    parser.add_argument("--config-dir", metavar="DIR", help="search YAML files of your own too")
    parser.add_argument("--asset", help="which dataset's statistics, where the source has several")
    parser.add_argument("--revision", help="branch, tag or commit of a hub repository")
    parser.add_argument(
        "--base", help="what a run was trained on, where it holds its adapters alone"
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="check the source and print the mapping, write nothing",
    )
    parser.add_argument(
        TRUST_FLAG,
        action="store_true",
        help="import the plugins that the checkpoint names: its code",
    )
    args = parser.parse_intermixed_args(
        trust_as_flag(sys.argv[1:] if arguments is None else arguments)
    )
    with print_user_errors():
        convert(**vars(args))  # each argument has the name of a parameter


def convert(
    source: str | Path,
    destination: str | Path,
    overrides: Sequence[str] = (),
    *,
    to: str = "ours",
    dtype: str = "float32",
    config_dir: str | Path | None = None,
    asset: str | None = None,
    revision: str | None = None,
    base: str | Path | None = None,
    dry_run: bool = False,
    trust_plugins: bool = False,
) -> None:
    """Convert a checkpoint; the destination appears whole or not at all.

    With `trust_plugins` the modules that a checkpoint names are imported: its author's code.
    """
    target = Path(destination).expanduser()
    kind = dtype_of(dtype)
    require(
        dry_run or not target.exists(),
        f"{target} exists: give a new folder, nothing is ever written over.",
    )
    opened = open_source(source, revision, base=base)
    trees = [] if config_dir is None else [Path(config_dir).resolve()]
    policy = _policy(opened, overrides, trees, trust_plugins)
    check_target(policy, to)
    if dry_run:
        read_as(policy, opened)
        print_mapping(policy, opened, to)
        return
    stats = read_stats(opened.folder, asset)
    is_relative = bool(policy.embodiment.action.relative)
    if (
        stats is not None
        and opened.format == "lerobot"
        and not (opened.folder / STATS_FILE).is_file()
        and is_relative != bool(opened.config.get("use_relative_actions"))
    ):
        stats = None
        warnings.warn(
            f"The statistics of {opened.folder} are left out: they are of"
            f" {'absolute' if is_relative else 'relative'} actions, and the robot"
            f" {policy.embodiment.name!r} has {'relative' if is_relative else 'absolute'} ones.",
            stacklevel=2,
        )
    tensors = read_as(policy, opened)
    if to == "ours" and policy.processor is None:
        policy.processor = build_processor(policy.config)
    with torch.no_grad():
        assign_tensors(policy, tensors, str(source), torch.float32)
    if policy.processor is not None and stats is not None:
        policy.processor.stats = stats
    draft = target.with_name(f".{target.name}.partial")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    try:
        write_policy(policy, draft, to, kind, stats)
        draft.rename(target)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    print(f"{target}: {formats()[to]}, weights in {dtype}.")


def _policy(
    opened: Source, overrides: Sequence[str], trees: Sequence[Path], trust_plugins: bool
) -> Policy:
    """The policy a source belongs to, on meta, with its processor if that can be had."""
    from mme_vla.config.composition import compose

    if opened.format == "ours":
        if overrides:
            raise UserError(
                f"{opened.folder} brings its own configuration: {' '.join(overrides)} would"
                " contradict it."
            )
        config = dict(opened.config)
        config.pop("adapters", None)  # they are merged when the weights are read
        require(
            "backbone" in config,
            f"{opened.folder} holds our weights but no config.json that describes them.",
        )
        import_trusted(config, str(opened.folder), trust_plugins)
        policy: Policy = build_saved(policy_class(config), config, str(opened.folder / CONFIG))
        policy.processor = load_processor(opened.folder)
        check_processor(policy, str(opened.folder))
        return policy
    # The model: the one that is named, else the one that the source is of.
    words = list(overrides)
    settings = {}
    for word in words:
        key, _, value = word.partition("=")
        settings[key] = value
    variants = opened.variants
    model = settings.get("model")
    if model is None:
        model = variants[0] if variants else "pi05"
        require(
            len(variants) < 2,
            f"history_config.txt beside {opened.folder} names no variant of the released code, and"
            f" its tensors are those of {listed(variants)}: name one of these, such as"
            f" model={model}.",
        )
        words.insert(0, f"model={model}")
    if variants and model not in variants:
        raise UserError(
            f"{opened.folder} says it is {listed(variants)}, but model={model} was given."
        )
    if opened.lacks_positions and "memory.positions" not in settings:
        words.append("memory.positions=none")
    print(f"Reading {opened.label} as {' '.join(words)}", file=sys.stderr)
    composed = compose("policy", words, extra_dirs=trees)
    if "backbone" not in settings:
        words.append(f"backbone={composed.full_size}")
        composed = compose("policy", words, extra_dirs=trees)

    method = method_formats().get(opened.format)
    if method is not None and method.configure is not None:
        composed = method.function("configure")(composed, opened.config, opened.folder)
    return build_from_config(composed, device="meta")
