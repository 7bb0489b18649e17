"""Damage every kind of file that the library reads: `python benchmarks/fuzz.py [KIND…]`.

For each kind a small valid artefact is made. Each of `--mutations` copies of it is damaged in one
way and read by the library's own reader in a process with limits on time and memory. The same seed
damages in the same ways. Exit code 1 if damage was accepted without a message, or met with a
traceback, a hang or a message of more than 2,000 characters.
"""

import argparse
import io
import json
import logging
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

# small files as the tests have them
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
_CACHE = tempfile.TemporaryDirectory(prefix="fuzz-cache-")
os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_CACHE": _CACHE.name, "OMP_NUM_THREADS": "1"}

import numpy as np
import torch
from torch import Tensor, nn

from helpers import artefacts
from mme_vla import MMEPolicy
from mme_vla.cli.weights import convert as convert_weights
from mme_vla.data.cache import VisionCache
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes, open_episode
from mme_vla.errors import UserError
from mme_vla.evaluation.store import RECORDS, read_records, read_run
from mme_vla.extras.play.game import Option
from mme_vla.extras.play.vlm_players import parse_choice
from mme_vla.policy.tensor_files import WEIGHTS, save_tensors
from mme_vla.subgoal.text import (
    MalformedReply,
    parse_gemini,
    parse_memer,
    parse_subgoal,
    pixels_of_pairs,
)
from mme_vla.testing.small import SMALL_VISION, small_policy
from mme_vla.training.checkpoint import read_state, restore, save_checkpoint, trainable
from mme_vla.training.optim import EMA
from mme_vla.training.settings import KeepRule
from mme_vla.utils import SUMS, read_text, write_sums
from mme_vla.weights import load_weights, read_stats

OUTCOMES = ("refused", "warned", "harmless", "untellable", "silent", "traceback", "hang", "long")
"""Refused in words · read otherwise, with a warning · read equal · read otherwise, and no reader of
this format could know · read otherwise without a word · another exception, or the process died · no
end in time · too long a message.
"""
BAD = ("silent", "traceback", "hang", "long")
LONGEST = 2000  # characters of a message


@dataclass(frozen=True)
class Target:
    """One kind of artefact.

    make: writes a small valid artefact into an empty folder.
    read: reads all of it with the library's own reader, and returns a value that is equal for equal
        content.
    untellable: the format has no checksum, so that no reader can know whether another result is
        damage.
    """

    make: Callable[[Path], None]
    read: Callable[[Path], object]
    untellable: Callable[[Any, Any], bool] = lambda valid, result: False


def files_of(folder: Path) -> list[Path]:
    """The files that are damaged, one at a time: all but a model card."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "README.md")


@dataclass(frozen=True)
class Case:
    """One damaged copy: which file, how, and what came of it."""

    kind: str
    number: int
    file: str
    mutation: str
    outcome: str
    said: str


def fuzz(
    name: str, target: Target, mutations: int, seed: int, seconds: float = 60, gib: float = 2
) -> list[Case]:
    """Damage one kind this often.

    Raises:
        RuntimeError: the undamaged artefact cannot be read, or does not read equal twice.
    """
    with tempfile.TemporaryDirectory(prefix="fuzz-") as base:
        root = Path(base)
        (root / "valid").mkdir()
        maker = multiprocessing.get_context("fork").Process(
            target=_make, args=(target, root / "valid")
        )
        maker.start()
        maker.join()
        files = [path.relative_to(root / "valid") for path in files_of(root / "valid")]
        (kind, valid, message), again = (
            _apart(target, root / "valid", seconds, gib) for _ in range(2)
        )
        if kind != "read" or again[1] != valid:
            raise RuntimeError(
                f"The undamaged {name} cannot be read: {message or 'it reads differently twice'}"
            )
        return [
            _case(name, target, root, files, valid, number, seed, seconds, gib)
            for number in range(mutations)
        ]


def _case(
    name: str,
    target: Target,
    root: Path,
    files: list[Path],
    valid: object,
    number: int,
    seed: int,
    seconds: float,
    gib: float,
) -> Case:
    rng = random.Random(f"{name} {seed} {number}")
    work = root / f"case-{number}"
    shutil.copytree(root / "valid", work, symlinks=True)
    before = {path: (work / path).read_bytes() for path in files}
    path = rng.choice(files)
    mutation = mutate(rng, work / path)
    if (
        (work / path).is_file()
        and not (work / path).is_symlink()
        and (work / path).read_bytes() == before[path]
    ):
        mutation += " (nothing changed)"
    kind, result, message = _apart(target, work, seconds, gib)
    outcome = kind
    if kind == "read" and result == valid:
        outcome = "harmless"
    elif kind == "read":
        outcome = (
            "warned" if message else "untellable" if target.untellable(valid, result) else "silent"
        )
    elif kind == "refused" and len(message) > LONGEST:
        outcome = "long"
    _remove(work)
    return Case(
        name, number, path.as_posix(), mutation, outcome, message.replace(str(work), "<folder>")
    )


def _apart(target: Target, folder: Path, seconds: float, gib: float) -> tuple[str, object, str]:
    """Read in a child process: (`read`, `refused`, `traceback` or `hang`; the result; what was
    said).
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_read, args=(target, folder, gib, there))
    child.start()
    there.close()
    try:
        if not here.poll(seconds):
            return "hang", None, f"no end after {seconds:g} s"
        reply: tuple[str, object, str] = here.recv()
        return reply
    except EOFError:
        child.join(5)
        return "traceback", None, f"the process ended with {child.exitcode}"
    finally:
        if child.is_alive():
            child.join(1)
        if child.is_alive():
            child.kill()
        child.join()


def _make(target: Target, folder: Path) -> None:
    _quiet()
    target.make(folder)


def _quiet() -> None:
    """Encoders and decoders write to the descriptors themselves."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)


def _read(target: Target, folder: Path, gib: float, answers: Connection) -> None:

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + int(gib * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    _quiet()
    log = io.StringIO()
    logging.basicConfig(stream=log, level=logging.WARNING, force=True)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            result = target.read(folder)
        warning_texts = [
            str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)
        ]
        answers.send(("read", result, "\n".join([*warning_texts, log.getvalue()]).strip()))
    except UserError as error:
        answers.send(("refused", None, str(error)))
    except BaseException:
        answers.send(("traceback", None, traceback.format_exc(limit=-4)[-LONGEST:]))
    os._exit(0)  # no clean-up of what the parent owns


def _remove(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_symlink() or path.is_fifo():
            path.unlink()
    shutil.rmtree(folder)


def table(cases: Sequence[Case]) -> str:
    """One line a kind."""
    kinds = list(dict.fromkeys(case.kind for case in cases))
    lines = [f"| kind | tries | {' | '.join(OUTCOMES)} |", f"|---|---:|{'---:|' * len(OUTCOMES)}"]
    for kind in kinds:
        counts = Counter(case.outcome for case in cases if case.kind == kind)
        lines.append(
            f"| {kind} | {counts.total()} | {' | '.join(str(counts[name]) for name in OUTCOMES)} |"
        )
    return "\n".join(lines)


def mutate(rng: random.Random, path: Path) -> str:
    """Damage a file in one way and return the way's name."""
    ways = [
        _flip,
        _truncate,
        _insert,
        _zero,
        _noise,
        _replace_by_folder,
        _replace_by_pipe,
        _replace_by_link,
        _remove_file,
    ]
    if path.suffix in (".json", ".jsonl"):
        ways += [_change_value] * len(ways)
    way = rng.choice(ways)
    way(rng, path)
    return way.__name__.strip("_")


def _flip(rng: random.Random, path: Path) -> None:
    data = bytearray(path.read_bytes())
    for _ in range(rng.choice([1, 1, 16]) if data else 0):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def _truncate(rng: random.Random, path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: rng.randrange(max(len(data), 1))])


def _insert(rng: random.Random, path: Path) -> None:
    data = path.read_bytes()
    at = rng.randrange(len(data) + 1)
    path.write_bytes(data[:at] + rng.randbytes(rng.randint(1, 100)) + data[at:])


def _zero(rng: random.Random, path: Path) -> None:
    data = path.read_bytes()
    at = rng.randrange(max(len(data), 1))
    path.write_bytes(data[:at] + bytes(min(512, len(data) - at)) + data[at + 512 :])


def _noise(rng: random.Random, path: Path) -> None:
    path.write_bytes(rng.randbytes(rng.randint(0, 4096)))


def _replace_by_folder(rng: random.Random, path: Path) -> None:
    path.unlink()
    path.mkdir()


def _replace_by_pipe(rng: random.Random, path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _replace_by_link(rng: random.Random, path: Path) -> None:
    path.unlink()
    path.symlink_to(rng.choice(["/dev/zero", "/dev/null", path.name, "nowhere", "/etc/hostname"]))


def _remove_file(rng: random.Random, path: Path) -> None:
    path.unlink()


def _change_value(rng: random.Random, path: Path) -> None:
    """Replace or delete one value of one JSON text, however deep."""
    lines = (
        path.read_text().rstrip("\n").split("\n") if path.suffix == ".jsonl" else [path.read_text()]
    )
    line = rng.randrange(len(lines))
    root = json.loads(lines[line])
    places: list[tuple[Any, Any]] = []

    def collect(value: Any) -> None:
        for key in (
            list(value)
            if isinstance(value, dict)
            else range(len(value))
            if isinstance(value, list)
            else ()
        ):
            places.append((value, key))
            collect(value[key])

    collect(root)
    text = rng.choice(
        [
            "null",
            "true",
            "-1",
            '""',
            "{}",
            '["a"]',
            "9" * 5001,
            "1e999",
            "NaN",
            "[" * 10**6,
            '"\\ud800"',
        ]
    )
    if places:
        box, key = rng.choice(places)
        if rng.random() < 0.2:
            box.pop(key)
        else:
            box[key] = "\u2620"
    lines[line] = json.dumps(root).replace(json.dumps("\u2620"), text)
    path.write_text("\n".join(lines) + "\n")


_CONFIG = {"train": {"steps": 1}, "seed": 1}


def _policy(model: str = "framesamp_context") -> MMEPolicy:
    return small_policy(model, backbone={"depth": 1, "vision": {**SMALL_VISION, "patch_size": 16}})


def _arrays(tensors: dict[str, Tensor]) -> list[object]:
    return [value for name in sorted(tensors) for value in (name, _array(tensors[name]))]


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to(torch.float32).cpu().numpy()


def _of_policy(policy: MMEPolicy) -> list[object]:
    processor = policy.require_processor()
    stats = None if processor.stats is None else processor.stats.to_dict()
    decisive = {key: value for key, value in policy.config.items() if key != "card"}
    tokens = processor.prompt("pick up the red cube", state=np.zeros(8, np.float32))
    return [
        *_arrays(policy.state_dict()),
        decisive,
        processor.embodiment.to_dict(),
        stats,
        *map(_array, tokens),
    ]


def write_sharded(folder: Path) -> None:
    """A policy in shards, with checksums."""
    policy = _policy()
    policy.save_pretrained(folder)
    (folder / WEIGHTS).unlink()
    save_tensors(policy.state_dict(), folder, max_shard_size="200KB")
    write_sums(folder, [file.name for file in files_of(folder) if file.name != SUMS])


def write_without_sums(folder: Path) -> None:
    """The same as it was written before there were checksums, or by another program."""
    write_sharded(folder)
    (folder / SUMS).unlink()


def read_policy(folder: Path) -> object:
    """Everything that acts: weights, statistics, prompts."""
    return artefacts.digest(*_of_policy(MMEPolicy.from_pretrained(folder)))


def _training() -> tuple[MMEPolicy, EMA, torch.optim.Optimizer]:
    policy = _policy("pi05")
    parameters: dict[str, nn.Parameter] = trainable(policy)
    return policy, EMA(parameters, 0.9), torch.optim.AdamW(parameters.values(), 1e-3)


def write_training(folder: Path) -> None:
    """A training checkpoint after one update."""
    policy, ema, optimizer = _training()
    for parameter in policy.parameters():
        parameter.grad = torch.full_like(parameter, 1e-3)
    optimizer.step()
    ema.update()
    save_checkpoint(folder, 1, policy, ema, optimizer, _CONFIG, KeepRule())


def read_training(folder: Path) -> object:
    """As a resumed run reads it: the state, the processor, then weights, averages and moments."""
    checkpoint = folder / "step_000001"
    state = read_state(checkpoint)
    opened = MMEPolicy.from_pretrained(checkpoint)
    policy, ema, optimizer = _training()
    restore(checkpoint, policy, ema, optimizer)
    moments = [
        _array(value)
        for entry in optimizer.state_dict()["state"].values()
        for value in entry.values()
    ]
    averages = _arrays(ema.tensors())
    return artefacts.digest(
        state["step"],
        state["config"],
        *_of_policy(opened),
        *_arrays(policy.state_dict()),
        *averages,
        *moments,
    )


def write_released(folder: Path) -> None:
    """A run of the released JAX code (Orbax)."""
    with tempfile.TemporaryDirectory() as place:
        _policy("pi05").save_pretrained(Path(place) / "ours")
        convert_weights(Path(place) / "ours", folder / "released", to="released")


def read_released(folder: Path) -> object:
    """Weights and statistics."""
    policy = load_weights(_policy("pi05"), folder / "released")
    stats = read_stats(folder / "released" / "0")
    return artefacts.digest(
        *_arrays(policy.state_dict()), None if stats is None else stats.to_dict()
    )


def read_recording(folder: Path) -> object:
    """Every frame of every episode."""
    read: list[object] = []
    for ref in list_episodes(find_files([folder / artefacts.H5])):
        with open_episode(ref) as episode:
            read += [
                ref.index,
                ref.task,
                episode.goals,
                episode.seed,
                episode.difficulty,
                episode.exec_start,
            ]
            for frame in episode:
                read += [
                    frame.front,
                    frame.wrist,
                    frame.state,
                    frame.action,
                    frame.is_demo,
                    sorted(frame.subgoals.items()),
                ]
    return artefacts.digest(*read)


def write_summed_dataset(folder: Path) -> None:
    """The same with checksums."""
    artefacts.write_dataset(folder)
    write_sums(folder / "dataset")


def read_dataset(folder: Path) -> object:
    """Every column and image, and the checksums as `inspect` compares them."""
    source = EpisodeSource(folder / "dataset", name="fuzzed")
    source.verify()
    read: list[object] = [source.fps, source.lengths, source.exec_starts, source.subgoal_names]
    for e in range(len(source)):
        steps = range(int(source.lengths[e]))
        read += [source.goal(e), source.task(e), source.states(e), source.actions(e)]
        read += [sorted(source.subgoals(e, t).items()) for t in steps]
        read += [source.frames(e, list(steps), view) for view in source.columns]
    return artefacts.digest(*read)


def read_cache(folder: Path) -> object:
    """Every token and score."""
    source: Any = artefacts.SyntheticSource()
    cache = VisionCache(folder / "cache", source, artefacts.expected_fingerprint())
    read: list[object] = [cache.width]
    for episode in range(len(source)):
        history = cache.history(episode)
        stored = cache.spec.stored_frames(len(history))
        every = np.stack([np.repeat(stored, 4), np.tile(np.arange(4), len(stored))], axis=1)
        read += [
            history.gather(every).view(torch.int16).numpy(),
            history.scores.frames,
            history.scores.values,
        ]
    return artefacts.digest(*read)


def read_logs(folder: Path) -> object:
    """The settings and notes, and every record."""
    run = read_run(folder)
    return artefacts.digest(sorted(map(repr, run.items()))), tuple(
        map(repr, read_records(folder / RECORDS))
    )


def is_shorter(valid: Any, result: Any) -> bool:
    """A log cut after a whole line is that of a run that was stopped there: it continues with the
    missing episodes.
    """
    return result[0] == valid[0] and result[1] == valid[1][: len(result[1])]


ANSWERS = {
    "subgoal.txt": "pick up the cube at <|box_start|>(250,500)<|box_end|> now",
    "memer.json": '{"current_subtask": "open the drawer", "keyframe_positions": [1, 3]}',
    "gemini.json": '{"reasoning": "so far", "subgoal": "press the button at <100, 250.5>"}',
    "choice.json": '{"choice": "a", "point": [100, 900]}',
}


def write_replies(folder: Path) -> None:
    """What models said."""
    for name, text in ANSWERS.items():
        (folder / name).write_text(text)


def read_replies(folder: Path) -> object:
    """What the predictors and players understand of it; they count what they cannot,
    and continue.
    """
    replies = {name: read_text(folder / name, "an answer") for name in ANSWERS}
    try:
        return (
            parse_subgoal(replies["subgoal.txt"]), parse_memer(replies["memer.json"], recent=8),
            pixels_of_pairs(parse_gemini(replies["gemini.json"])),
            parse_choice(replies["choice.json"], [Option("a", "pick", True)]),
        )  # fmt: skip
    except MalformedReply as error:
        raise UserError(str(error)) from None


def _always(valid: object, result: object) -> bool:
    return True


TARGETS = {
    "checkpoint": Target(write_sharded, read_policy),
    "training-checkpoint": Target(write_training, read_training),
    "checkpoint-without-sums": Target(write_without_sums, read_policy, _always),
    "released-checkpoint": Target(write_released, read_released, _always),
    "cache": Target(artefacts.write_cache, read_cache),
    "dataset": Target(write_summed_dataset, read_dataset),
    "dataset-without-sums": Target(artefacts.write_dataset, read_dataset, _always),
    "hdf5": Target(artefacts.write_recording, read_recording, _always),
    "logs": Target(artefacts.write_logs, read_logs, is_shorter),
    "kept-answers": Target(artefacts.write_answers, artefacts.read_answers),
    "answers": Target(write_replies, read_replies, _always),
    "rows": Target(artefacts.write_rows, artefacts.read_rows),
}
"""Kind of file → how to make one and how the library reads it."""


def main(words: Sequence[str] | None = None) -> int:
    """Run from the command line; return the exit code."""
    known = TARGETS
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "kinds", nargs="*", metavar="KIND", help=f"default: all of {', '.join(known)}"
    )
    parser.add_argument("--mutations", type=int, default=200, help="of each kind (default 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60, help="for one reading (default 60)")
    parser.add_argument("--gib", type=float, default=2, help="memory for one reading (default 2)")
    parser.add_argument("--json", type=Path, help="also write every case to this file")
    args = parser.parse_args(words)
    if unknown := sorted(set(args.kinds) - set(known)):
        parser.error(f"unknown kind {unknown[0]!r}; known: {', '.join(known)}")
    cases: list[Case] = []
    for name in args.kinds or known:
        started = time.monotonic()
        cases += fuzz(name, known[name], args.mutations, args.seed, args.seconds, args.gib)
        print(f"{name}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    print(table(cases))
    bad = [case for case in cases if case.outcome in BAD]
    for case in bad:
        print(
            f"\n{case.outcome}: {case.kind} {case.number}, {case.file},"
            f" {case.mutation}\n{case.said[:LONGEST]}"
        )
    if args.json:
        content: dict[str, Any] = {
            "seed": args.seed,
            "mutations": args.mutations,
            "cases": [vars(c) for c in cases],
        }
        args.json.write_text(json.dumps(content, indent=1) + "\n")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
