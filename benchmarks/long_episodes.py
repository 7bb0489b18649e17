r"""What a decision costs as an episode grows: after so many frames, with one replan every 16.

    OMP_NUM_THREADS=1 python benchmarks/long_episodes.py [--models ttt_modul rmt_modul] \
        [--frames 80 560 1300]

Tiny and untrained. Median of the last decisions before each length: taking the new frames
(`observe`), the decision itself (`act`), and what is prepared for the next one while the robot
moves (`prepare`); `--no-prepare` leaves that out, so that a decision does it all. CPU time, since
other work disturbs it less.
"""

import argparse
import statistics
import time
from collections.abc import Sequence

import numpy as np
from timing import machine

from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import moving_frames, small_policy

STRIDE = 16
LAST = 7  # decisions that a median is of


def decisions(policy: MMEPolicy, frames: int, prepare: bool) -> list[tuple[float, float, float]]:
    """CPU seconds of taking, deciding and preparing, one row a decision."""
    images = moving_frames(STRIDE)
    states = np.zeros((STRIDE, 8), np.float32)
    episode, rows = policy.start_episode("press the button"), []
    for start in range(0, frames, STRIDE):
        clock = [time.process_time()]
        shifted = np.roll(images, start // STRIDE, axis=1)  # frames differ over the episode
        episode.observe({"front": shifted, "wrist": shifted}, states)
        clock.append(time.process_time())
        policy.act(episode)
        clock.append(time.process_time())
        while prepare and policy.prepare(episode):
            pass
        clock.append(time.process_time())
        rows.append((clock[1] - clock[0], clock[2] - clock[1], clock[3] - clock[2]))
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--models", nargs="+", default=["tokendrop_modul", "ttt_modul", "rmt_modul"]
    )
    parser.add_argument("--frames", nargs="+", type=int, default=[80, 560, 1064, 1300])
    parser.add_argument(
        "--no-prepare", action="store_true", help="leave everything to the decision itself"
    )
    args = parser.parse_args(arguments)
    print(f"{machine()}; ms of CPU time: frames taken / decision / prepared for the next\n")
    print(
        "| model | "
        + " | ".join(f"{n:,} frames" for n in args.frames)
        + " |\n|---|"
        + "---:|" * len(args.frames)
    )
    for model in args.models:
        rows = decisions(small_policy(model), max(args.frames), not args.no_prepare)
        cells = []
        for frames in args.frames:
            last = rows[max(frames // STRIDE - LAST, 0) : frames // STRIDE]
            took = (1e3 * statistics.median(part) for part in zip(*last, strict=True))
            cells.append(" / ".join(f"{ms:.0f}" for ms in took))
        print(f"| `{model}` | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
