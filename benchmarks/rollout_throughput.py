r"""Episodes a minute: one environment and no batches, against several workers without and with a
batching policy.

    python benchmarks/rollout_throughput.py [--model framesamp_modul] [--workers 2] [--steps 64] \
        [--no-render]

All do the same episodes with the same noise, one contestant after the other in one run, on workers
that are warm: the first episode of every worker, which imports the simulator, is not timed. The
policy is tiny and untrained; its episodes run until the step limit, so that the work is the same
whatever it does.
"""

import argparse
import time
from dataclasses import dataclass

from timing import machine

from mme_vla.envs.vector.pool import Job, VecEnv
from mme_vla.evaluation.records import EpisodeRecord, RunKey
from mme_vla.evaluation.rollout.environment import EpisodeFactory
from mme_vla.evaluation.rollout.runner import Rollout
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import small_policy

TASKS = (
    "PickXtimes",
    "StopCube",
    "BinFill",
    "SwingXtimes",
)  # none with a video: all steps are the policy's


@dataclass
class Measured:
    """One contestant: its records, its wall time and the mean size of its batches."""

    name: str
    records: list[EpisodeRecord]
    wall_s: float
    mean_batch: float

    def row(self) -> list[str]:
        sim, render, policy = (
            sum(getattr(r.seconds, part) for r in self.records)
            for part in ("sim", "render", "policy")
        )
        steps = sum(record.steps for record in self.records)
        return [
            self.name,
            f"{60 * len(self.records) / self.wall_s:.2f}",
            f"{steps / self.wall_s:.1f}",
            f"{sim:.1f} s",
            f"{render:.1f} s",
            f"{policy:.1f} s",
            f"{100 * policy / (sim + render):.0f} %",
            f"{1000 * policy / sum(r.chunks or 0 for r in self.records):.0f} ms",
            f"{self.mean_batch:.1f}",
            f"{self.wall_s:.1f} s",
        ]


def measure(
    policy: MMEPolicy,
    name: str,
    jobs: list[Job],
    workers: int,
    max_batch: int,
    args: argparse.Namespace,
) -> Measured:
    """Run these episodes on warm workers."""
    settings = RolloutSettings(
        max_steps=args.steps, workers=workers, max_batch=max_batch, render=not args.no_render
    )
    make = EpisodeFactory(policy.embodiment, render=not args.no_render)
    facts = RunKey(args.model, "untrained", settings.seed)
    records: list[EpisodeRecord] = []
    with VecEnv([], workers, make) as envs:
        short = [Job("StopCube", "test", 40 + worker) for worker in range(workers)]
        Rollout(policy, envs, facts, settings, lambda record: None).run(short)
        rollout = Rollout(policy, envs, facts, settings, records.append)
        begun = time.perf_counter()
        rollout.run(jobs)
        wall = time.perf_counter() - begun
    return Measured(name, records, wall, rollout.workload.mean_batch)


def main() -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default="framesamp_modul")
    parser.add_argument("--workers", type=int, default=2, help="of the batched contestant")
    parser.add_argument("--steps", type=int, default=64, help="step limit of an episode")
    parser.add_argument("--episodes", type=int, default=1, help="of each of the four tasks")
    parser.add_argument(
        "--no-render", action="store_true", help="black images: the simulation alone"
    )
    args = parser.parse_args()
    policy = small_policy(args.model)
    jobs = [Job(task, "test", episode) for episode in range(args.episodes) for task in TASKS]
    print(
        f"{args.model}, tiny · {len(jobs)} episodes of at most {args.steps + 1} steps ·"
        f" {machine()}\n"
    )
    columns = [
        "",
        "episodes/min",
        "steps/s",
        "simulation",
        "rendering",
        "policy",
        "policy over both",
    ]
    columns += ["policy a chunk", "batch", "wall"]
    print("| " + " | ".join(columns) + " |\n|---|" + "---:|" * (len(columns) - 1))
    results = [
        measure(policy, "1 environment, unbatched", jobs, 1, 1, args),
        measure(policy, f"{args.workers} workers, unbatched", jobs, args.workers, 1, args),
        measure(policy, f"{args.workers} workers, batched", jobs, args.workers, 16, args),
    ]
    for result in results:
        print("| " + " | ".join(result.row()) + " |")
    same = [{(r.key, r.outcome, r.steps) for r in result.records} for result in results]
    gains = " and ".join(f"{results[0].wall_s / result.wall_s:.2f}x" for result in results[1:])
    print(f"\nsame outcomes and steps: {same[0] == same[1] == same[2]}; gain of the others {gains}")


if __name__ == "__main__":
    main()
