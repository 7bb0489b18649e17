"""Closed-loop evaluation of a nano policy on the benchmark's episodes, through planned motions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.evaluation import evaluate, memory_budget
from mme_vla.evaluation.rollout.plan import choose_episodes
from mme_vla.evaluation.rollout.runner import RunFacts
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.digest import composition_digest
from mme_vla.policy.mme import MMEPolicy

MAX_STEPS = 500


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
) -> list[EpisodeRecord]:
    """Run what `folder` has no record of yet, once for each seed of the policy's noise; all records.

    Args:
        split, episodes: as `evaluate` has them.
    """
    policy = MMEPolicy.from_pretrained(str(checkpoint)).eval()
    jobs = choose_episodes(task, episodes, split)
    records: list[EpisodeRecord] = []
    for seed in seeds:
        settings = RolloutSettings(seed=seed, split=split, max_steps=max_steps, workers=workers, video=video)
        facts = RunFacts(
            str(policy.config["name"]), checkpoint.name, seed, split, max_steps,
            memory_budget=memory_budget(policy), composition=composition_digest(policy.config),
        )  # fmt: skip
        done = evaluate(policy, jobs, folder / f"seed{seed}", facts, settings, source=str(checkpoint))
        records += done.records
    return records
