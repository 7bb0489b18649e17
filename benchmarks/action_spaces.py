"""Own demonstrations replayed in every action space, from fresh environments: how many end in
success.

    python benchmarks/action_spaces.py [TASK ...] [--episodes 4] [--split test] [--workers 2]

Unrendered. Each episode is demonstrated once; then its joint angles, tool poses, distinct waypoints
and choices are played to `make_env`, as recorded data are.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from mme_vla.envs import make_env
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import TASK_NAMES, episode
from mme_vla.envs.robomme.recording.recorder import RecordedStep, Recorder

SPACES = {
    "joint_angle": "joint_action",
    "ee_pose": "eef_action",
    "waypoint": "waypoint_action",
    "multi_choice": "",
}


def actions(steps: list[RecordedStep], space: str) -> list[Any]:
    """What to do from the first execution step on."""
    steps = [step for step in steps if not step.info["is_video_demo"]]
    if space == "multi_choice":
        choices = [
            json.loads(step.action["choice_action"])
            for step in steps
            if step.info["is_subgoal_boundary"]
        ]
        return [choice for choice in choices if choice["choice"]]
    every = [step.action[SPACES[space]] for step in steps]
    if space != "waypoint":
        return every
    named = [action for action in every if not np.isnan(action).any()]
    return [a for i, a in enumerate(named) if i == 0 or not np.array_equal(a, named[i - 1])]


def replay(task: str, index: int, split: str) -> dict[str, str]:
    """How an episode ends in each space; nothing if it cannot be demonstrated."""
    spec = episode(task, split, index)
    scene = {"seed": spec.seed, "difficulty": spec.difficulty, "recovery": spec.recovery}
    env = make_task(task, render=False, **scene)
    recorded = Recorder(env, render=False).record()
    env.close()
    if not recorded.success:
        return {}
    ends: dict[str, str] = {}
    for space in SPACES:
        env = make_env(task, action_space=space, render=False, max_steps=5000, **scene)
        env.reset()
        info: dict[str, Any] = {"status": "nothing to do"}
        for action in actions(recorded.frames, space):
            _, _, terminated, truncated, info = env.step(action)
            if bool(terminated) or bool(truncated):
                break
        env.close()
        ends[space] = f"{info['status']} {info.get('error_message') or ''}".strip()
    return ends


def main() -> None:
    """Replay and print a Markdown table, and what did not succeed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", default=list(TASK_NAMES))
    parser.add_argument("--episodes", type=int, default=4, help="the first so many of the split")
    parser.add_argument("--split", default="test")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    print(
        "| task | demonstrated | " + " | ".join(SPACES) + " |\n|---|" + "---:|" * (1 + len(SPACES))
    )
    others = []
    with ProcessPoolExecutor(args.workers) as pool:
        for task in args.tasks:
            count = range(args.episodes)
            ends = list(pool.map(replay, [task] * len(count), count, [args.split] * len(count)))
            completed = [end for end in ends if end]
            cells = [
                f"{sum(end[space] == 'success' for end in completed)}/{len(completed)}"
                for space in SPACES
            ]
            print(
                f"| {task} | {len(completed)}/{len(count)} | " + " | ".join(cells) + " |",
                flush=True,
            )
            others += [
                (task, i, s, e)
                for i, end in enumerate(ends)
                for s, e in end.items()
                if e != "success"
            ]
    for task, index, space, end in others:
        print(f"{task} {index}, {space}: {end}")


if __name__ == "__main__":
    main()
