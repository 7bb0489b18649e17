r"""Whether the benchmark's seeds come out of its own rule: every episode demonstrated as its
generator did.

    python benchmarks/episode_seeds.py [--splits test val train] [--tasks TASK ...] [--workers 2] \
        [--output FILE]

An episode has the seed of the formula unless the official demonstrator failed on it; then the seed
was raised by one until it succeeded. Here our demonstrator, without its second tries, does the
same, unrendered. An interrupted run goes on with the same command; `--compare` reports where what
was found differs from the benchmark's tables.
"""

import argparse
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import SPLITS, TASK_NAMES, EpisodeSpec, episode, formula
from mme_vla.envs.robomme.recording.recorder import Recorder
from mme_vla.envs.robomme.scene.placement import SceneError

MOST_TRIES = 20


def find_seed(task: str, split: str, index: int) -> dict[str, Any]:
    """The first seed from the formula's on with which the demonstration succeeds, and why those
    before it did not.
    """
    first, difficulty = formula(task, split, index)
    recovery = EpisodeSpec(task, split, index, first, difficulty).recovery
    entry = {"task": task, "split": split, "episode": index, "difficulty": difficulty}
    failures: list[str] = []
    for seed in range(first, first + MOST_TRIES):
        reason, steps = demonstrate(task, seed, difficulty, recovery)
        if reason is None:
            return entry | {"seed": seed, "steps": steps, "failures": failures}
        failures.append(reason)
    return entry | {"seed": None, "failures": failures}


def demonstrate(
    task: str, seed: int, difficulty: str, recovery: str | None
) -> tuple[str | None, int]:
    """Why a demonstration fails, None if it does not; and its steps."""
    try:
        env = make_task(
            task,
            render=False,
            seed=seed,
            difficulty=difficulty,
            recovery=recovery,
            second_tries=False,
        )
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
        done = {
            (row["task"], row["split"], row["episode"])
            for row in map(json.loads, args.output.open())
        }
    for split in args.splits:
        for index in range(SPLITS[split]):
            yield from (
                (task, split, index) for task in args.tasks if (task, split, index) not in done
            )


def compare(output: Path) -> Iterator[str]:
    """One line for each episode whose seed came out differently, and one for each split."""
    counts: dict[str, list[int]] = {}
    for row in map(json.loads, output.open()):
        spec = episode(row["task"], row["split"], row["episode"])
        differs, total = counts.setdefault(spec.split, [0, 0])
        counts[spec.split] = [differs + (row["seed"] != spec.seed), total + 1]
        if row["seed"] != spec.seed:
            yield (
                f"{spec.task} {spec.split} {spec.episode}: found {row['seed']}, the benchmark has"
                f" {spec.seed}"
            )
    for split, (differs, total) in counts.items():
        yield f"{split}: {differs} of {total} differ"


def main() -> None:
    """Demonstrate what is missing."""
    from rich.progress import track

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--splits", nargs="+", default=["test", "val", "train"])
    parser.add_argument("--tasks", nargs="+", default=list(TASK_NAMES))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("outputs/episode_seeds.jsonl"))
    parser.add_argument(
        "--compare", action="store_true", help="report what was found beside the benchmark's tables"
    )
    args = parser.parse_args()
    if args.compare:
        for line in compare(args.output):
            print(line)
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
