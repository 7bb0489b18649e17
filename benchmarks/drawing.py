r"""What images on demand save: evaluation episodes and demonstrations, rendered where read, against
rendered in full.

    python benchmarks/drawing.py [MODEL ...] [--task VideoUnmask] [--steps 128] [--no-record] \
        [--no-episodes]

Both ways do the same episode in one process, one after the other; the command checks that actions
and outcomes are equal to the last bit. The policy is tiny and untrained; its part is counted, and
given apart. CPU seconds are those of this process and all its threads, so that other work on the
machine does not count.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from timing import machine

from mme_vla.cli.record import record_episode
from mme_vla.envs.robomme.recording.frames import FrameChoice
from mme_vla.envs.robomme.recording.outputs import Job as Demonstration
from mme_vla.envs.vector.pool import Job, Reply
from mme_vla.evaluation.records import EpisodeRecord, RunKey
from mme_vla.evaluation.rollout.environment import ChunkEnv, EpisodeFactory
from mme_vla.evaluation.rollout.runner import Rollout
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.mme import MMEPolicy
from mme_vla.subgoal.oracle import Oracle
from mme_vla.testing.small import small_policy

MODELS = ("pi05", "tokendrop_modul", "ttt_modul", "rmt_modul", "framesamp_modul", "groundsg")
CHOICES: dict[str, FrameChoice] = {
    "decisions": FrameChoice("decisions"),
    "decisions, and what ttt reads": FrameChoice("decisions", {"name": "ttt"}),
    "a list of ten": FrameChoice(["0-9"]),
}


class InProcess:
    """One environment without a process of its own, so that one clock counts everything."""

    workers = 1

    def __init__(self, **options: Any) -> None:
        self._options, self._replies = options, []  # type: ignore[var-annotated]
        self._env: ChunkEnv | None = None
        self.images = {"front": 0, "wrist": 0}
        self.cpu_s = 0.0

    @property
    def busy(self) -> bool:
        return bool(self._replies)

    def start(self, worker: int, job: Job, **how: Any) -> None:
        begun = time.process_time()
        self.close()
        self._job = job
        self._env = EpisodeFactory(**self._options)(job.task, job.split, job.episode)
        sensors = self._env._env.task.scene.sensors
        for camera, sensor in (
            ("front", sensors["base_camera"]),
            ("wrist", sensors["hand_camera"]),
        ):
            sensor.capture = self._counted(camera, sensor.capture)
        self._replies.append(Reply.of_outcome(worker, job, True, self._env.reset(**how)))
        self.cpu_s += time.process_time() - begun

    def send(self, worker: int, action: Any) -> None:
        assert self._env is not None
        begun = time.process_time()
        self._replies.append(Reply.of_outcome(worker, self._job, False, self._env.step(action)))
        self.cpu_s += time.process_time() - begun

    def recv(self, timeout: float | None = None) -> list[Reply]:
        replies, self._replies = self._replies, []
        return replies

    def close(self) -> None:
        if self._env is not None:
            self._env.close()

    def _counted(self, camera: str, capture: Callable[[], None]) -> Callable[[], None]:
        def counted() -> None:
            self.images[camera] += 1
            capture()

        return counted


@dataclass
class Measured:
    """One episode: what it cost, and what came of it."""

    cpu_s: float
    env_s: float
    """CPU seconds of the environment alone: building it, simulation and rendering."""
    wall_s: float
    images: dict[str, int]
    record: EpisodeRecord


def episode(policy: MMEPolicy, name: str, job: Job, steps: int, draw: str) -> Measured:
    """Run an episode of so many steps."""
    settings = RolloutSettings(max_steps=steps, max_batch=1, draw=draw)
    envs, records = InProcess(max_steps=steps), []  # type: ignore[var-annotated]
    subgoals = (
        Oracle("grounded") if policy.require_processor().prompt_format.reads_subgoal else None
    )
    facts = RunKey(name, "untrained", settings.seed)
    begun = time.process_time(), time.perf_counter()
    Rollout(policy, envs, facts, settings, records.append, subgoals).run([job])
    cpu, wall = time.process_time() - begun[0], time.perf_counter() - begun[1]
    envs.close()
    return Measured(cpu, envs.cpu_s, wall, envs.images, records[0])


def episodes(models: list[str], task: str, steps: int) -> None:
    """Print a row for every model."""
    columns = (
        "model",
        "images (front + wrist): all",
        "needed",
        "environment, CPU: all",
        "needed",
        "gain",
        "with the policy, CPU: all",
        "needed",
        "gain",
        "wall, gain",
    )
    print("| " + " | ".join(columns) + " |\n|---|" + "---:|" * (len(columns) - 1), flush=True)
    job = Job(task, "test", 0)
    for name in models:
        policy = small_policy(name)
        full, needed = (episode(policy, name, job, steps, draw) for draw in ("all", "needed"))
        assert needed.record.steps == full.record.steps > steps, (
            "the episode ended before its limit"
        )
        assert full.record.outcome == needed.record.outcome
        assert full.record.actions_sha256 == needed.record.actions_sha256, "other actions"
        cells = [name, *(f"{m.images['front']} + {m.images['wrist']}" for m in (full, needed))]
        for a, b in ((full.env_s, needed.env_s), (full.cpu_s, needed.cpu_s)):
            cells += [f"{a:.1f} s", f"{b:.1f} s", f"{a / b:.1f}x"]
        print("| " + " | ".join([*cells, f"{full.wall_s / needed.wall_s:.1f}x"]) + " |", flush=True)


def demonstrations(task: str) -> None:
    """Print a row for every choice of frames."""
    print("\n| demonstration | CPU | gain | wall | gain |\n|---|---:|---:|---:|---:|", flush=True)
    full: list[float] = []
    for name, choice in {"every frame": None, **CHOICES}.items():
        with tempfile.TemporaryDirectory() as folder:
            begun = time.process_time(), time.perf_counter()
            record_episode(Demonstration(task, 7, 3000, "easy", None, 5, choice), Path(folder))
            spent = [time.process_time() - begun[0], time.perf_counter() - begun[1]]
        full = full or spent
        cells = " | ".join(
            f"{now:.1f} s | {before / now:.1f}x" for before, now in zip(full, spent, strict=True)
        )
        print(f"| {name} | {cells} |", flush=True)


def main() -> None:
    """Measure and print Markdown tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="*", default=list(MODELS))
    parser.add_argument("--task", default="VideoUnmask", help="of the evaluation episodes")
    parser.add_argument("--demonstrated", default="PickXtimes", help="task of the demonstrations")
    parser.add_argument("--steps", type=int, default=128, help="step limit of an episode")
    parser.add_argument("--no-episodes", action="store_true")
    parser.add_argument("--no-record", action="store_true")
    args = parser.parse_args()
    print(f"{args.task} · {args.steps + 1} steps · {machine()}\n")
    # shaders and imports: once a process
    episode(small_policy("pi05"), "pi05", Job(args.task, "test", 1), 2, "needed")
    if not args.no_episodes:
        episodes(args.models, args.task, args.steps)
    if not args.no_record:
        demonstrations(args.demonstrated)


if __name__ == "__main__":
    main()
