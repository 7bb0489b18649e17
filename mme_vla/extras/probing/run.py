"""A whole probe: on recorded episodes, in closed loop, and the page about both. Repeated, it
resumes.
"""

import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from mme_vla.config.sections import read_section
from mme_vla.data.console import progress
from mme_vla.data.recording import action_offset_of
from mme_vla.data.sources import open_sources
from mme_vla.envs.base import environment
from mme_vla.envs.make import make_env
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError, printable, require
from mme_vla.evaluation.records import ARM, EpisodeRecord, RunKey, display_name
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.compare import Comparison, compare_all, pair_methods
from mme_vla.evaluation.results.events import idle_events
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.rollout.evaluation import (
    EvaluationRun,
    RunOptions,
    choose_jobs,
    facts_of,
    load,
    predictor_of,
)
from mme_vla.evaluation.rollout.events import event_arms
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import RUN_FILE, begin_run, find_records, fingerprint, read_folders
from mme_vla.extras.probing import lines
from mme_vla.extras.probing.arms import UNPROBED, Arm, choose_arms, options_of, slug
from mme_vla.extras.probing.channels import channel_of
from mme_vla.extras.probing.findings import Findings
from mme_vla.extras.probing.offline import probe_offline
from mme_vla.extras.probing.probed import DonorEpisodes, ProbedPolicy
from mme_vla.extras.probing.recordings import Recording, all_recordings
from mme_vla.extras.probing.report import (
    ONLINE,
    Notes,
    check_outputs,
    write_images,
    write_page,
)
from mme_vla.extras.probing.settings import IN_CLOSED_LOOP, NO_DATA, OfflineSettings
from mme_vla.policy.base import Policy
from mme_vla.subgoal import SubgoalPredictor

OFFLINE = "offline"
"""Folder of the lines."""


@dataclass(frozen=True)
class ProbePlan:
    """What is probed.

    arms: as in `with`; None for `DEFAULT_ARMS`.
    recordings: episodes to probe.
    lend: to take from.
    jobs: episodes of the closed loop, none for none.
    events: further arms of the closed loop, in the simulation.
    """

    arms: Any = None
    recordings: Sequence[Recording] = ()
    lend: Sequence[Recording] = ()
    jobs: Sequence[Job] = ()
    offline: OfflineSettings = field(default_factory=OfflineSettings)
    events: Sequence[str] = ()

    @property
    def n_goals(self) -> int:
        """How many goals the episodes to take from have."""
        return len({recording.goal for recording in self.lend})


@dataclass(frozen=True)
class Probe:
    """The results of a probe. notes: what a reader has to know, such as arms that were left out."""

    findings: Findings
    comparisons: list[Comparison]
    notes: list[str]
    page: Path


def run_probe(
    policy: Policy,
    plan: ProbePlan,
    folder: Path,
    facts: RunKey,
    settings: RolloutSettings,
    options: RunOptions,
) -> Probe:
    """Run the parts of the plan that the folder lacks, and write the page."""
    check_outputs(folder, claimed=(folder / OFFLINE / RUN_FILE).is_file())
    channel = channel_of(policy)
    left_out: list[str] = []
    if plan.recordings:
        has_boundaries = all(recording.tells_subtasks for recording in plan.recordings)
        donor_names = {recording.name for recording in plan.lend}
        n_donors = len(donor_names)
        if any(recording.name in donor_names for recording in plan.recordings):
            n_donors -= 1  # never the probed one
        arms, left_out = choose_arms(
            plan.arms, policy, channel, n_donors, boundaries=has_boundaries, n_goals=plan.n_goals
        )
        require(
            policy.info.resamples,
            "A served policy is probed in closed loop alone, because a server chooses a chunk once:"
            " set offline=false online=true. Recordings are what contents are taken from.",
        )
        in_loop = [arm.name for arm in arms if arm.in_closed_loop]
        if in_loop:
            require(plan.jobs, f"with={in_loop[0]} acts in closed loop: set online=true.")
            left_out.append(
                f"On recordings {', '.join(in_loop)} were left out: they act in episodes."
            )
        arms = [arm for arm in arms if not arm.in_closed_loop]
        _on_recordings(policy, arms, plan, folder / OFFLINE, facts, options)
    if plan.jobs:
        has_boundaries = options.base is make_env and settings.env == "mme_vla"
        arms, not_in_loop = choose_arms(
            plan.arms,
            policy,
            channel,
            len(plan.lend),
            boundaries=has_boundaries,
            n_goals=plan.n_goals,
        )
        left_out += [f"In closed loop {note}" for note in not_in_loop if note not in left_out]
        _in_closed_loop(policy, arms, plan, folder / ONLINE, facts, settings, options)

    # The page on all that the folder holds.
    findings = Findings.of(lines.read_all(folder / OFFLINE))
    records: list[EpisodeRecord] = []
    if (folder / ONLINE).is_dir():
        records = read_folders(find_records([folder / ONLINE]))
    comparisons = _paired(records, facts.split, facts.model)
    warnings = idle_events(records)
    for comparison in comparisons:
        warnings += comparison.gaps
    write_images(findings, plan.recordings, folder)
    name = display_name(facts.model, facts.checkpoint)
    notes = Notes(warnings, left_out)
    page = write_page(folder, name, facts.checkpoint, findings, comparisons, notes)
    return Probe(findings, comparisons, [*left_out, *warnings], page)


def _in_closed_loop(
    policy: Policy,
    arms: Sequence[Arm],
    plan: ProbePlan,
    folder: Path,
    facts: RunKey,
    settings: RolloutSettings,
    options: RunOptions,
) -> None:
    """Run the unprobed policy, with its events, then every arm on the same scenes."""
    channel = channel_of(policy)
    donors = DonorEpisodes(policy, channel, plan.lend) if plan.lend else None
    for number, arm in enumerate([UNPROBED, *arms], start=1):
        if options.show_progress:
            heading = f"arm {number} of {len(arms) + 1} · {arm.name}: {arm.meaning}"
            print(printable(heading), file=sys.stderr)
        output = folder / slug(arm.name)
        arm_options = replace(
            options,
            notes={"arm": arm.name},
            show_forecast=arm is UNPROBED,
            name=f"{display_name(facts.model, facts.checkpoint)}{ARM}{arm.name}",
        )
        if arm is UNPROBED:
            run = EvaluationRun(policy, plan.jobs, output, facts, settings, arm_options)
            run.run_with_events(plan.events)
        else:
            probed = ProbedPolicy(policy, arm, plan.lend, donors).eval()
            arm_facts = facts._replace(model=named(facts.model, arm))
            EvaluationRun(probed, plan.jobs, output, arm_facts, settings, arm_options).run()


def _on_recordings(
    policy: Policy,
    arms: Sequence[Arm],
    plan: ProbePlan,
    folder: Path,
    facts: RunKey,
    options: RunOptions,
) -> None:
    policy.require_processor().require_stats()
    # What decides the lines, as `run.json` keeps it
    sources = {id(r.source): r.source for r in [*plan.recordings, *plan.lend]}
    decisive = {
        "model": facts.model,
        "checkpoint": facts.checkpoint,
        "policy": fingerprint(dict(policy.config)),
        "arms": {arm.name: options_of(arm) for arm in arms},
        "data": {source.name: source.fingerprint for source in sources.values()},
        "recordings": [recording.name for recording in plan.recordings],
        **asdict(plan.offline),
    }
    begin_run(folder, decisive)
    shard = options.shard
    local = list(plan.recordings)[shard.index :: shard.count]
    path = folder / "offline.jsonl"
    if shard.count > 1:
        path = folder / f"offline-{shard.index}of{shard.count}.jsonl"
    with (
        progress("probe", len(local), unit="episodes")
        if options.show_progress
        else nullcontext(lambda _: None) as advance
    ):
        probe_offline(policy, arms, local, plan.lend, path, plan.offline, advance)


def probed_folder(folder: Path) -> Findings:
    """What a finished probe's folder holds."""
    findings = Findings.of(lines.read_all(folder / OFFLINE))
    if not findings.moments:
        raise UserError(
            f"{folder} holds no probe on recorded episodes: no {OFFLINE}/offline.jsonl with lines"
            " in it."
        )
    return findings


def probe(
    policy: Policy | str | Path,
    recordings: Any = None,
    arms: Sequence[Any] | None = None,
    *,
    output: str | Path,
    tasks: str | Sequence[str] | None = None,
    episodes: int | Sequence[int] | None = None,
    seed: int = 42,
    subgoal: str | SubgoalPredictor | None = None,
    name: str | None = None,
    base: Callable[..., Any] = make_env,
    show_progress: bool = True,
    event: str | Sequence[str] | None = None,
    **settings: Any,
) -> Probe:
    """Measure what a policy takes from its memory; what `output` holds already is not run again.

    Args:
        policy: one with statistics; or a folder or hub repository to load one from.
        recordings: recorded episodes: folders of datasets, as for the command. Without them the
            closed loop is probed.
        arms: interventions, such as `["shuffle", "drop:2", "nodemo+delay:64"]`; by default all that
            are possible.
        output: the probe's folder, for its lines and its page.
        tasks, episodes: of the closed loop, as for `evaluate`; None leaves it out.
        seed: of noise and of random choices.
        subgoal: a predictor, or the name of one, for policies that read subgoals in closed loop.
        name: what lines and records call the policy.
        base: makes an environment with the benchmark's interface.
        show_progress: whether a progress bar is shown.
        event: further arms of the closed loop, as for `evaluate`.
        settings: of `OfflineSettings`, such as `draws=8` chunks a step, and of `RolloutSettings`,
            such as `workers=2`.

    Returns:
        Its findings, the paired comparisons of the closed loop, notes, and the path of the page.

    >>> probe("outputs/mine/latest", "outputs/val", output="outputs/probe").page  # doctest: +SKIP
    """
    settings["seed"] = seed
    offline = read_section(OfflineSettings, settings, others=True)
    of_rollouts = {spec.name for spec in fields(RolloutSettings)}
    of_offline = {spec.name for spec in fields(OfflineSettings)} - of_rollouts
    rollout = {key: value for key, value in settings.items() if key not in of_offline}
    run_settings = read_section(RolloutSettings, rollout)
    if recordings is None and tasks is None:
        raise UserError(f"probe() needs recordings=…, tasks=…, or both. {NO_DATA}")
    arms_of_events = event_arms(event)
    require(tasks is not None or not arms_of_events, IN_CLOSED_LOOP)
    loaded, source = load(policy)
    recorded: list[Recording] = []
    if recordings is not None:
        sources = open_sources(recordings, loaded.embodiment)
        recorded = all_recordings(sources, action_offset_of(loaded))
    jobs: list[Job] = []
    if tasks is not None:
        jobs = choose_jobs(tasks, episodes, run_settings.split, run_settings.env)
    if jobs and base is make_env:
        environment(run_settings.env).check_installed()
    predictor = predictor_of(loaded, subgoal)
    facts = facts_of(
        loaded, name, source, run_settings, subgoal if isinstance(subgoal, str) else None
    )
    plan = ProbePlan(arms, recorded, recorded, jobs, offline, arms_of_events)
    folder = Path(output).expanduser()
    options = RunOptions(predictor, source=source, base=base, show_progress=show_progress)
    return run_probe(loaded.eval(), plan, folder, facts, run_settings, options)


def named(model: str, arm: Arm) -> str:
    """What records call a model under an arm; unprobed it keeps its name."""
    return model if arm is UNPROBED else f"{model}{ARM}{arm.name}"


def _paired(records: Sequence[EpisodeRecord], split: str, model: str) -> list[Comparison]:
    """Each arm against the unprobed run, over the episodes that both have, corrected for their
    number. They are called by the arm alone.

    model: the unprobed one's name.
    """
    if not records:
        return []
    protocol = Protocol.of_records(records)
    methods = aggregate(records, protocol, split).methods
    unprobed = [
        method for method in methods if method.key.model == model and method.key.event is None
    ]
    baseline = unprobed[0] if unprobed else None
    for method in methods:
        if method is baseline:
            method.label = UNPROBED.name
        elif method.key.event is not None:
            method.label = f"event {method.key.event}"
        else:
            method.label = method.key.model.removeprefix(f"{model}{ARM}")
    if baseline is None:
        return []
    pairs = []
    for method in methods:
        if method is not baseline and pair_methods(method, baseline).keys:
            pairs.append((method, baseline))
    return compare_all(pairs, protocol)
