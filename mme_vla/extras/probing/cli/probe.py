"""`mme-vla probe checkpoint=…`: what a policy takes from its memory
(configs/probe.yaml).
"""

import logging
import sys
from pathlib import Path

from omegaconf import DictConfig

from mme_vla.cli.command import log_to_terminal, run_configured
from mme_vla.config.devices import process_device
from mme_vla.config.sections import read_section

logger = logging.getLogger("mme_vla.probe")


def main() -> None:
    """Run the command; a first word `card` or `twins` means `card=true` or `twins=true`."""
    if sys.argv[1:2] in (["card"], ["twins"]):
        word = sys.argv.pop(1)
        # Beside --help words name files to show.
        if not {"--help", "-h"} & {*sys.argv}:
            sys.argv.insert(1, f"{word}=true")
    run_configured("probe", probe, check="mme_vla.extras.probing.settings:check_probe")


def probe(cfg: DictConfig) -> None:
    """Probe what has no result yet, and write the page."""
    from mme_vla.cli.evaluate import choose_subgoals, report_usage
    from mme_vla.cli.loading import PolicyChoice, load_policy, release
    from mme_vla.data.recording import action_offset_of
    from mme_vla.data.sources import open_sources
    from mme_vla.envs.base import environment
    from mme_vla.envs.episodes import choose_numbers, named_tasks
    from mme_vla.evaluation.claims import choose_shard
    from mme_vla.evaluation.rollout.evaluation import RunOptions, choose_jobs, facts_of
    from mme_vla.evaluation.rollout.events import event_arms
    from mme_vla.evaluation.rollout.settings import RolloutSettings
    from mme_vla.extras.probing.card import PAGE, card_text, run_card
    from mme_vla.extras.probing.recordings import all_recordings
    from mme_vla.extras.probing.report import table_of
    from mme_vla.extras.probing.run import (
        ProbePlan,
        probed_folder,
        run_probe,
    )
    from mme_vla.extras.probing.settings import OfflineSettings, ProbeChoice
    from mme_vla.extras.probing.twins import FIGURES, run_twins, twins_text
    from mme_vla.policy.build import policy_config
    from mme_vla.utils import safe_name

    values = policy_config(cfg)
    choice = ProbeChoice.from_config(values)
    if choice.compare is not None:
        folders = [choice.compare] if isinstance(choice.compare, str) else choice.compare
        print(table_of({folder: probed_folder(Path(folder)) for folder in folders}))
        return
    events = event_arms(choice.event)
    settings = RolloutSettings.from_config({**values, "event": None})
    offline = read_section(OfflineSettings, values, others=True)
    jobs = []
    if choice.in_closed_loop or choice.twins:
        jobs = choose_jobs(named_tasks(values), values["episodes"], settings.split, settings.env)
    shard = choose_shard(values["shard"])
    if jobs:
        environment(settings.env).check_installed()
    log_to_terminal(logger)
    device = process_device(str(cfg.device))
    policy, name, source = load_policy(PolicyChoice.from_config(values), "probe", logger, device)
    recordings = []
    if choice.recordings is not None:
        sources = open_sources(choice.recordings, policy.embodiment)
        recordings = all_recordings(sources, action_offset_of(policy))
    probed = []
    if choice.on_recordings:
        numbers = choose_numbers(values["recorded"], len(recordings), "the data", "recorded")
        probed = [recordings[i] for i in numbers]
    subgoals = None
    if jobs and not choice.twins:
        subgoals = choose_subgoals(policy, values["subgoal"], str(values["subgoal_mode"]), device)
    predictor = None if subgoals is None else str(values["subgoal"]["name"])
    facts = facts_of(policy, name, source, settings, predictor)
    # A shipped policy has a folder of its name; one that an earlier version began continues.
    kind = "probe"
    if choice.card:
        kind = "card"
    if choice.twins:
        kind = "twins"
    model = safe_name(name, "the policy's name")
    folder = Path("outputs", kind, model, str(facts.checkpoint))
    if facts.is_shipped and not folder.exists():
        folder = Path("outputs", kind, str(facts.checkpoint))
    folder = folder if cfg.output is None else Path(str(cfg.output)).expanduser()
    logger.info("%d recorded episodes, %d in closed loop, into %s", len(probed), len(jobs), folder)
    plan = ProbePlan(choice.arms, probed, recordings, jobs, offline, events)
    options = RunOptions(subgoals, shard, source)
    try:
        if choice.twins:
            twins = run_twins(policy.eval(), jobs, folder, facts, settings, options)
            text = twins_text(twins)
            page = folder / FIGURES
        elif choice.card:
            card = run_card(
                policy.eval(), plan, folder, facts, settings, options, choice.references
            )
            text = card_text(card)
            page = folder / PAGE
        else:
            page = run_probe(policy.eval(), plan, folder, facts, settings, options).page
            text = (folder / "table.md").read_text(encoding="utf-8")
    finally:
        release(policy)
        if subgoals is not None:
            report_usage(subgoals.usage)
            subgoals.close()
    print(text)
    print(page)
