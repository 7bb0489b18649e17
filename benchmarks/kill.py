"""Kill commands (SIGKILL) before changes they make to files, then repeat them with the same words.

    python benchmarks/kill.py [train cache convert evaluate record] [--every 1] [--times 5]

The results must equal those of an undisturbed run bit by bit, apart from times. Each run is a fresh
process. Python's audit events tell when it opens a file for writing, renames, removes or makes a
folder: it is killed before every `--every`-th of these, and `--times` times after a random part of
its duration, while libraries write their files.
"""

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "tests"))  # small files as the tests have them

SMALL = (
    "model=tokendrop_expert backbone.depth=1 backbone.vision.depth=1 backbone.vision.image_size=32 "
    "backbone.vision.patch_size=2 memory.budget=64"
)
RECIPE = (
    "train.steps=3 train.save_every=1 train.log_every=1 train.val_every=2 train.val_samples=1"
    " train.batch_size=1 train.open_loop_chunks=1 train.device=cpu train.workers=0"
    " train.keep.last=1 logger=none"
)
COMMANDS = {
    "train": f"train {SMALL} {RECIPE} data.cache.root=cache output=out/run resume=auto",
    "cache": f"cache {SMALL} data.cache.root=out device=cpu",
    "convert": "convert input=recordings output=out/dataset",
    "evaluate": (
        "evaluate model=pi05 backbone=tiny tasks=[StopCube] episodes=2 max_steps=2 workers=1"
        " render=false flow_steps=1 seed=7 output=out/run"
    ),
    "record": (
        "record task=[StopCube,PickXtimes] episodes=1 frames=[0] workers=1 output=out/dataset"
        " hdf5=out/files"
    ),
}
"""Words after `mme-vla`, run in a folder with the inputs `cache` and `recordings`. Results are
below `out`.
"""

RUN = """
import os, runpy, signal, sys
below, kill_at = os.path.join(os.getcwd(), "out"), int(sys.argv[1])
log = os.open(sys.argv[2], os.O_WRONLY | os.O_CREAT)
main, count = os.getpid(), 0
CHANGES = {"os.rename": 1, "os.remove": 0, "os.mkdir": 0, "os.rmdir": 0}
CHANGES |= {"os.link": 1, "os.symlink": 1}
def watch(event, args):
    global count
    if event == "open":
        path = args[0] if args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) else None
    else:
        path = args[CHANGES[event]] if event in CHANGES else None
    if isinstance(path, (str, bytes, os.PathLike)) and os.getpid() == main:
        path = os.path.abspath(os.fsdecode(path))
        if path.startswith(below):
            count += 1
            os.write(log, f"{event} {path[len(below) + 1:]}\\n".encode())
            if count == kill_at:
                os.kill(main, signal.SIGKILL)
sys.addaudithook(watch)
sys.argv = ["mme_vla", *sys.argv[3:]]
runpy.run_module("mme_vla", run_name="__main__", alter_sys=True)
"""
# What only tells when and how fast, and the checksums of lines that do.
TIMES = re.compile(
    r'"(?:seconds|when|begun|speed/\w+|memory/gib|crc32)": ?(?:"[^"]*"|\{[^}]*\}|[-+.\w]+)'
)


@dataclass
class Outcome:
    """Kills of one command: after how many it failed, ended with other results, or left other files
    behind.
    """

    command: str
    changes: int = 0
    kills: int = 0
    refused: int = 0
    wrong: int = 0
    left: int = 0
    places: list[str] = field(default_factory=list)


def results(folder: Path) -> dict[str, str]:
    """A hash of every file below a folder, without what only tells the time."""
    sums = {}
    for path in sorted(file for file in folder.rglob("*") if file.is_file()):
        data = path.read_bytes()
        if path.suffix in (".json", ".jsonl"):
            data = TIMES.sub("", data.decode()).encode()
        if "events.out" not in path.name:
            sums[path.relative_to(folder).as_posix()] = hashlib.sha256(data).hexdigest()
    return sums


def run(
    words: str, base: Path, kill_at: int = 0, after: float | None = None
) -> tuple[int, list[str], str]:
    """Exit code, changes and errors of a command; it is killed before a change, or after so many
    seconds.
    """
    log = base / "changes.log"
    log.unlink(missing_ok=True)
    path = os.pathsep.join([str(REPOSITORY), *sys.path[:1]])
    variables = {
        **os.environ,
        "PYTHONPATH": path,
        "OMP_NUM_THREADS": "1",
        "HF_HUB_OFFLINE": "1",
        "PYTHONHASHSEED": "0",
    }
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", RUN, str(kill_at), str(log), *words.split()],
        cwd=base,
        env=variables,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        _, errors = process.communicate(timeout=600 if after is None else after)
    except subprocess.TimeoutExpired:
        process.kill()
        _, errors = process.communicate()
    return process.returncode, log.read_text().splitlines() if log.exists() else [], errors


def attack(name: str, every: int, times: int, base: Path) -> Outcome:
    """Kill a command in each way, and compare what its repetition writes with an
    undisturbed run.
    """
    words, outcome, out = COMMANDS[name], Outcome(name), base / "out"
    begun = time.monotonic()
    code, changes, errors = run(words, base)
    duration = time.monotonic() - begun
    if code:
        raise RuntimeError(f"an undisturbed run of {name} ended with {code}:\n{errors[-3000:]}")
    expected, outcome.changes = results(out), len(changes)
    rng = random.Random(0)
    ways = [{"kill_at": number} for number in range(every, len(changes) + 1, every)]
    ways += [{"after": duration * rng.uniform(0.3, 1)} for _ in range(times)]  # type: ignore[misc]
    for way in ways:
        shutil.rmtree(out, ignore_errors=True)
        killed, observed, _ = run(words, base, **way)  # type: ignore[arg-type]
        outcome.kills += killed == -signal.SIGKILL
        again, _, errors = run(words, base)
        files = results(out)
        wrong = sorted(path for path, value in expected.items() if files.get(path) != value)
        left = sorted(files.keys() - expected.keys())
        outcome.refused += again != 0
        outcome.wrong += again == 0 and bool(wrong)
        outcome.left += again == 0 and bool(left)
        if again or wrong or left:
            last = observed[-1] if observed else "no change"
            outcome.places.append(
                f"{way} at {last}: exit {again}, {wrong[:4]}, {left[:4]}"
                f" {errors[-300:] * bool(again)}"
            )
    shutil.rmtree(out, ignore_errors=True)
    return outcome


def main() -> None:
    """Run the attacks and print their table."""
    parser = argparse.ArgumentParser(
        "python benchmarks/kill.py", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "commands",
        nargs="*",
        default=list(COMMANDS),
        help=f"of {', '.join(COMMANDS)}; default: all",
    )
    parser.add_argument(
        "--every", type=int, default=1, help="kill before every so manieth change (default: each)"
    )
    parser.add_argument(
        "--times",
        type=int,
        default=5,
        help="kills after a random part of the duration (default: 5)",
    )
    parser.add_argument("--json", type=Path, help="write the outcomes here")
    args = parser.parse_args()
    if unknown := set(args.commands) - set(COMMANDS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(COMMANDS)}")
    from helpers.h5_files import write_file

    outcomes = []
    print("| command | changes | kills | refused | wrong | left behind |\n|---|" + "---:|" * 5)
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder).resolve()
        (base / "recordings").mkdir()
        write_file(base / "recordings" / "record_dataset_Alpha.h5", [6, 5], videos=[2, 0], size=64)
        write_file(base / "recordings" / "record_dataset_Beta.h5", [4], size=64)
        for name in args.commands:
            o = attack(name, args.every, args.times, base)
            outcomes.append(o)
            print(
                f"| {name} | {o.changes} | {o.kills} | {o.refused} | {o.wrong} | {o.left} |",
                flush=True,
            )
    print("\n".join(f"{o.command}: {place}" for o in outcomes for place in o.places))
    if args.json:
        args.json.write_text(json.dumps([asdict(o) for o in outcomes], indent=2) + "\n")
    raise SystemExit(any(o.refused or o.wrong for o in outcomes))


if __name__ == "__main__":
    main()
