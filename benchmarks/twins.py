"""Does the demonstrator solve every twin of `split=twin` as it solves the test scene, to the last
joint angle?

`python benchmarks/twins.py --episodes 3`
"""

import argparse

import numpy as np

from mme_vla.envs import metadata
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.envs.robomme.recording.recorder import Recorder


def demonstrate(task: str, episode: int, in_view: bool) -> tuple[bool, np.ndarray]:
    """Whether a demonstration without images succeeds, and its joint states [t, 7]."""
    spec = metadata.episode(task, "test", episode)
    env = make_task(task, render=False, seed=spec.seed, difficulty=spec.difficulty, in_view=in_view)
    try:
        done = Recorder(env, render=False).record()
    finally:
        env.close()
    return done.success, np.array([step.obs["joint_state"] for step in done.frames])


def main() -> None:
    """Compare the first episodes of every task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--tasks", nargs="+", default=list(TASK_NAMES))
    args = parser.parse_args()
    print("| task | scene | twin | the same joint states |\n|---|---|---|---|")
    for task in args.tasks:
        pairs = [
            [demonstrate(task, episode, twin) for twin in (False, True)]
            for episode in range(args.episodes)
        ]
        scene, twin = (f"{sum(pair[i][0] for pair in pairs)}/{args.episodes}" for i in (0, 1))
        same = sum(np.array_equal(one[1], other[1]) for one, other in pairs)
        print(f"| {task} | {scene} | {twin} | {same}/{args.episodes} |", flush=True)


if __name__ == "__main__":
    main()
