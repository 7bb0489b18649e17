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
        sys.argv[1] += "=true"
    run_configured("probe", probe, check="mme_vla.extras.probing.settings:check_probe")


def probe(cfg: DictConfig) -> None:
    """Probe what has no result yet, and write the page."""
    from mme_vla.cli.evaluate import choose_subgoals, report_usage
    from mme_vla.cli.loading import PolicyChoice, load_policy, release
    from mme_vla.data.sources import open_sources
    from mme_vla.envs.base import environment
    from mme_vla.envs.episodes import choose_numbers, named_tasks
    from mme_vla.evaluation.rollout.evaluation import (
        RunOptions,
        choose_episodes,
        choose_shard,
        facts_of,
    )
    from mme_vla.evaluation.rollout.events import event_arms
    from mme_vla.evaluation.rollout.settings import RolloutSettings
    from mme_vla.extras.probing.card import PAGE, card_text, run_card
    from mme_vla.extras.probing.offline import OfflineSettings
    from mme_vla.extras.probing.recordings import all_recordings
    from mme_vla.extras.probing.report import table_of
    from mme_vla.extras.probing.run import (
        ProbePlan,
        probed_folder,
        run_probe,
    )
    from mme_vla.extras.probing.twins import FIGURES, run_twins, twins_text
    from mme_vla.policy.build import policy_config
    from mme_vla.utils import safe_name

    values = policy_config(cfg)
    if (folders := values["compare"]) is not None:
        listed = [folders] if isinstance(folders, str) else list(folders)
        print(table_of({folder: probed_folder(Path(folder)) for folder in listed}))
        return
    card = values["card"]
    twins = values["twins"]
    if twins:
        # It makes its own scenes.
        values["offline"] = False
    if values["server"] is not None:
        # A server chooses a chunk once: recordings are what contents are taken from.
        values["offline"] = False
    events = event_arms(values["event"])
    settings = RolloutSettings.from_config({**values, "event": None})
    offline = read_section(OfflineSettings, values, others=True)
    jobs = []
    if values["online"] or card or twins:
        jobs = choose_episodes(
            named_tasks(values), values["episodes"], settings.split, settings.env
        )
    shard = choose_shard(values["shard"])
    if jobs:
        environment(settings.env).check_installed()
    log_to_terminal(logger)
    device = process_device(str(cfg.device))
    policy, name, source = load_policy(PolicyChoice.from_config(values), "probe", logger, device)
    data = values["recordings"]
    recordings = [] if data is None else all_recordings(open_sources(data, policy.embodiment))
    numbers = (
        choose_numbers(values["recorded"], len(recordings), "the data") if values["offline"] else []
    )
    probed = [recordings[i] for i in numbers]
    subgoals = None
    if jobs and not twins:
        subgoals = choose_subgoals(policy, values["subgoal"], str(values["subgoal_mode"]), device)
    predictor = None if subgoals is None else str(values["subgoal"]["name"])
    facts = facts_of(policy, name, source, settings, predictor)
    # A shipped policy has a folder of its name; one that an earlier version began continues.
    kind = "probe"
    if card:
        kind = "card"
    if twins:
        kind = "twins"
    model = safe_name(name, "the policy's name")
    folder = Path("outputs", kind, model, str(facts.checkpoint))
    if facts.run.is_shipped and not folder.exists():
        folder = Path("outputs", kind, str(facts.checkpoint))
    folder = folder if cfg.output is None else Path(str(cfg.output)).expanduser()
    logger.info("%d recorded episodes, %d in closed loop, into %s", len(probed), len(jobs), folder)
    plan = ProbePlan(values["with"], probed, recordings, jobs, offline, events)
    options = RunOptions(subgoals, shard, source)
    try:
        if twins:
            twin_figures = run_twins(policy.eval(), jobs, folder, facts, settings, options)
            text, page = twins_text(twin_figures), folder / FIGURES
        elif card:
            graded = run_card(
                policy.eval(), plan, folder, facts, settings, options, values["references"]
            )
            text, page = card_text(graded), folder / PAGE
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
