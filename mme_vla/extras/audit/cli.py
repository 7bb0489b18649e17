"""`mme-vla audit server=…` or `checkpoint=…`: the report card from outside
(extras/audit/configs/audit.yaml).
"""

import logging
from pathlib import Path

from omegaconf import DictConfig

from mme_vla.cli.command import log_to_terminal
from mme_vla.cli.loading import PolicyChoice, load_policy, release
from mme_vla.config.devices import process_device
from mme_vla.config.sections import read_section
from mme_vla.data.recording import action_offset_of
from mme_vla.data.sources import open_sources
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import named_tasks
from mme_vla.evaluation.rollout.evaluation import RunOptions, choose_jobs, facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.audit.audit import N_RUNS, AuditSettings, run_audit, scenes_a_task
from mme_vla.extras.probing.card import card_text
from mme_vla.extras.probing.recordings import all_recordings
from mme_vla.policy.build import policy_config
from mme_vla.utils import safe_name

logger = logging.getLogger("mme_vla.audit")


def main(cfg: DictConfig) -> None:
    """Run what is missing of an audit, and print its conclusion."""
    values = policy_config(cfg)
    choice = PolicyChoice.from_config(values)
    settings = RolloutSettings.from_config(values)
    audit = read_section(AuditSettings, values, others=True)
    source = environment(settings.env)
    tasks = named_tasks(values)
    episodes = values["episodes"]
    if episodes is None:
        n_tasks = len({job.task for job in choose_jobs(tasks, 1, settings.split, settings.env)})
        episodes = scenes_a_task(audit, n_tasks)
    jobs = choose_jobs(tasks, episodes, settings.split, settings.env)
    source.check_installed()
    log_to_terminal(logger)
    device = process_device(choice.device)
    policy, name, place = load_policy(choice, "audit", logger, device)
    facts = facts_of(policy, name, place, settings, None)
    folder = Path("outputs", "audit", safe_name(name, "the policy's name"), str(facts.checkpoint))
    if values["output"] is not None:
        folder = Path(str(values["output"])).expanduser()
    recordings = []
    if values["recordings"] is not None:
        sources = open_sources(values["recordings"], policy.embodiment)
        recordings = all_recordings(sources, action_offset_of(policy))
    logger.info("%d scenes, %d runs of each at most, into %s", len(jobs), N_RUNS, folder)
    options = RunOptions(source=place)
    try:
        result = run_audit(
            policy.eval(),
            jobs,
            folder,
            facts,
            settings,
            options,
            audit,
            recordings,
            values["references"],
        )
    finally:
        release(policy)
    verdict, *reasons = result.conclusion.sentences
    print(card_text(result.card, verdict))
    print("\n".join(reasons))
    print(result.page)
