"""Damage every kind of file the library reads, and see what it says: `python benchmarks/fuzz.py [KIND…]`.

For each kind a small valid artefact is made; each of `--mutations` copies of it is damaged in one way and read by the
library's own reader in a process of its own, which has `--seconds` and `--gib` of memory beyond what it begins with.
The same seed damages in the same ways. Exit code 1 if damage was accepted silently, or met with a traceback, a hang or
a message of more than 2,000 characters. Nothing but temporary files is written, unless `--json` names a file.
"""

import argparse
import importlib.util
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
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for `benchmarks` itself
_CACHE = tempfile.TemporaryDirectory(prefix="fuzz-cache-")
os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_CACHE": _CACHE.name, "OMP_NUM_THREADS": "1"}

from benchmarks.fuzz_targets.base import Target  # noqa: E402
from benchmarks.fuzz_targets.mutations import mutate  # noqa: E402

OUTCOMES = ("refused", "warned", "harmless", "untellable", "silent", "traceback", "hang", "long")
"""Refused in words · read otherwise, with a warning · read equal · read otherwise, and no reader of this format could
know · read otherwise without a word · another exception, or the process died · no end in time · too long a message."""
BAD = ("silent", "traceback", "hang", "long")
LONGEST = 2000  # characters of a message


@dataclass(frozen=True)
class Case:
    """One damaged copy: which file, how, and what came of it."""

    kind: str
    number: int
    file: str
    mutation: str
    outcome: str
    said: str


def targets() -> dict[str, Target]:
    """All kinds by name; those of checkpoints lie in a module of their own."""
    from benchmarks.fuzz_targets import data, texts

    entries = [*data.TARGETS, *texts.TARGETS]
    if importlib.util.find_spec("benchmarks.fuzz_targets.checkpoints"):
        entries = [*importlib.import_module("benchmarks.fuzz_targets.checkpoints").TARGETS, *entries]
    return {target.name: target for target in entries}


def fuzz(target: Target, mutations: int, seed: int, seconds: float = 60, gib: float = 2) -> list[Case]:
    """Damage one kind this often.

    Raises:
        RuntimeError: the undamaged artefact cannot be read, or does not read equal twice.
    """
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        root = Path(name)
        (root / "valid").mkdir()
        maker = multiprocessing.get_context("fork").Process(target=_make, args=(target, root / "valid"))
        maker.start()
        maker.join()
        files = [path.relative_to(root / "valid") for path in target.files(root / "valid")]
        (kind, valid, message), again = (_apart(target, root / "valid", seconds, gib) for _ in range(2))
        if kind != "read" or again[1] != valid:
            raise RuntimeError(f"The undamaged {target.name} cannot be read: {message or 'it reads differently twice'}")
        return [_case(target, root, files, valid, number, seed, seconds, gib) for number in range(mutations)]


def _case(
    target: Target, root: Path, files: list[Path], valid: object, number: int, seed: int, seconds: float, gib: float
) -> Case:
    rng = random.Random(f"{target.name} {seed} {number}")
    work = root / f"case-{number}"
    shutil.copytree(root / "valid", work, symlinks=True)
    before = {path: (work / path).read_bytes() for path in files}
    path = rng.choice(files)
    mutation = mutate(rng, work / path)
    if (work / path).is_file() and not (work / path).is_symlink() and (work / path).read_bytes() == before[path]:
        mutation += " (nothing changed)"
    kind, result, message = _apart(target, work, seconds, gib)
    outcome = kind
    if kind == "read" and result == valid:
        outcome = "harmless"
    elif kind == "read":
        outcome = "warned" if message else "untellable" if target.untellable(valid, result) else "silent"
    elif kind == "refused" and len(message) > LONGEST:
        outcome = "long"
    _remove(work)
    return Case(target.name, number, path.as_posix(), mutation, outcome, message.replace(str(work), "<folder>"))


def _apart(target: Target, folder: Path, seconds: float, gib: float) -> tuple[str, object, str]:
    """Read in a child process: (`read`, `refused`, `traceback` or `hang`; the result; what was said)."""
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
    from mme_vla.errors import UserError

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
        warning_texts = [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]
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
        lines.append(f"| {kind} | {counts.total()} | {' | '.join(str(counts[name]) for name in OUTCOMES)} |")
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Run from the command line; return the exit code."""
    known = targets()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"default: all of {', '.join(known)}")
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
        cases += fuzz(known[name], args.mutations, args.seed, args.seconds, args.gib)
        print(f"{name}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    print(table(cases))
    bad = [case for case in cases if case.outcome in BAD]
    for case in bad:
        print(f"\n{case.outcome}: {case.kind} {case.number}, {case.file}, {case.mutation}\n{case.said[:LONGEST]}")
    if args.json:
        content: dict[str, Any] = {"seed": args.seed, "mutations": args.mutations, "cases": [vars(c) for c in cases]}
        args.json.write_text(json.dumps(content, indent=1) + "\n")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
