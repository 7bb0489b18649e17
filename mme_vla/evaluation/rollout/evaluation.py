"""A whole evaluation, from `mme_vla.evaluate` to the records in the run's folder."""

import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from mme_vla.config.sections import read_section, without
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import choose_episodes
from mme_vla.envs.make import ROBOMME, make_env
from mme_vla.envs.metadata import base_of
from mme_vla.envs.rows import SUFFIX
from mme_vla.envs.vector.pool import Job, VecEnv
from mme_vla.errors import UserError, counted
from mme_vla.evaluation.claims import ALONE, Claims, Shard, check_sharing
from mme_vla.evaluation.receipts import receipt
from mme_vla.evaluation.records import (
    EpisodeRecord,
    RecordLog,
    RunKey,
    checkpoint_number,
    merge,
    read_records,
)
from mme_vla.evaluation.rollout.environment import EpisodeFactory
from mme_vla.evaluation.rollout.events import event_arms
from mme_vla.evaluation.rollout.progress import Durations, RolloutProgress, earlier_records
from mme_vla.evaluation.rollout.runner import Rollout, Workload
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.rollout.subgoals import SUBGOALS
from mme_vla.evaluation.store import (
    INDIFFERENT,
    begin_run,
    check_run_folder,
    fingerprint,
)
from mme_vla.policy.base import Policy
from mme_vla.policy.identity import identify_policy
from mme_vla.policy.run_folders import check_output, locate_checkpoint
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.subgoal import SubgoalPredictor, build_predictor
from mme_vla.subgoal.background import BackgroundPredictor
from mme_vla.utils import file_sum, remove_drafts, safe_name
from mme_vla.utils.processes import check_main_guard

logger = logging.getLogger("mme_vla.evaluate")
VIDEOS = "videos"


class Evaluation(NamedTuple):
    """The outcome of a run.

    records: of its episodes, old and new; of a shard, those that it wrote.
    workload: what the policy did this time.
    output: the run's folder.
    matched: the records of the plain run, where `records` are of events.
    """

    records: list[EpisodeRecord]
    workload: Workload
    output: Path
    matched: Sequence[EpisodeRecord] = ()

    @property
    def success_rate(self) -> float:
        """Share of successes, 0 to 1; an episode that ended in an error is none. NaN without
        episodes.
        """
        if not self.records:
            return float("nan")
        return sum(record.success for record in self.records) / len(self.records)


@dataclass(frozen=True)
class RunOptions:
    """What a run needs beside its policy, episodes and settings.

    subgoals: predicts the subgoal, where the policy reads one.
    shard: which of how many processes this is; each takes the next episode that is free when it has
        room (`claims.Claims`).
    source: where the weights are from; part of what makes a run the same.
    base: makes an environment with the benchmark's interface; importable by name.
    notes: kept in `run.json` and never compared.
    times_from: earlier records, of any policy: the longest episodes begin first, and say how long
        all will take; by default those in the run's folder and in the folders beside it.
    show_forecast: whether that is printed: of several arms on the same episodes by the first.
    name: what progress calls the run; None for its label.
    """

    subgoals: SubgoalPredictor | None = None
    shard: Shard = ALONE
    source: str | None = None
    base: Callable[..., Any] = make_env
    notes: Mapping[str, Any] | None = None
    times_from: Path | None = None
    show_progress: bool = True
    show_forecast: bool = True
    name: str | None = None


def evaluate(
    policy: Policy | str | Path,
    tasks: str | Sequence[str] = "all",
    episodes: int | Sequence[int] | None = None,
    *,
    seed: int = 42,
    output: str | Path | None = None,
    subgoal: str | SubgoalPredictor | None = None,
    name: str | None = None,
    base: Callable[..., Any] = make_env,
    show_progress: bool = True,
    event: str | Sequence[str] | None = None,
    **settings: Any,
) -> Evaluation:
    """Run a policy on episodes of the benchmark; what `output` holds already is not run again.

    Workers are processes that import the calling script: keep its work under
    `if __name__ == "__main__":`. A notebook needs nothing of the kind.

    Args:
        policy: one with statistics; or what to load one from: a folder, a hub repository, or the
            name of a shipped one, such as `nano`.
        tasks, episodes: as `tasks=` and `episodes=` of the command: `"all"` or names; None for all
            of the split, a number for the first so many, or a list.
        seed: of the policy's noise.
        output: the run's folder, by default the one the command would choose.
        subgoal: a predictor, or the name of one, for policies that read subgoals.
        name: what records call the policy; its own name by default.
        base: makes an environment with the benchmark's interface, importable by name.
        event: what happens in every episode, such as `"pause:100@subtask:2"`; of a list each by
            itself. Every episode runs without it too, in `output` itself.
        show_progress: whether a progress bar is shown.
        settings: of `RolloutSettings`, such as `workers=4` or `render=False`.

    Returns:
        The records of these episodes, and `success_rate`; of those with events, `matched` are the
        ones without.

    >>> result = evaluate("outputs/framesamp_modul/latest", "StopCube", 5)  # doctest: +SKIP
    >>> result.success_rate  # doctest: +SKIP
    0.4
    """
    rollout_settings = read_section(RolloutSettings, {**settings, "seed": seed})
    if output is not None:
        check_output(output)
        check_run_folder(Path(output).expanduser())
    events = event_arms(event)
    jobs = choose_jobs(tasks, episodes, rollout_settings.split, rollout_settings.env)
    if base is make_env:
        environment(rollout_settings.env).check_installed()
    loaded, source = load(policy)
    predictor = predictor_of(loaded, subgoal)
    label = type(subgoal).__name__ if isinstance(subgoal, SubgoalPredictor) else subgoal
    options = RunOptions(subgoals=predictor, source=source, base=base, show_progress=show_progress)
    return evaluate_policy(
        loaded.eval(),
        jobs,
        rollout_settings,
        events,
        options,
        name=name,
        subgoal=label,
        output=output,
    )


def choose_jobs(
    tasks: str | Sequence[str] = "all",
    episodes: Any = None,
    split: str = "test",
    env: str = "mme_vla",
) -> list[Job]:
    """The episodes of a run, task by task."""
    return [
        Job(spec.task, spec.split, spec.episode)
        for spec in choose_episodes(tasks, episodes, split, env)
    ]


def load(policy: Policy | str | Path) -> tuple[Policy, str | None]:
    """A policy, and where its weights are from."""
    if isinstance(policy, Policy):
        return policy, None
    source = locate_checkpoint(policy)
    return Policy.from_pretrained(source), source


def predictor_of(policy: Policy, subgoal: str | SubgoalPredictor | None) -> SubgoalPredictor | None:
    """A predictor of the kind of subgoals that the policy reads."""
    if isinstance(subgoal, str):
        return build_predictor({"name": subgoal, **kind_section(policy)})
    return subgoal


def kind_section(policy: Policy) -> dict[str, str]:
    """The key `kind` of a predictor's section, where the policy says what it reads."""
    kind = subgoal_kind(policy)
    return {} if kind is None else {"kind": kind.removesuffix("_subgoal")}


def evaluate_policy(
    policy: Policy,
    jobs: Sequence[Job],
    settings: RolloutSettings,
    events: Sequence[str],
    options: RunOptions,
    *,
    name: str | None = None,
    subgoal: str | None = None,
    output: str | Path | None = None,
    training: str = "",
) -> Evaluation:
    """Evaluate a loaded policy: what the command and `mme_vla.evaluate` have in common.

    Args:
        events: arms, each a run of its own beside the run without one.
        name: what records call the policy; None for its own name.
        subgoal: name of the predictor, for the records.
        output: the run's folder; None for the one that the same command finds again.
        training: of several trainings the one that this is; its records are in a folder of that
            name below the run's.
    """
    facts = facts_of(policy, name, options.source, settings, subgoal)
    folder = default_output(facts) if output is None else Path(output).expanduser()
    folder = folder / training
    count = counted(len(jobs), "episode")
    if options.shard.count > 1:
        count += f", shared as {options.shard.index}/{options.shard.count},"
    logger.info("%s into %s", count, folder)
    notes = {**(options.notes or {}), "composition": facts.composition}
    options = replace(options, notes=notes)
    run = EvaluationRun(policy, jobs, folder, facts, settings, options)
    return run.run_with_events(events)


def facts_of(
    policy: Policy,
    name: str | None,
    source: str | None,
    settings: RolloutSettings,
    subgoal: str | None,
) -> RunKey:
    """What the records of a run have in common.

    name: of the model; None for the policy's own.
    source: the checkpoint.
    subgoal: name of the predictor.
    """
    identity = policy.info.identity or identify_policy(policy, name, source)
    return RunKey(
        model=name or identity.model,
        checkpoint=identity.checkpoint,
        model_seed=settings.seed,
        split=settings.split,
        subgoal=subgoal,
        memory_budget=identity.memory_budget,
        composition=identity.composition,
        training=identity.training,
        event=settings.event,
    )


def default_output(facts: RunKey) -> Path:
    """A folder that the same command finds again:
    `outputs/evaluation/<model>…/<checkpoint>/seed<seed>…`, or `outputs/evaluation/nano/seed<seed>…`
    of a shipped policy. A run that earlier versions began under its model's name continues there.
    """
    model = safe_name(facts.model, "the policy's name")  # which a checkpoint may have brought
    if facts.memory_budget is not None:
        model += f"-{facts.memory_budget}"
    run = f"seed{facts.model_seed}"
    if facts.subgoal:
        run += f"-{facts.subgoal}"
    if facts.split != "test":
        run += f"-{re.sub('[:=]', '-', facts.split)}"
    folder = Path("outputs", "evaluation", model, str(facts.checkpoint), run)
    if facts.is_shipped and not folder.exists():
        folder = Path("outputs", "evaluation", str(facts.checkpoint), run)
    return folder


@dataclass(frozen=True)
class EvaluationRun:
    """A policy in its episodes, and the folder of the records.

    policy: in eval mode, on its device, with statistics.
    jobs: the episodes of the run, of all its processes.
    folder: one that holds a part of the same run is gone on with.
    facts: what the records say of the policy.
    """

    policy: Policy
    jobs: Sequence[Job]
    folder: Path
    facts: RunKey
    settings: RolloutSettings
    options: RunOptions = RunOptions()

    def run_with_events(self, events: Sequence[str]) -> Evaluation:
        """Run every episode, then once more under each event, with the same scenes and noise, in a
        folder of its own below.

        events: arms, such as `pause:100@subtask:2`.
        """
        # The same episodes with each event.
        options = replace(
            self.options,
            times_from=self.options.times_from or self.folder,
            show_forecast=False,
            name=None,
        )
        arms = []
        for event in events:
            arm = replace(
                self,
                folder=self.folder / ("event-" + re.sub(r"[^\w.+-]", "-", event)),
                facts=self.facts._replace(event=event),
                settings=replace(self.settings, event=event),
                options=options,
            )
            for part in arm.settings.events:
                part.perturbation.check(self.policy)
            arms.append(arm)
        matched = self.run()
        if not arms:
            return matched
        done = [arm.run() for arm in arms]
        records = [record for arm in done for record in arm.records]
        return Evaluation(records, done[-1].workload, self.folder, matched.records)

    def run(self) -> Evaluation:
        """Run every episode that the folder has no result of yet, the longest first."""
        options, settings = self.options, self.settings
        # Refuse what can be refused, before the folder is claimed.
        check_main_guard()
        self.policy.require_processor().require_stats()
        check_subgoals(self.policy, options.subgoals)
        if options.base is make_env:
            environment(settings.env).check_embodiment(self.policy.embodiment)
        decisive = run_settings(self.policy, self.facts, settings, options.subgoals, options.source)
        content = begin_run(self.folder, decisive, options.notes)
        workload = Workload()
        with RecordLog(self.folder / options.shard.file) as log:
            check_sharing(self.folder, log.path.name)
            remove_drafts(self.folder / VIDEOS)  # videos of workers that were killed
            # An episode that ended in an error is tried again.
            before = [record for record in self._records() if record.outcome != "error"]
            finished_keys = {record.key for record in before}
            missing = [job for job in self.jobs if (job.task, job.episode) not in finished_keys]
            durations = Durations(earlier_records(self.folder, options.times_from))
            missing = durations.longest_first(missing)
            n_local = -(-len(missing) // options.shard.count)  # if all processes are as fast
            workers = min(settings.workers or min(len(os.sched_getaffinity(0)), 16), n_local)
            workers = max(1, min(workers, self.policy.info.max_running or workers))

            forecast = None
            if options.show_forecast:
                forecast = durations.forecast(missing, workers, options.shard.count)
            name = options.name or self.facts.label
            with RolloutProgress(len(self.jobs), before, options.show_progress, name) as progress:
                progress.announce(self.folder, forecast)
                if missing:
                    workload = self._roll_out(missing, workers, content, log, progress)
        return Evaluation(self._records(options.shard), workload, self.folder)

    def _records(self, shard: Shard = ALONE) -> list[EpisodeRecord]:
        """The folder's records of these episodes; of one of several shards, only its own file's."""
        keys = {(job.task, job.episode) for job in self.jobs}
        files = sorted(self.folder.glob("episodes*.jsonl"))
        if shard.count > 1:
            files = [self.folder / shard.file]
        records = []
        for path in files:
            for record in read_records(path):
                # run.json has seen to it that this is the same policy: records from before there
                # were digests are of it too.
                if record.composition is None:
                    record = replace(record, composition=self.facts.composition)
                records.append(record)
        merged = merge(records, "first")
        # Records have the checkpoint as a number where its name is one.
        run = self.facts._replace(checkpoint=checkpoint_number(self.facts.checkpoint))
        return [record for record in merged if record.run == run and record.key in keys]

    def _roll_out(
        self,
        missing: Sequence[Job],
        workers: int,
        content: Mapping[str, Any],
        log: RecordLog,
        progress: RolloutProgress,
    ) -> Workload:
        """Run these episodes in worker processes. content: of `run.json`, for the receipt."""
        options, settings = self.options, self.settings
        make = EpisodeFactory(
            self.policy.embodiment,
            settings.env,
            options.base,
            render=settings.render,
            only_possible=settings.only_possible,
            max_steps=settings.limit_of,
            max_actions=settings.max_actions or self.policy.info.max_actions,
            videos=(str(self.folder / VIDEOS), settings.video),
            run=self.facts.label,
        )
        claims = Claims(self.folder, log.path.name) if options.shard.count > 1 else None
        renders = options.base is make_env and settings.env == ROBOMME and settings.render
        with (
            # It begins without jobs: the rollout hands them out.
            VecEnv([], workers, make, settings.timeout_s) as envs,
            receipt(log.path, self.policy, content, options.source, renders),
        ):
            rollout = Rollout(
                self.policy,
                envs,
                self.facts,
                settings,
                record=log.append,
                subgoals=options.subgoals,
                subgoal_folder=self.folder / SUBGOALS if settings.subgoal_log else None,
                progress=progress,
            )
            rollout.run(missing, claims)
        return rollout.workload


def check_subgoals(policy: Policy, subgoals: SubgoalPredictor | None) -> None:
    """Refuse a predictor whose subgoals this policy was not trained to read."""
    if subgoals is None:
        return
    if not policy.require_processor().prompt_spec.reads_subgoal:
        name = PolicySections.of(policy.config).name or "The policy"
        raise UserError(f"{name} reads no subgoal: leave out subgoal=….")
    kind = subgoal_kind(policy)
    if kind is not None and kind != f"{subgoals.kind}_subgoal":
        expected = kind.removesuffix("_subgoal")
        raise UserError(
            f"The policy was trained with {expected} subgoals: set subgoal.kind={expected}."
        )


def run_settings(
    policy: Policy,
    facts: RunKey,
    settings: RolloutSettings,
    subgoals: SubgoalPredictor | None = None,
    source: str | None = None,
) -> dict[str, Any]:
    """What decides the outcomes, as `run.json` keeps it.

    How many workers or shards there are, and on which machine, does not belong to it; nor does the
    batch size, though batches may change the last bits of an action.
    """
    predictor = None
    if subgoals is not None:
        predictor = without(subgoals.settings, *INDIFFERENT)
        for key in ("model", "adapter"):
            if key in predictor:
                predictor[key] = _end_of(predictor[key])
        predictor |= {"name": facts.subgoal, "kind": subgoals.kind, "interval": subgoals.interval}
        if isinstance(subgoals, BackgroundPredictor):
            predictor["mode"] = "background"
    decisive = {
        "model": facts.model,
        "checkpoint": facts.checkpoint,
        "source": _end_of(source),
        "policy": fingerprint(dict(policy.config)),
        "dtype": str(next(policy.parameters()).dtype).removeprefix("torch."),
        "subgoal": predictor,
        "execute": settings.execute or policy.embodiment.action.execute,
        "flow_steps": settings.flow_steps or policy.info.sample_steps,
        "seed": settings.seed,
        "split": settings.split,
        "env": settings.env,
        "max_steps": settings.step_limit,
        "render": settings.render,
    }
    scenes = Path(base_of(settings.split)).expanduser()
    # Left out where they are not set, as in runs from before there were these options.
    optional = {
        "split_sha256": file_sum(scenes) if scenes.suffix == SUFFIX and scenes.is_file() else None,
        "event": settings.event,
        "max_actions": settings.max_actions,
        "only_possible": settings.only_possible,
    }
    return decisive | {name: value for name, value in optional.items() if value}


def _end_of(place: str | None) -> str | None:
    # Machines that share a run may have the folder at different places.
    return None if place is None else "/".join(Path(place).parts[-4:])
