"""`python -m mme_vla.evaluate checkpoint=… tasks=all`: run a policy on the benchmark
(configs/evaluate.yaml).
"""

import logging
import multiprocessing
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from mme_vla.cli.command import cli, log_to_terminal
from mme_vla.cli.loading import load_policy, prepare_sampling, words_of
from mme_vla.config.composition import resolved
from mme_vla.config.devices import process_device
from mme_vla.errors import check_choice

if TYPE_CHECKING:
    import torch

    from mme_vla.evaluation.rollout.evaluation import Evaluation
    from mme_vla.policy.base import Policy
    from mme_vla.subgoal import SubgoalPredictor, Usage


logger = logging.getLogger("mme_vla.evaluate")
SUBGOAL_MODES = ("inline", "background")


@cli("evaluate")
def main(cfg: DictConfig) -> None:
    """Run the episodes that have no result yet; of a folder of trainings those of one training
    after the other.
    """
    from mme_vla.policy.run_folders import find_run, trainings_in
    from mme_vla.training.runs import check_finished

    folder = None if cfg.checkpoint is None else find_run(Path(str(cfg.checkpoint)).expanduser())
    trainings = [] if folder is None else trainings_in(folder)
    check_finished(trainings)
    for training in trainings:
        one = cfg.copy()
        one.checkpoint = str(training)
        evaluate_one(one, training.name)
    if not trainings:
        evaluate_one(cfg)


def evaluate_one(cfg: DictConfig, training: str = "") -> None:
    """Run the episodes of one policy; `training` is the folder of its records in `output`."""
    import torch

    from mme_vla.envs.base import environment
    from mme_vla.envs.episodes import named_tasks
    from mme_vla.evaluation.api import policy_of_split
    from mme_vla.evaluation.results.report import policy_facts
    from mme_vla.evaluation.rollout.evaluation import (
        choose_episodes,
        choose_shard,
        default_output,
        evaluate_events,
        facts_of,
    )
    from mme_vla.evaluation.rollout.events import event_arms
    from mme_vla.evaluation.rollout.settings import RolloutSettings

    values = resolved(cfg)
    events = event_arms(values["event"])
    settings = RolloutSettings.from_config({**values, "event": None})
    if values["deterministic"]:
        settings = replace(settings, max_batch=1)
        # PyTorch takes kernels whose results repeat; where an operation has none, it warns.
        # read when the GPU is first used
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        torch.backends.cudnn.benchmark = False
    jobs = choose_episodes(named_tasks(values), values["episodes"], settings.split, settings.env)
    shard = choose_shard(values["shard"])
    environment(settings.env).check_installed()
    log_to_terminal(logger)
    device = process_device(str(cfg.device))
    policy, name, source = load_policy(cfg, "evaluate", logger, device)
    prepare_sampling(policy, cfg.sampling, logger)
    subgoals = choose_subgoals(policy, values["subgoal"], str(values["subgoal_mode"]), device)
    predictor = None if subgoals is None else str(values["subgoal"]["name"])
    facts = facts_of(policy, name, source, settings, predictor)
    if not settings.render:
        logger.warning(
            "render=false: the policy sees black images; only the time of the simulation means"
            " anything"
        )
    output = (
        default_output(facts) if cfg.output is None else Path(str(cfg.output)).expanduser()
    ) / training
    count = f"{len(jobs)} episode{'s'[len(jobs) == 1 :]}"
    logger.info(
        "%s into %s%s",
        count,
        output,
        f", shared as {shard.index}/{shard.count}" if shard.count > 1 else "",
    )
    notes: dict[str, Any] = {
        "device": str(device),
        "workers": settings.workers,
        "max_batch": settings.max_batch,
    }
    notes["deterministic"] = values["deterministic"]
    notes |= {"policy": policy_facts(policy.config), "composition": facts.composition}
    if multiprocessing.get_start_method() == "loky":
        # a job of joblib: a worker of ours cannot look that way up
        multiprocessing.set_start_method("spawn", force=True)
    try:
        done = evaluate_events(
            policy_of_split(policy, settings.split, values["recordings"]),
            jobs,
            output,
            facts,
            settings,
            events,
            subgoals=subgoals,
            shard=shard,
            source=source,
            notes=notes,
            times_from=None if cfg.times_from is None else Path(str(cfg.times_from)).expanduser(),
        )
    finally:
        if subgoals is not None:
            report_usage(subgoals.usage)
            subgoals.close()
    report(done, output)


def choose_subgoals(
    policy: "Policy",
    section: dict[str, Any] | None,
    mode: str = "inline",
    device: "torch.device | None" = None,
) -> "SubgoalPredictor | None":
    """The predictor, saying the kind of subgoal the policy was trained with unless the command line
    names one.

    section: the section `subgoal` of the configuration. mode: `inline`, or `background`. device:
    the policy's; a predictor with `device: auto` runs there too. None leaves the choice to the
    predictor.
    """
    from mme_vla.evaluation.rollout.evaluation import check_subgoals, kind_section
    from mme_vla.subgoal import BackgroundPredictor, build_predictor

    check_choice("subgoal_mode", mode, SUBGOAL_MODES)
    if section is None:
        if policy.require_processor().prompt_spec.reads_subgoal:
            logger.warning(
                "this policy reads a subgoal and subgoal=none: it gets the plain prompt, as"
                " released"
            )
        return None
    if not words_of("subgoal.kind"):
        section = {**section, **kind_section(policy)}
    if device is not None and section.get("device") == "auto":
        section = {**section, "device": str(device)}
    predictor = build_predictor(section)
    check_subgoals(policy, predictor)
    return (
        BackgroundPredictor(predictor)
        if predictor is not None and mode == "background"
        else predictor
    )


def report(done: "Evaluation", output: Path) -> None:
    """Say how it went, task by task, and where the table comes from."""
    from rich.console import Console
    from rich.table import Table

    from mme_vla.evaluation.records import count_outcomes
    from mme_vla.evaluation.rollout.subgoals import total_score

    tasks = list(dict.fromkeys(record.task for record in done.records))
    scored = total_score(done.records) is not None
    judged = ("right subgoals", "points off by") if scored else ()
    table = Table(
        "task", *("episodes", "success", "fail", "timeout", "error", "success rate"), *judged
    )
    rows = [(task, [r for r in done.records if r.task == task]) for task in tasks]
    for task, records in [*rows, *([("all", done.records)] if len(rows) > 1 else [])]:
        counts = count_outcomes(records)
        outcomes = [str(counts[name]) for name in ("success", "fail", "timeout", "error")]
        score = total_score(records)
        cells = (score.show() if score else ("", "")) if scored else ()
        table.add_row(
            task,
            str(len(records)),
            *outcomes,
            f"{100 * counts['success'] / len(records):.1f} %",
            *cells,
        )
    # Piped into a file there is no terminal to fit: as wide as the table is.
    console = Console(width=None if sys.stdout.isatty() else 160, soft_wrap=True, highlight=False)
    if done.matched:
        report_events(done, console.width)
    elif rows:
        console.print(table)
    work = done.workload
    if work.batches:
        logger.info(
            "%d chunks in batches of %.1f on average; the policy was busy for %.0f of %.0f s",
            work.chunks, work.mean_batch, work.policy_s, work.wall_s,
        )  # fmt: skip
    if any(record.outcome == "error" for record in done.records):
        logger.warning("some episodes ended in an error: the same command tries them again")
    logger.info("python -m mme_vla.results %s", output)


def report_events(done: "Evaluation", width: int) -> None:
    """Say what events changed, and where one did not act."""
    from mme_vla.evaluation.results.events import event_table, idle_events
    from mme_vla.evaluation.results.tables import print_table

    print_table(event_table([*done.records, *done.matched], "first"), width)
    for line in idle_events(done.records):
        logger.warning(line)


def report_usage(usage: "Usage") -> None:
    """Say in one line what a predictor did, as far as it did anything."""
    counts = {
        "calls": usage.calls, "answers from the cache": usage.cached,
        "tokens read": usage.input_tokens, "tokens written": usage.output_tokens,
        **{f"{problem} answers": count for problem, count in usage.problems.items()},
    }  # fmt: skip
    words = [f"{count:,} {what}" for what, count in counts.items() if count]
    if words:
        logger.info("subgoals: %s", ", ".join(words))
