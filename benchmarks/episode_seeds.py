"""Which seed every episode of the benchmark has, found by demonstrating them as the benchmark's generator did.

    python benchmarks/episode_seeds.py [--splits test val train] [--tasks TASK ...] [--workers 2] [--output FILE]

An episode has the seed of the formula unless the official demonstrator failed on it; then the seed was raised by one
until it succeeded. Here our demonstrator, without its second tries, does the same, unrendered. An interrupted run goes
on with the same command; `--write` then puts what was found into mme_vla/assets/robomme_metadata as `derived`.
"""

import argparse
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import SPLITS, EpisodeSpec, episodes, formula, generate, write
from mme_vla.envs.recording.recorder import Recorder
from mme_vla.envs.scene.placement import SceneError
from mme_vla.envs.task_names import TASK_NAMES

MOST_TRIES = 20
PUBLISHED = {
    ("VideoPlaceOrder", "train", 6): 11_603,
    ("MoveCube", "train", 6): 14_602,
    ("InsertPeg", "train", 6): 13_602,
}
"""The demonstrations of these seeds have the lengths that were published of these episodes; earlier seeds' have not."""
TABLES = Path(__file__).resolve().parents[1] / "mme_vla" / "assets" / "robomme_metadata"


def find_seed(task: str, split: str, episode: int) -> dict[str, Any]:
    """The first seed from the formula's on with which the demonstration succeeds, and why those before it did not."""
    first, difficulty = formula(task, split, episode)
    recovery = EpisodeSpec(task, split, episode, first, difficulty, "formula").recovery
    found = {"task": task, "split": split, "episode": episode, "difficulty": difficulty}
    failures: list[str] = []
    for seed in range(first, first + MOST_TRIES):
        reason, steps = demonstrate(task, seed, difficulty, recovery)
        if reason is None:
            return found | {"seed": seed, "steps": steps, "failures": failures}
        failures.append(reason)
    return found | {"seed": None, "failures": failures}


def demonstrate(task: str, seed: int, difficulty: str, recovery: str | None) -> tuple[str | None, int]:
    """Why a demonstration fails, None if it does not; and its steps."""
    try:
        env = make_task(task, render=False, seed=seed, difficulty=difficulty, recovery=recovery, second_tries=False)
    except SceneError as error:
        return str(error), 0
    try:
        result = Recorder(env, render=False).record()
    except SceneError as error:
        return str(error), 0
    finally:
        env.close()
    return None if result.success else result.error or "failed", result.steps


def missing(args: argparse.Namespace) -> Iterator[tuple[str, str, int]]:
    """Every episode that was asked for and is not in the output yet."""
    done = set()
    if args.output.exists():
        done = {(row["task"], row["split"], row["episode"]) for row in map(json.loads, args.output.open())}
    for split in args.splits:
        for episode in range(SPLITS[split]):
            yield from ((task, split, episode) for task in args.tasks if (task, split, episode) not in done)


def write_tables(output: Path) -> None:
    """Replace the formula's seeds in the shipped tables by those that were found."""
    known = [spec for task in TASK_NAMES for split in SPLITS for spec in episodes(task, split)]
    official = {(s.task, s.split, s.episode): s for s in known if s.source == "official"}
    for (task, split, index), seed in PUBLISHED.items():
        official[task, split, index] = EpisodeSpec(task, split, index, seed, formula(task, split, index)[1], "official")
    specs = {}
    for row in map(json.loads, output.open()):
        if row["seed"] is not None:
            place = row["task"], row["split"], row["episode"]
            specs[place] = EpisodeSpec(*place, row["seed"], row["difficulty"], "derived")
    write(generate((specs | official).values()), TABLES)


def main() -> None:
    """Demonstrate what is missing."""
    from rich.progress import track

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splits", nargs="+", default=["test", "val", "train"])
    parser.add_argument("--tasks", nargs="+", default=list(TASK_NAMES))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("outputs/episode_seeds.jsonl"))
    parser.add_argument("--write", action="store_true", help="put what was found into the shipped tables")
    args = parser.parse_args()
    if args.write:
        write_tables(args.output)
        return
    jobs = list(missing(args))
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(args.workers) as pool, args.output.open("a") as file:
        futures = [pool.submit(find_seed, *job) for job in jobs]
        for future in track(as_completed(futures), "episodes", len(futures)):
            file.write(json.dumps(future.result()) + "\n")
            file.flush()


if __name__ == "__main__":
    main()
