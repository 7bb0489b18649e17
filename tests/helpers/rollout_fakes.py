"""Rollouts of the scripted environment, in this process and in workers.

Run as a script it is an evaluation to be killed:
`python rollout_fakes.py <folder> <checkpoint> <seconds a step>`.
"""

import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

from helpers.scripted_env import ScriptedEnv, make_scripted_env, make_slow_env
from mme_vla.envs.vector.pool import Job, Reply
from mme_vla.evaluation.records import EpisodeRecord, RecordLog, RunKey
from mme_vla.evaluation.rollout import evaluation
from mme_vla.evaluation.rollout.environment import ChunkEnv, EpisodeFactory
from mme_vla.evaluation.rollout.evaluation import Evaluation, EvaluationRun, RunOptions
from mme_vla.evaluation.rollout.runner import Rollout
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import RECORDS
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import SMALL_VISION, small_policy

FACTS = RunKey("tiny", "untrained", 42)
JOBS = [
    Job(task, "test", episode) for task in ("PickXtimes", "VideoUnmask") for episode in range(3)
]


def quick_policy(name: str, patch_size: int = 16, **overrides: Any) -> MMEPolicy:
    """A policy with few patches, for speed; 8 is the largest patch that every memory can be built
    on.
    """
    return small_policy(
        name, backbone={"vision": {**SMALL_VISION, "patch_size": patch_size}}, **overrides
    )


class InlineEnvs:
    """A `VecEnv` without processes; keeps every environment it made."""

    def __init__(self, workers: int = 1, **options: Any) -> None:
        self.workers = workers
        self.factory = EpisodeFactory(**{"base": make_scripted_env, "max_steps": 40, **options})
        self._replies: list[Reply] = []
        self._running: dict[int, tuple[Job, ChunkEnv]] = {}
        self.made: dict[Job, ScriptedEnv] = {}

    def __enter__(self) -> "InlineEnvs":
        return self

    def __exit__(self, *_: object) -> None:
        """No process to end."""

    @property
    def busy(self) -> bool:
        return bool(self._replies)

    def start(self, worker: int, job: Job, **how: Any) -> None:
        env = self.factory(job.task, job.split, job.episode)
        self.made[job] = env._env
        self._running[worker] = (job, env)
        self._replies.append(Reply.of_outcome(worker, job, True, env.reset(**how)))

    def send(self, worker: int, action: Any) -> None:
        job, env = self._running[worker]
        self._replies.append(Reply.of_outcome(worker, job, False, env.step(action)))

    def recv(self, timeout: float | None = None) -> list[Reply]:
        replies, self._replies = self._replies, []
        return replies


def use_inline_envs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let an `EvaluationRun` step its environments in this process."""

    def inline(jobs: Any, workers: int, factory: Any, timeout: Any) -> InlineEnvs:
        envs = InlineEnvs(workers)
        envs.factory = factory
        return envs

    monkeypatch.setattr(evaluation, "VecEnv", inline)


def roll(
    policy: MMEPolicy,
    jobs: list[Job],
    envs: InlineEnvs,
    subgoals: Any = None,
    subgoal_folder: Path | None = None,
    **settings: Any,
) -> list[EpisodeRecord]:
    """Records of a rollout in this process."""
    records: list[EpisodeRecord] = []
    options = RolloutSettings(**{"flow_steps": 2, **settings})
    Rollout(policy, envs, FACTS, options, records.append, subgoals, subgoal_folder).run(jobs)
    return records


def run_evaluation(
    policy: MMEPolicy,
    folder: Path,
    base: Any = make_slow_env,
    jobs: Sequence[Job] = JOBS,
    **settings: Any,
) -> Evaluation:
    """These episodes in two worker processes, or in this one after `use_inline_envs`."""
    options = RolloutSettings(
        **{"max_steps": 24, "flow_steps": 2, "workers": 2, "max_batch": 1, **settings}
    )
    return EvaluationRun(
        policy, jobs, folder, FACTS, options, RunOptions(base=base, show_progress=False)
    ).run()


def save_records(path: Path, records: Iterable[EpisodeRecord]) -> None:
    """Append to a file of records; of a folder, to `episodes.jsonl`."""
    with RecordLog(path if path.suffix else path / RECORDS) as log:
        for record in records:
            log.append(record)


def records(split: str, won: list[int], model: str = "m", seed: int = 7) -> list[EpisodeRecord]:
    return [
        EpisodeRecord(
            model, 1, seed, "PickXtimes", e, e, "easy", "success" if w else "fail", 9, split=split
        )
        for e, w in enumerate(won)
    ]


if __name__ == "__main__":
    os.environ["STEP_S"] = sys.argv[3]
    run_evaluation(MMEPolicy.from_pretrained(sys.argv[2]), Path(sys.argv[1]))
