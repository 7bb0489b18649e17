"""The demonstrator on fresh seeds of every task and difficulty: does it succeed, and how long are
its episodes?

    python benchmarks/demonstrations.py [TASK ...] [--seeds 5] [--first 9000000]

Unrendered. Prints a Markdown table; lengths are stored steps (with the conditioning video, without
steps that belong to no sub-task), averaged with the benchmark's weights of 50 % easy, 25 % medium
and 25 % hard, beside the paper's.
"""

import argparse
import time

from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.envs.robomme.recording.recorder import Recorder
from mme_vla.envs.robomme.scene.placement import SceneError
from mme_vla.evaluation.results.scopes import TASK_FACTS

WEIGHTS = {"easy": 0.5, "medium": 0.25, "hard": 0.25}


def demonstrate(task: str, difficulty: str, seed: int) -> tuple[bool, int, str]:
    """Whether a seed's demonstration succeeds, its stored steps, and what went wrong."""
    env = make_task(task, render=False, seed=seed, difficulty=difficulty)
    result = Recorder(env, render=False).record()
    env.close()
    return result.success, result.stored, result.error or ("" if result.success else "failed")


def seeds_with_scenes(task: str, difficulty: str, first: int, count: int) -> list[int]:
    """The first seeds from `first` on whose layout finds a place for every object."""
    seeds: list[int] = []
    seed = first
    while len(seeds) < count:
        try:
            make_task(task, render=False, seed=seed, difficulty=difficulty).close()
            seeds.append(seed)
        except SceneError:
            pass
        seed += 1
    return seeds


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", default=list(TASK_NAMES))
    parser.add_argument("--seeds", type=int, default=5, help="seeds a difficulty")
    parser.add_argument(
        "--first", type=int, default=9_000_000, help="first seed; the benchmark's own are lower"
    )
    args = parser.parse_args()
    paper = {name: TASK_FACTS[name].steps for name in TASK_NAMES}
    print("| task | easy | medium | hard | mean length | paper | ratio | seconds an episode |")
    print("|---|---|---|---|---:|---:|---:|---:|")
    for name in args.tasks:
        cells, mean, seconds, runs, problems = [], 0.0, 0.0, 0, []
        for difficulty, weight in WEIGHTS.items():
            seeds = seeds_with_scenes(name, difficulty, args.first, args.seeds)
            start = time.process_time()
            results = [demonstrate(name, difficulty, seed) for seed in seeds]
            seconds, runs = seconds + time.process_time() - start, runs + len(results)
            good = [stored for success, stored, _ in results if success]
            cells.append(f"{len(good)}/{len(results)}")
            mean += weight * sum(good) / max(len(good), 1)
            failed = [
                (seed, error) for seed, (ok, _, error) in zip(seeds, results, strict=True) if not ok
            ]
            problems += [f"{difficulty} {seed}: {error}" for seed, error in failed]
        ratio = mean / paper[name]
        print(
            f"| {name} | {' | '.join(cells)} | {mean:.0f} | {paper[name]:.0f} | {ratio:.2f} |"
            f" {seconds / runs:.1f} |"
        )
        for problem in problems:
            print(f"<!-- {problem} -->", flush=True)


if __name__ == "__main__":
    main()
