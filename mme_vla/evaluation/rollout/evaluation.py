"""A whole evaluation: claim the folder, leave out what is done, run the rest, record every episode
at once.
"""

import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from mme_vla.config.sections import without
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import choose_episodes as choose_specs
from mme_vla.envs.make import ROBOMME, check_sessions, make_env
from mme_vla.envs.metadata import read_variant
from mme_vla.envs.vector.pool import Job, VecEnv
from mme_vla.errors import UserError, counted, require
from mme_vla.evaluation.receipts import receipt
from mme_vla.evaluation.records import EpisodeRecord, finished, merge
from mme_vla.evaluation.rollout.environment import base_env, make_rollout_env
from mme_vla.evaluation.rollout.events import read_events
from mme_vla.evaluation.rollout.progress import Durations, RolloutProgress, earlier_records
from mme_vla.evaluation.rollout.runner import Rollout, RunFacts, Waiting, Workload
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.rollout.subgoals import SUBGOALS
from mme_vla.evaluation.store import (
    INDIFFERENT,
    RECORDS,
    Claims,
    RecordLog,
    claim_run,
    fingerprint,
    read_records,
)
from mme_vla.policy.base import Policy
from mme_vla.policy.identity import identify_policy
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.registry import SPLIT_POLICIES
from mme_vla.subgoal import SubgoalPredictor, build_predictor
from mme_vla.subgoal.background import BackgroundPredictor
from mme_vla.utils import remove_drafts, safe_name

logger = logging.getLogger("mme_vla.evaluate")


@dataclass(frozen=True)
class Shard:
    """One of several processes that share a run."""

    index: int = 0
    count: int = 1

    @property
    def file(self) -> str:
        """Name of the file its records go to."""
        return RECORDS if self.count == 1 else f"episodes-{self.index}of{self.count}.jsonl"


def choose_episodes(
    tasks: str | Sequence[str] = "all",
    episodes: Any = None,
    split: str = "test",
    env: str = "mme_vla",
) -> list[Job]:
    """The episodes of a run, task by task, by the grammar of all commands
    (`mme_vla.envs.episodes`).
    """
    return [
        Job(spec.task, spec.split, spec.episode)
        for spec in choose_specs(tasks, episodes, split, env)
    ]


def choose_shard(text: str | None, variables: Mapping[str, str] | None = None) -> Shard:
    """Read `0/4` (the first of four), or the rank of this process under torchrun.

    text: wins over them.
    variables: of the environment; None: the process's own.
    """
    if variables is None:
        variables = os.environ
    if text is None:
        if "RANK" not in variables or "WORLD_SIZE" not in variables:
            return Shard()
        text = f"{variables['RANK']}/{variables['WORLD_SIZE']}"
    match = re.fullmatch(r"(\d+)/(\d+)", str(text))
    if match is None or int(match[1]) >= int(match[2]):
        raise UserError(
            f"shard={text!r}; expected <index>/<count> counted from 0, such as 0/4 … 3/4."
        )
    return Shard(int(match[1]), int(match[2]))


VIDEOS = "videos"


class Evaluation(NamedTuple):
    """The outcome of a run: the records of its episodes, old and new, and what the policy did this
    time.

    Of several processes that share a run each has the records that it wrote. output: the run's
    folder. matched: the records of the plain run, where `records` are of events.
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
        room (`store.Claims`).
    source: where the weights are from; part of what makes a run the same.
    base: makes an environment with the benchmark's interface; importable by name.
    notes: kept in `run.json` and never compared.
    times_from: earlier records, of any policy: the longest episodes begin first, and say how long
        all will take; by default those in the run's folder and in the folders beside it.
    show_forecast: whether that is printed: of several arms on the same episodes by the first.
    name: what progress calls the run; None for its label.
    """

    subgoals: SubgoalPredictor | None = None
    shard: Shard = Shard()
    source: str | None = None
    base: Callable[..., Any] = make_env
    notes: Mapping[str, Any] | None = None
    times_from: Path | None = None
    show_progress: bool = True
    show_forecast: bool = True
    name: str | None = None


def evaluate_policy(
    policy: Policy,
    jobs: Sequence[Job],
    settings: RolloutSettings,
    events: Sequence[str],
    options: RunOptions,
    *,
    name: str | None = None,
    predictor: str | None = None,
    output: str | Path | None = None,
    training: str = "",
    recordings: Any = None,
) -> Evaluation:
    """Evaluate a loaded policy: what the command and `mme_vla.evaluate` have in common.

    Args:
        events: arms, each a run of its own beside the run without one.
        name: what records call the policy; None for its own name.
        predictor: name of the subgoal predictor, for the records.
        output: the run's folder; None for the one that the same command finds again.
        training: of several trainings the one that this is; its records are in a folder of that
            name below the run's.
        recordings: datasets whose episodes a split shows before its own.
    """
    facts = facts_of(policy, name, options.source, settings, predictor)
    folder = default_output(facts) if output is None else Path(output).expanduser()
    folder = folder / training
    count = counted(len(jobs), "episode")
    if options.shard.count > 1:
        count += f", shared as {options.shard.index}/{options.shard.count},"
    logger.info("%s into %s", count, folder)
    notes = {**(options.notes or {}), "composition": facts.composition}
    policy = policy_of_split(policy, settings.split, recordings)
    options = replace(options, notes=notes)
    return run_with_events(policy, jobs, folder, facts, settings, events, options)


def policy_of_split(policy: Policy, split: str, recordings: Any = None) -> Policy:
    """The policy as a split evaluates it.

    Args:
        recordings: datasets whose episodes a split shows before its own (`stress:sessions=<n>`).
    """
    variant = read_variant(split)
    if variant is not None and variant.dial in SPLIT_POLICIES:
        wrapped: Policy = SPLIT_POLICIES[variant.dial](policy, split, recordings)
        return wrapped
    require(
        not recordings,
        f"recordings=…: split={split} shows none; they are for split=stress:sessions=<n>.",
    )
    return policy


def run_with_events(
    policy: Policy,
    jobs: Sequence[Job],
    output: Path,
    facts: RunFacts,
    settings: RolloutSettings,
    events: Sequence[str],
    options: RunOptions = RunOptions(),
) -> Evaluation:
    """Run every episode in `output`, then once more under each event, in a folder of its own below.

    The runs have the same scenes and the same noise, and differ in the event alone. Without events
    it is `run_episodes`.

    events: arms, such as `pause:100@subtask:2`.
    """
    for event in events:
        for placed in read_events(event):
            placed.perturbation.check(policy)
    matched = run_episodes(policy, jobs, output, facts, settings, options)
    if not events:
        return matched
    options = replace(
        options, times_from=options.times_from or output, show_forecast=False, name=None
    )
    records: list[EpisodeRecord] = []
    for event in events:
        folder = output / ("event-" + re.sub(r"[^\w.+-]", "-", event))
        named = replace(facts, event=event)
        run = run_episodes(policy, jobs, folder, named, replace(settings, event=event), options)
        records += run.records
    return Evaluation(records, run.workload, output, matched.records)


def run_episodes(
    policy: Policy,
    jobs: Sequence[Job],
    output: Path,
    facts: RunFacts,
    settings: RolloutSettings,
    options: RunOptions = RunOptions(),
) -> Evaluation:
    """Run every episode that `output` has no result of yet.

    Args:
        policy: in eval mode, on its device, with statistics.
        jobs: the episodes of the run, of all its processes.
        output: the run's folder; one that holds a part of the same run is gone on with.
        facts: what the records say of the policy.
    """
    # Everything that can be refused is, before the folder is claimed.
    policy.require_processor().require_stats()
    check_subgoals(policy, options.subgoals)
    check_sessions(settings.split, policy.info.n_distractor_episodes)
    renders = False
    if options.base is make_env:
        environment(settings.env).check_embodiment(policy.embodiment)
        renders = settings.env == ROBOMME and settings.render
    decisive = run_settings(policy, facts, settings, options.subgoals, options.source)
    run = claim_run(output, decisive, options.notes)

    shard = options.shard
    workload = Workload()
    with RecordLog(output / shard.file) as log:
        remove_drafts(output / VIDEOS)  # videos of workers that were killed
        # Which episodes are left, the longest first
        done = _done(output, jobs, facts)
        finished_keys = finished(done)
        missing = [job for job in jobs if (job.task, job.episode) not in finished_keys]
        durations = Durations(earlier_records(output, options.times_from))
        missing = durations.longest_first(missing)
        workers = settings.worker_count(-(-len(missing) // shard.count))
        workers = min(workers, policy.info.max_running or workers)

        completed = [record for record in done if record.outcome != "error"]
        name = options.name or facts.run.label
        with RolloutProgress(len(jobs), completed, options.show_progress, name) as progress:
            if completed:
                progress.say(
                    f"{output} holds {len(completed)} of {counted(len(jobs), 'episode')}:"
                    " continuing with the others"
                )
            forecast = durations.forecast(missing, workers, shard.count)
            if forecast and options.show_forecast:
                progress.say(str(forecast))
            if missing:
                claims = Claims(output, shard.file) if shard.count > 1 else None
                folder = output / SUBGOALS if settings.subgoal_log else None
                with (
                    _environments(policy, output, facts, settings, options.base, workers) as envs,
                    receipt(output / shard.file, policy, run, options.source, renders),
                ):
                    rollout = Rollout(
                        policy,
                        envs,
                        facts,
                        settings,
                        log.append,
                        options.subgoals,
                        folder,
                        progress,
                        workload,
                    )
                    rollout.run(Waiting(missing, claims))
    return Evaluation(_done(output, jobs, facts, shard), workload, output)


def _environments(
    policy: Policy,
    output: Path,
    facts: RunFacts,
    settings: RolloutSettings,
    base: Callable[..., Any],
    workers: int,
) -> VecEnv:
    robot = policy.embodiment
    sessions = 0
    if base is make_env:
        base = base_env(settings.env, robot, settings.render, only_possible=settings.only_possible)
        sessions = policy.info.n_distractor_episodes
    videos = None
    if settings.video != "none":
        videos = (str(output / VIDEOS), settings.video)
    make = partial(
        make_rollout_env,
        base=base,
        max_steps=settings.limit_of,
        videos=videos,
        run=facts.run.label,
        robot=robot,
        max_actions=settings.max_actions or policy.info.max_actions,
        sessions=sessions,
    )
    return VecEnv([], workers, make, settings.timeout_s)


def run_settings(
    policy: Policy,
    facts: RunFacts,
    settings: RolloutSettings,
    subgoals: SubgoalPredictor | None = None,
    source: str | None = None,
) -> dict[str, Any]:
    """What decides the outcomes, as `run.json` keeps it.

    How many workers or shards there are, and on which machine, does not belong to it; nor does the
    batch size, though batches may change the last bits of an action.
    """
    decisive = {
        "model": facts.model,
        "checkpoint": facts.checkpoint,
        "source": _end_of(source),
        "policy": fingerprint(dict(policy.config)),
        "dtype": str(next(policy.parameters()).dtype).removeprefix("torch."),
        "subgoal": None if subgoals is None else _predictor_facts(facts.subgoal, subgoals),
        "execute": settings.execute or policy.embodiment.action.execute,
        "flow_steps": settings.flow_steps or policy.info.sample_steps,
        "seed": settings.seed,
        "split": settings.split,
        "env": settings.env,
        "max_steps": settings.step_limit,
        "render": settings.render,
    }
    # Left out where they are not set, as in runs from before there were these options.
    optional = {
        "event": settings.event,
        "max_actions": settings.max_actions,
        "only_possible": settings.only_possible,
    }
    return decisive | {name: value for name, value in optional.items() if value}


def _predictor_facts(name: str | None, subgoals: SubgoalPredictor) -> dict[str, Any]:
    decisive = without(subgoals.settings, *INDIFFERENT)
    for key in ("model", "adapter"):
        if key in decisive:
            decisive[key] = _end_of(decisive[key])
    decisive |= {"name": name, "kind": subgoals.kind, "interval": subgoals.interval}
    if isinstance(subgoals, BackgroundPredictor):
        decisive["mode"] = "background"
    return decisive


def _end_of(place: str | None) -> str | None:
    """The end of a path alone: machines that share a run may have the folder at
    different places.
    """
    return None if place is None else "/".join(Path(place).parts[-4:])


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


def kind_section(policy: Policy) -> dict[str, str]:
    """The key `kind` of a predictor's section: what the policy was trained to read. Empty where it
    does not say.
    """
    kind = subgoal_kind(policy)
    return {} if kind is None else {"kind": kind.removesuffix("_subgoal")}


def predictor_of(policy: Policy, subgoal: str | SubgoalPredictor | None) -> SubgoalPredictor | None:
    """A predictor by its name, of the kind of subgoals that the policy reads; one that is given
    stays as it is.
    """
    if isinstance(subgoal, str):
        return build_predictor({"name": subgoal, **kind_section(policy)})
    return subgoal


def facts_of(
    policy: Policy,
    name: str | None,
    source: str | None,
    settings: RolloutSettings,
    subgoal: str | None,
) -> RunFacts:
    """What the records of a run have in common.

    name: of the model; None for the policy's own.
    source: the checkpoint.
    subgoal: name of the predictor.
    """
    identity = policy.info.identity or identify_policy(policy, name, source)
    return RunFacts(
        model=name or identity.model,
        checkpoint=identity.checkpoint,
        model_seed=settings.seed,
        split=settings.split,
        max_steps=settings.step_limit,
        subgoal=subgoal,
        memory_budget=identity.memory_budget,
        composition=identity.composition,
        training=identity.training,
        event=settings.event,
    )


def default_output(facts: RunFacts) -> Path:
    """A folder that the same command finds again:
    `outputs/evaluation/<model>/<checkpoint>/seed<seed>…`, or `outputs/evaluation/nano/seed<seed>…`
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
    if facts.run.is_shipped and not folder.exists():
        folder = Path("outputs", "evaluation", str(facts.checkpoint), run)
    return folder


def _done(
    output: Path, jobs: Sequence[Job], facts: RunFacts, shard: Shard | None = None
) -> list[EpisodeRecord]:
    """The folder's records of these episodes; with a shard, only those of its own file."""
    keys = {(job.task, job.episode) for job in jobs}
    files = sorted(output.glob("episodes*.jsonl"))
    if shard is not None and shard.count > 1:
        files = [output / shard.file]
    records = []
    for path in files:
        for record in read_records(path):
            # run.json has seen to it that this is the same policy: records from before there were
            # digests are of it too.
            if record.composition is None:
                record = replace(record, composition=facts.composition)
            records.append(record)
    merged = merge(records, "first")
    return [record for record in merged if record.run == facts.run and record.key in keys]
