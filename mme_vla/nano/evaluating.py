"""Closed-loop evaluation of a nano policy on the benchmark's episodes, through planned motions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.evaluation import VIDEOS, evaluate, memory_budget
from mme_vla.evaluation.rollout.plan import choose_episodes, choose_shard
from mme_vla.evaluation.rollout.runner import RunFacts
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.digest import composition_digest
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.subgoal_text import subgoal_kind
from mme_vla.subgoal import build_predictor

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

    A policy that reads subgoals is told the simulator's own.

    Args:
        split, episodes, shard: as `evaluate` has them.
    """
    policy = MMEPolicy.from_pretrained(str(checkpoint)).eval()
    kind = subgoal_kind(policy)
    subgoals = None if kind is None else build_predictor({"name": ORACLE, "kind": kind.removesuffix("_subgoal")})
    jobs = choose_episodes(task, episodes, split)
    records: list[EpisodeRecord] = []
    for seed in seeds:
        settings = RolloutSettings(seed=seed, split=split, max_steps=max_steps, workers=workers, video=video)
        facts = RunFacts(
            str(policy.config["name"]), checkpoint.name, seed, split, max_steps, None if subgoals is None else ORACLE,
            memory_budget=memory_budget(policy), composition=composition_digest(policy.config),
        )  # fmt: skip
        done = evaluate(
            policy, jobs, folder / f"seed{seed}", facts, settings, subgoals=subgoals, shard=choose_shard(shard),
            source=str(checkpoint),
        )  # fmt: skip
        records += done.records
    return records


def film(checkpoint: Path, folder: Path, records: Sequence[EpisodeRecord]) -> list[Path]:
    """Films of the first success and the first failure of these records, run once more with every frame drawn.

    Args:
        folder: of the films; what it has is not drawn again.
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
