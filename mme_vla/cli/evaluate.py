"""`mme-vla evaluate checkpoint=… tasks=all`: run a policy on the benchmark
(configs/evaluate.yaml).
"""

import logging
import multiprocessing
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from mme_vla.cli.command import log_to_terminal
from mme_vla.cli.loading import PolicyChoice, load_policy, prepare_sampling, release, words_of
from mme_vla.config.devices import process_device
from mme_vla.config.sections import PathText, read_section
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import named_tasks
from mme_vla.errors import check_choice
from mme_vla.evaluation.claims import choose_shard
from mme_vla.evaluation.records import OUTCOMES, EpisodeRecord, count_outcomes
from mme_vla.evaluation.results.events import event_table, idle_events
from mme_vla.evaluation.results.report import policy_facts
from mme_vla.evaluation.results.tables import print_table
from mme_vla.evaluation.rollout.evaluation import (
    VIDEOS,
    Evaluation,
    RunOptions,
    check_subgoals,
    choose_jobs,
    evaluate_policy,
    kind_section,
)
from mme_vla.evaluation.rollout.events import event_arms
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.rollout.subgoals import total_score
from mme_vla.evaluation.store import check_run_folder
from mme_vla.policy.base import Policy
from mme_vla.policy.build import policy_config
from mme_vla.policy.run_folders import find_run, trainings_in
from mme_vla.subgoal import BackgroundPredictor, SubgoalPredictor, Usage, build_predictor
from mme_vla.training.runs import check_finished

logger = logging.getLogger("mme_vla.evaluate")
SUBGOAL_MODES = ("inline", "background")


@dataclass(frozen=True)
class EvaluateCommand:
    """An evaluation as a command line describes it: the keys of `configs/evaluate.yaml`."""

    episodes: Any
    event: Any
    sampling: str
    deterministic: bool
    subgoal: Mapping[str, Any] | None
    subgoal_mode: str
    shard: Any
    times_from: PathText | None
    output: PathText | None
    policy: PolicyChoice
    rollout: RolloutSettings

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration, plain and resolved."""
        policy = PolicyChoice.from_config(config)
        # Each event is a run of its own, beside the run without one.
        rollout = RolloutSettings.from_config({**config, "event": None})
        run = read_section(cls, config, others=True, policy=policy, rollout=rollout)
        if run.deterministic:
            rollout = replace(rollout, max_batch=1)
        return replace(run, policy=policy, rollout=rollout)


def main(cfg: DictConfig) -> None:
    """Evaluate a policy; of a folder of trainings one after the other."""
    config = policy_config(cfg)
    run = EvaluateCommand.from_config(config)
    trainings = []
    if run.policy.checkpoint is not None:
        trainings = trainings_in(find_run(Path(run.policy.checkpoint).expanduser()))
    check_finished(trainings)
    for training in trainings:
        evaluate_one(
            EvaluateCommand.from_config({**config, "checkpoint": str(training)}), training.name
        )
    if not trainings:
        evaluate_one(run)


def evaluate_one(run: EvaluateCommand, training: str = "") -> None:
    """Run the episodes of one policy; `training` is the folder of its records in `output`."""
    settings = run.rollout
    if run.output is not None:
        check_run_folder(Path(run.output).expanduser() / training)
    events = event_arms(run.event)
    if run.deterministic:
        # PyTorch takes kernels whose results repeat; where an operation has none, it warns.
        # read when the GPU is first used
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        torch.backends.cudnn.benchmark = False
    tasks = named_tasks(run.policy.config)
    jobs = choose_jobs(tasks, run.episodes, settings.split, settings.env)
    shard = choose_shard(run.shard)
    environment(settings.env).check_installed()
    log_to_terminal(logger)
    device = process_device(run.policy.device)
    policy, name, source = load_policy(run.policy, "evaluate", logger, device)
    environment(settings.env).check_embodiment(policy.embodiment)
    prepare_sampling(policy, run.sampling, logger)
    subgoals = choose_subgoals(policy, run.subgoal, run.subgoal_mode, device)
    subgoal = None
    if subgoals is not None and run.subgoal is not None:
        subgoal = str(run.subgoal["name"])
    if not settings.render:
        logger.warning(
            "render=false: the policy sees black images; only the time of the simulation means"
            " anything"
        )
    notes = {
        "device": str(device),
        "workers": settings.workers,
        "max_batch": settings.max_batch,
        "deterministic": run.deterministic,
        "policy": policy_facts(policy.config),
    }
    options = RunOptions(
        subgoals=subgoals,
        shard=shard,
        source=source,
        notes=notes,
        times_from=None if run.times_from is None else Path(run.times_from).expanduser(),
    )
    if multiprocessing.get_start_method() == "loky":
        # a job of joblib: a worker of ours cannot look that way up
        multiprocessing.set_start_method("spawn", force=True)
    try:
        done = evaluate_policy(
            policy,
            jobs,
            settings,
            events,
            options,
            name=name,
            subgoal=subgoal,
            output=run.output,
            training=training,
        )
        if policy.info.server is not None:
            logger.info("server: %s", policy.info.server.get("times"))
    finally:
        release(policy)
        if subgoals is not None:
            report_usage(subgoals.usage)
            subgoals.close()
    report(done)


def choose_subgoals(
    policy: Policy,
    section: Mapping[str, Any] | None,
    mode: str = "inline",
    device: torch.device | None = None,
) -> SubgoalPredictor | None:
    """The predictor, saying the kind of subgoal the policy was trained with unless the command line
    names one.

    section: the section `subgoal` of the configuration.
    mode: `inline`, or `background`.
    device: the policy's; a predictor with `device: auto` runs there too. None leaves the choice to
        the predictor.
    """
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
    if predictor is not None and mode == "background":
        return BackgroundPredictor(predictor)
    return predictor


def report(done: Evaluation) -> None:
    """Say how it went, task by task, and where the table comes from."""
    is_scored = total_score(done.records) is not None
    columns = ["task", "episodes", *OUTCOMES, "success rate"]
    if is_scored:
        columns += ["right subgoals (%)", "points off by (pixels)"]
    table = Table(*columns)
    by_task: dict[str, list[EpisodeRecord]] = {}
    for record in done.records:
        by_task.setdefault(record.task, []).append(record)
    rows = list(by_task.items())
    if len(rows) > 1:
        rows.append(("all", list(done.records)))  # beside a task that may have this name
    for task, records in rows:
        counts = count_outcomes(records)
        cells = [task, str(len(records))]
        cells += [str(counts[outcome]) for outcome in OUTCOMES]
        cells.append(f"{100 * counts['success'] / len(records):.1f} %")
        if is_scored:
            score = total_score(records)
            cells += score.show() if score else ("", "")
        table.add_row(*cells)
    # Piped into a file there is no terminal to fit: as wide as the table is.
    console = Console(width=None if sys.stdout.isatty() else 160, soft_wrap=True, highlight=False)
    if done.matched:
        # What events changed, and where one did not act.
        print_table(event_table([*done.records, *done.matched], "first"), console.width)
        for line in idle_events(done.records):
            logger.warning(line)
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
    if any((done.output / VIDEOS).glob("*.mp4")):
        logger.info("videos: %s", done.output / VIDEOS)
    logger.info("next: mme-vla results %s", done.output)


def report_usage(usage: Usage) -> None:
    """Say in one line what a predictor did, as far as it did anything."""
    counts = {
        "calls": usage.calls,
        "answers from the cache": usage.cached,
        "tokens read": usage.input_tokens,
        "tokens written": usage.output_tokens,
    }
    for problem, count in usage.problems.items():
        counts[f"{problem} answers"] = count
    words = [f"{count:,} {what}" for what, count in counts.items() if count]
    if words:
        logger.info("subgoals: %s", ", ".join(words))
