"""Commands killed (SIGKILL) before every change they make to a file, then repeated with the same words.

    python benchmarks/kill.py [train cache convert record evaluate] [--every 1] [--only rename …] [--minutes 60]

What comes out must equal an undisturbed run's result bit by bit, but for times. `kill_tracer.py` says what is seen of a
process; `kill_commands.py` what is run: small models, synthetic demonstrations, a scripted environment, the synthetic
simulator of one process. Nothing leaves the machine.
"""

import argparse
import json
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib import import_module
from itertools import groupby
from pathlib import Path

os.environ |= {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1", "TQDM_DISABLE": "1"}
sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parent.parent / "tests")]

from kill_commands import COMMANDS, Command, results  # noqa: E402
from kill_tracer import trace  # noqa: E402


@dataclass
class Outcome:
    """What came of killing one command.

    changes: file operations of an undisturbed run. kills: how many of them it was killed before.
    refused: kills after which the same words failed. wrong: after which the results differ.
    left: after which something lies beside them. outlived: after which a process of the command lived on.
    places: what was about to be done in all of these.
    """

    command: str
    changes: int = 0
    kills: int = 0
    refused: int = 0
    wrong: int = 0
    left: int = 0
    outlived: int = 0
    seconds: float = 0.0
    places: list[str] = field(default_factory=list)

    @property
    def failures(self) -> int:
        return self.refused + self.wrong + self.outlived


def attack(
    name: str,
    every: int,
    base: Path,
    until: float = float("inf"),
    first: int = 1,
    only: Sequence[str] = (),
    thin: bool = False,
    skip: int = 0,
) -> Outcome:
    """Kill a command before every so manieth of its changes from number `first` on, each time in a new folder.

    Args:
        only: kinds of change to kill before, such as `rename`; empty: all.
        thin: of successive writes to one file take the first, the middle and the last one alone.
        skip: leave out so many, which an earlier attack had time for.
    """
    command, begun, outcome = COMMANDS[name], time.monotonic(), Outcome(name)
    inputs, log = base / f"{name}-inputs", base / f"{name}.log"
    inputs.mkdir()
    folder = base / name  # the same for all runs: some results say where they lie
    _import_what_it_uses(command, inputs, folder, log)
    expected, changes = _run(command.run, inputs, folder, log)
    outcome.changes = len(changes)
    selected = _ends_and_middles(changes) if thin else range(1, len(changes) + 1)
    numbers = [n for n in selected if n >= first and (not only or changes[n - 1].split()[0] in only)]
    numbers = numbers[::every]
    random.Random(0).shuffle(numbers)  # so that what there is time for is spread over the run
    for number in numbers[skip:]:
        if time.monotonic() > until:
            break
        folder.mkdir()
        work = partial(_quiet, partial(command.run, inputs, folder), log)
        killed = trace(work, folder, kill_at=number)
        again = trace(work, folder)
        there = results(folder)
        outcome.kills += killed.code == -9
        outcome.outlived += killed.outlived > 0
        outcome.refused += again.code != 0
        outcome.wrong += again.code == 0 and any(there.get(path) != value for path, value in expected.items())
        outcome.left += bool(there.keys() - expected.keys())
        if again.code or any(there.get(path) != value for path, value in expected.items()) or killed.outlived:
            wrong = sorted(path for path, value in expected.items() if there.get(path) != value)
            outcome.places.append(f"{number} {killed.changes[-1]}: exit {again.code}, {wrong[:4]}")
        elif extra := sorted(there.keys() - expected.keys()):
            outcome.places.append(f"{number} {killed.changes[-1]}: left {extra[:4]}")
        shutil.rmtree(folder)
    outcome.seconds = round(time.monotonic() - begun, 1)
    return outcome


def _ends_and_middles(changes: Sequence[str]) -> list[int]:
    """Numbers (from 1) of all changes, but of successive equal ones (writes to one file) of three alone.

    A Parquet file of a few hundred columns is some 550 writes, and what a kill leaves differs in its length only.
    """
    numbers: list[int] = []
    for _, group in groupby(range(1, len(changes) + 1), key=lambda n: changes[n - 1]):
        same = list(group)
        numbers += sorted({same[0], same[len(same) // 2], same[-1]})
    return numbers


def _import_what_it_uses(command: Command, inputs: Path, folder: Path, log: Path) -> None:
    """Prepare the inputs and run the command once, elsewhere, and import here what it imported.

    Forked processes then need not, and this one has neither threads nor drawn numbers of a run.
    """
    modules = log.with_suffix(".modules")

    def rehearse() -> None:
        command.prepare(inputs)
        folder.mkdir()
        command.run(inputs, folder)
        modules.write_text("\n".join(sys.modules))

    _finish(partial(_quiet, rehearse, log), folder, log)
    shutil.rmtree(folder)
    for name in modules.read_text().split("\n"):
        with suppress(Exception):  # some register modules that cannot be imported by their name
            import_module(name)


def _run(
    run: Callable[[Path, Path], object], inputs: Path, folder: Path, log: Path
) -> tuple[dict[str, str], Sequence[str]]:
    folder.mkdir()
    changes = _finish(partial(_quiet, partial(run, inputs, folder), log), folder, log)
    outputs = results(folder)
    shutil.rmtree(folder)
    return outputs, changes


def _finish(work: Callable[[], object], folder: Path, log: Path) -> Sequence[str]:
    done = trace(work, folder, limit_s=300)
    if done.code:
        raise RuntimeError(f"an undisturbed run ended with {done.code}:\n{log.read_text()[-3000:]}")
    return done.changes


def _quiet(work: Callable[[], object], log: Path) -> None:
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    work()


def main() -> None:
    """Run the attacks and print their table."""
    parser = argparse.ArgumentParser("python benchmarks/kill.py", description=__doc__.splitlines()[0])
    parser.add_argument("commands", nargs="*", default=list(COMMANDS), help=f"of {', '.join(COMMANDS)}; default: all")
    parser.add_argument("--every", type=int, default=1, help="kill before every so manieth operation (default: each)")
    parser.add_argument("--first", type=int, default=1, help="number of the first operation to kill before")
    parser.add_argument("--only", nargs="+", default=(), help="kinds of operation, such as rename (default: all)")
    parser.add_argument("--thin", action="store_true", help="three of the successive writes to one file, not all")
    parser.add_argument("--minutes", type=float, default=60, help="stop killing after so long (default: 60)")
    parser.add_argument("--skip", type=int, default=0, help="continue after so many kills of an earlier attack")
    parser.add_argument("--json", type=Path, help="write the outcomes here")
    args = parser.parse_args()
    if unknown := set(args.commands) - set(COMMANDS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(COMMANDS)}")
    until, outcomes = time.monotonic() + 60 * args.minutes, []
    print("| command | file operations | kills | refused | wrong | left behind | outlived | seconds |")
    print("|---|" + "---:|" * 7)
    with tempfile.TemporaryDirectory() as base:
        for name in args.commands:
            o = attack(name, args.every, Path(base).resolve(), until, args.first, args.only, args.thin, args.skip)
            outcomes.append(o)
            numbers = (o.changes, o.kills, o.refused, o.wrong, o.left, o.outlived, o.seconds)
            print(f"| {name} | " + " | ".join(map(str, numbers)) + " |", flush=True)
    for o in outcomes:
        for place in o.places:
            print(f"{o.command}: {place}")
    if args.json:
        args.json.write_text(json.dumps([asdict(o) for o in outcomes], indent=2) + "\n")
    raise SystemExit(any(o.failures for o in outcomes))


if __name__ == "__main__":
    main()
