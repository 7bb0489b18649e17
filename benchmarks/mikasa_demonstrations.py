"""Success of the scripts that demonstrate MIKASA-Robo-VLA, without images.

python benchmarks/mikasa_demonstrations.py --tasks RememberColor3 TakeItBack --episodes 40
"""

import argparse
import time

from mme_vla.envs.base import environment


def main() -> None:
    """Print for each task the successes, the steps, and which scenes failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", required=True)
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--split", default="test")
    args = parser.parse_args()
    source = environment("mikasa")
    source.check_installed()
    for task in args.tasks:
        begun = time.perf_counter()
        lengths = []
        failed = []
        for number in range(args.episodes):
            env = source.open(task, args.split, number, render=False)
            lengths.append(sum(1 for _ in env.demonstration()))
            if not env.success:
                failed.append(number)
            env.close()
        print(
            f"{task}: {args.episodes - len(failed)} of {args.episodes}, {min(lengths)} to"
            f" {max(lengths)} steps, failed {failed}, {time.perf_counter() - begun:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
