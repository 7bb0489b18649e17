"""How far each dial of `split=stress` goes: does the demonstrator, who knows everything, still solve the test scenes?

`python benchmarks/stress_dials.py --episodes 4 --output benchmarks/stress_dials.csv` (goes on where it was stopped)
"""

import argparse
import csv
from pathlib import Path

from mme_vla.envs import metadata
from mme_vla.envs.make import make_task
from mme_vla.envs.recording.recorder import Recorder
from mme_vla.envs.scene.placement import SceneError
from mme_vla.envs.variants import DIALS

VALUES = {
    "count": (0, 2, 5, 10), "containers": (0, 2, 5, 10), "swaps": (0, 2, 5, 10), "delay": (0, 100, 400),
    "path": (0, 1, 2, 4), "distractors": (0, 2, 4, 8),
}  # fmt: skip
COLUMNS = ("dial", "task", "value", "episode", "difficulty", "outcome", "steps", "video")


def demonstrate(task: str, episode: int, dial: str, value: int) -> tuple[str, str, int, int]:
    """Difficulty, how a demonstration without pictures ended, its steps, and those of its video."""
    spec = metadata.episode(task, "test", episode)
    try:
        env = make_task(task, render=False, seed=spec.seed, difficulty=spec.difficulty, stress={dial: value})
    except SceneError:
        return spec.difficulty, "no scene", 0, 0
    try:
        done = Recorder(env, render=False).record()
    finally:
        env.close()
    return spec.difficulty, "success" if done.success else "failure", done.stored, done.video


def main() -> None:
    """Demonstrate what the table does not hold yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--dials", nargs="+", default=list(DIALS))
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args()
    there = args.output.is_file()
    done = set()
    if there:
        with args.output.open() as file:
            done = {(r["dial"], r["task"], int(r["value"]), int(r["episode"])) for r in csv.DictReader(file)}
    with args.output.open("a", newline="") as file:
        writer = csv.writer(file)
        if not there:
            writer.writerow(COLUMNS)
        for dial in args.dials:
            for episode in range(args.episodes):
                for value in VALUES[dial]:
                    for task in DIALS[dial]:
                        if (dial, task, value, episode) not in done:
                            difficulty, outcome, steps, video = demonstrate(task, episode, dial, value)
                            writer.writerow([dial, task, value, episode, difficulty, outcome, steps, video])
                            file.flush()


if __name__ == "__main__":
    main()
