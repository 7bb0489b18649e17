"""A probe in closed loop: every arm on the same episodes with the same noise as the unprobed run."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mme_vla.envs.make import make_env
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.recordings import Recording
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.compare import Comparison, common_episodes, compare_all
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.rollout.evaluation import Shard, evaluate
from mme_vla.evaluation.rollout.runner import RunFacts
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.policy.base import Policy
from mme_vla.probing.arms import UNPROBED, Arm, slug
from mme_vla.probing.probed import DonorEpisodes, ProbedPolicy
from mme_vla.subgoal import SubgoalPredictor

FOLDER = "online"


def probe_online(
    policy: Policy,
    arms: Sequence[Arm],
    jobs: Sequence[Job],
    folder: Path,
    facts: RunFacts,
    settings: RolloutSettings,
    *,
    lend: Sequence[Recording] = (),
    subgoals: SubgoalPredictor | None = None,
    shard: Shard | None = None,
    source: str | None = None,
    base: Callable[..., Any] = make_env,
    show_progress: bool = True,
) -> list[EpisodeRecord]:
    """Run what `folder` has no record of yet, first without and then under each arm; all records.

    Args:
        lend: recorded episodes: the sessions shown before, and where contents are taken from.
    """
    records: list[EpisodeRecord] = []
    for arm in [UNPROBED, *arms]:
        donors = DonorEpisodes(policy, ProbedPolicy(policy).channel, lend) if lend else None
        probed = policy if arm is UNPROBED else ProbedPolicy(policy, arm, lend, donors).eval()
        done = evaluate(
            probed, jobs, folder / FOLDER / slug(arm.name), replace(facts, model=named(facts.model, arm)), settings,
            subgoals=subgoals, shard=shard, source=source, base=base, notes={"arm": arm.name},
            show_progress=show_progress,
        )  # fmt: skip
        records += done.records
    return records


def named(model: str, arm: Arm) -> str:
    """What records call a model under an arm; unprobed it keeps its name."""
    return model if arm is UNPROBED else f"{model} · {arm.name}"


def online_records(folder: Path) -> list[EpisodeRecord]:
    """What a folder holds of the closed loop, nothing where that was not run."""
    return read_folders(find_records([folder / FOLDER])) if (folder / FOLDER).is_dir() else []


def paired(records: Sequence[EpisodeRecord], split: str, model: str) -> list[Comparison]:
    """Each arm against the unprobed run, over the episodes that both have, corrected for their number.

    Args:
        model: the unprobed one's name.
    """
    tasks = tuple(dict.fromkeys(record.task for record in records))
    if not tasks:
        return []
    protocol = Protocol(tasks, episodes=1 + max(record.episode for record in records))
    methods = aggregate(records, protocol, split).methods
    baseline = next((method for method in methods if method.model == model), None)
    if baseline is None:
        return []
    return compare_all([(m, baseline) for m in methods if m is not baseline and common_episodes(m, baseline)], protocol)
