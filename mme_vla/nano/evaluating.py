"""Closed-loop evaluation of a nano policy on the benchmark's episodes, through planned motions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mme_vla.data.waypoints import Motions
from mme_vla.envs.make import make_env, make_task
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.evaluation import VIDEOS, choose_episodes, choose_shard, evaluate, facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.subgoal import build_predictor

NAME = "planner"
ACTIONS = "waypoint"


@dataclass(frozen=True)
class Replay:
    """An episode to be solved by its demonstrator's motions, within so many control steps."""

    spec: EpisodeSpec
    max_steps: int


def replay(job: Replay) -> EpisodeRecord:
    """Demonstrate an episode without images, and repeat the motions in the environment of the policies."""
    spec = job.spec
    motions = _planned(spec)
    env = make_env(spec.task, spec.split, spec.episode, ACTIONS, max_steps=job.max_steps, render=False)
    status = "fail"
    try:
        env.reset()
        for target in () if motions is None else motions.targets:
            *_, info = env.step(target)
            status = str(info["status"])
            if status != "ongoing":
                break
        steps = env.steps_counted  # type: ignore[union-attr]  # never the official environment
    finally:
        env.close()
    return EpisodeRecord(
        NAME, "none", 0, spec.task, spec.episode, spec.seed, spec.difficulty,
        status if status in ("success", "fail", "timeout") else "fail", steps, split=spec.split,
        max_steps=job.max_steps, action_space=ACTIONS, extra={"status": status, "demonstrated": motions is not None},
    )  # fmt: skip


def _planned(spec: EpisodeSpec) -> Motions | None:
    from mme_vla.envs.recording.frames import motions_of
    from mme_vla.envs.recording.recorder import Recorder
    from mme_vla.envs.scene.placement import SceneError

    try:
        env = make_task(spec.task, render=False, **spec.options)
    except SceneError:
        return None
    try:
        result = Recorder(env, render=False).record()
        return motions_of(result.frames) if result.success else None
    finally:
        env.close()


MAX_STEPS = 500
ORACLE = "oracle"


def run_episodes(
    checkpoint: Path,
    folder: Path,
    task: str,
    *,
    split: str = "test",
    episodes: Any = None,
    seeds: Sequence[int] = (7,),
    workers: int | None = None,
    video: str = "none",
    max_steps: int = MAX_STEPS,
    shard: str | None = None,
) -> list[EpisodeRecord]:
    """Run what `folder` has no record of yet, once for each seed of the policy's noise; all records.

    A policy that reads subgoals gets the simulator's.

    split, episodes, shard: as `evaluate` has them.
    """
    policy = MMEPolicy.from_pretrained(str(checkpoint)).eval()
    kind = subgoal_kind(policy)
    subgoals = None if kind is None else build_predictor({"name": ORACLE, "kind": kind.removesuffix("_subgoal")})
    jobs = choose_episodes(task, episodes, split)
    records: list[EpisodeRecord] = []
    for seed in seeds:
        options = {"seed": seed, "split": split, "max_steps": max_steps, "workers": workers, "video": video}
        settings = RolloutSettings.from_config(options)
        facts = facts_of(policy, None, str(checkpoint), settings, None if subgoals is None else ORACLE)
        facts = replace(facts, checkpoint=checkpoint.name)
        done = evaluate(
            policy, jobs, folder / f"seed{seed}", facts, settings, subgoals=subgoals, shard=choose_shard(shard),
            source=str(checkpoint),
        )  # fmt: skip
        records += done.records
    return records


def record_videos(checkpoint: Path, folder: Path, records: Sequence[EpisodeRecord]) -> list[Path]:
    """Videos of the first success and the first failure of these records, run once more with every frame rendered.

    folder: of the videos; what it has is not rendered again.
    """
    for won in (True, False):
        record = next((record for record in records if record.success is won), None)
        if record is not None:
            place = folder / ("success" if won else "failure")
            run_episodes(
                checkpoint, place, record.task, split=record.split, episodes=[record.episode],
                seeds=[record.model_seed], workers=1, video="all", max_steps=record.max_steps,
            )  # fmt: skip
    return sorted(folder.glob(f"*/seed*/{VIDEOS}/*.mp4"))
