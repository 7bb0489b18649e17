"""Twins: the same scene with one fact flipped, and the same noise. Which candidate does the next
chunk approach in each of the two?

A scripted demonstrator acts until a decision depends on the fact, so that every policy observes the
same frames. A policy that remembers approaches the correct candidate in both scenes. One without
the fact sees two equal scenes, and is correct in at most one of them.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.config.sections import read_section
from mme_vla.data.console import progress
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import choice_action
from mme_vla.envs.base import CHOICES, EpisodeEnv, environment
from mme_vla.envs.facts import Candidates
from mme_vla.envs.make import make_env, make_task
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.robomme.recording.frames import motions_of
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import SceneError, require, text_of
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.statistics import Interval, mean_interval
from mme_vla.evaluation.results.tables import Table, to_markdown
from mme_vla.evaluation.rollout.environment import ChunkCommand, ChunkEnv, EpisodeFactory
from mme_vla.evaluation.rollout.evaluation import RunOptions, run_settings
from mme_vla.evaluation.rollout.running import RenderPlan, RunningEpisode
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import begin_run
from mme_vla.extras.probing.arms import UNPROBED, lacking, read_arm
from mme_vla.extras.probing.channels import channel_of
from mme_vla.extras.probing.probed import ProbedPolicy
from mme_vla.policy.base import Policy
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.utils import read_lines, write_json
from mme_vla.utils.io import to_line

LINES, FIGURES = "twins.jsonl", "twins.json"
MEMORY_OFF = "drop:all"
"""The arm without memory: everything remembered is removed."""
SAME_STATE = 0.01
"""What the states of twins may differ by, in their units (rad, m). Policies have told scenes apart
by a yaw that differed by 0.015 rad.
"""
NOTHING = RenderRequest({}, now=(), grounded=False)


class NoPairError(Exception):
    """An episode makes no pair of twins; the message says why."""


# One pair -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TwinLine:
    """One pair of twins.

    candidates: how many there are.
    chance: the share of pairs that a guess solves.
    arms: name of the arm → its share of the pair, 0 to 1: the product of those of its two scenes.
    left_out: why there is no pair; empty where there is one.
    """

    task: str
    episode: int
    candidates: int = 0
    chance: float = 0.0
    arms: Mapping[str, float] = field(default_factory=dict)
    left_out: str = ""


@dataclass(frozen=True)
class Decision:
    """One scene of a pair at its decision.

    state: of the robot, [w].
    chunks: of each arm the actions [n, w] that are executed next.
    actions: the demonstrator's, which led here.
    """

    goal: str
    candidates: Candidates
    state: np.ndarray
    chunks: Mapping[str, np.ndarray]
    actions: Sequence[np.ndarray]


def nearest_candidates(places: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Indices of the candidates that a motion of the tool approaches; several if they tie.

    It is the candidate that the tool has reached, nearer than half the smallest distance between
    two of them. Of a tool that has reached none it is the one whose distance fell the most.

    Args:
        places: of the candidates [n, d].
        start, end: of the tool [d].
    """
    before = np.linalg.norm(places - start, axis=1)
    after = np.linalg.norm(places - end, axis=1)
    nearest = int(after.argmin())
    if after[nearest] < _half_gap(places) and after[nearest] < before[nearest]:
        return np.array([nearest])
    approach = before - after
    return np.flatnonzero(approach >= approach.max() - 1e-6)


def _half_gap(places: np.ndarray) -> float:
    """Half the smallest distance between two places; infinite for a single one."""
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    return float(distances.min()) / 2


def share_correct(candidates: Candidates, start: Sequence[float], end: Sequence[float]) -> float:
    """The share of the approached candidates that are correct: 1 or 0, or of a tie, such as half of
    two.
    """
    places = np.asarray(candidates.places, np.float64)
    tied = nearest_candidates(places, np.asarray(start, np.float64), np.asarray(end, np.float64))
    return float(np.isin(tied, candidates.correct).mean())


def check_pair(first: Decision, second: Decision) -> None:
    """Make sure that two scenes differ in what is correct alone.

    Raises:
        NoPairError: in something else, or not in that.
    """
    places = np.asarray(first.candidates.places, np.float64)
    others = np.asarray(second.candidates.places, np.float64)
    if first.goal != second.goal:
        raise NoPairError("the goal of its twin differs")
    gap = np.abs(first.state - second.state).max()
    if gap > SAME_STATE:
        raise NoPairError(
            f"the robot's state differs by {gap:.2g} from its twin's, so the current frame may tell"
            " them apart"
        )
    if places.shape != others.shape:
        raise NoPairError("its twin has another number of candidates")
    same = _half_gap(places)
    gaps = np.linalg.norm(places[:, None] - others[None], axis=2)
    if (gaps.min(axis=1) >= same).any():
        raise NoPairError("the candidates of its twin are elsewhere")
    if (gaps[np.ix_(first.candidates.correct, second.candidates.correct)] < same).any():
        raise NoPairError("the same candidate is correct in its twin")


# Scenes -------------------------------------------------------------------------------------------


class TwinScenes:
    """Runs policies in the scenes of pairs.

    Args:
        policies: arm → policy; the same robot. The first one's reads decide what is rendered.
        settings: noise, split, environment, actions of a chunk that are executed.
        base: makes an environment from `task`, `split`, `episode`, `max_steps` and `row`; by
            default that of the settings.
    """

    def __init__(
        self,
        policies: Mapping[str, Policy],
        settings: RolloutSettings,
        base: Callable[..., Any] = make_env,
    ) -> None:
        self._policies = policies
        self._settings = settings
        policy = next(iter(policies.values()))
        self._robot = policy.embodiment
        self._plan = RenderPlan(policy, None, settings)
        self._with_images = EpisodeFactory(
            self._robot,
            settings.env,
            base,
            render=settings.render,
            only_possible=settings.only_possible,
        )
        self._without_images = replace(self._with_images, render=False)

    def run(self, job: Job) -> TwinLine:
        """Both scenes of an episode, under every arm."""
        source = environment(self._settings.env)
        spec = source.episode(job.task, job.split, job.episode)
        try:
            row = source.twin(spec)
            if row is None:
                raise NoPairError("it has no twin")
            twin = replace(spec, row=row)
            pair = [self._decide(spec, job), self._decide(twin, job)]
            check_pair(*pair)
            shares = dict.fromkeys(self._policies, 1.0)
            for scene, decision in zip((spec, twin), pair, strict=True):
                for arm, chunk in decision.chunks.items():
                    shares[arm] *= self._score(scene, decision, chunk)
        except (NoPairError, SceneError) as error:
            return TwinLine(job.task, job.episode, left_out=text_of(error))
        chance = 1.0
        for decision in pair:
            # The share of guesses that are correct
            chance *= len(decision.candidates.correct) / len(decision.candidates.places)
        return TwinLine(job.task, job.episode, len(pair[0].candidates.places), chance, shares)

    def _decide(self, spec: EpisodeSpec, job: Job) -> Decision:
        """Have the demonstrator act until the decision, and every policy choose its chunk there."""
        base, env = self._open(self._with_images, spec)
        try:
            # The video and the current frame, which every policy observes.
            frames, report = env.reset(self._plan.before_video())
            missing = self._plan.missing(frames)
            if missing is not None:
                frames, report = env.reset(missing)
            running = {}
            for arm, policy in self._policies.items():
                running[arm] = RunningEpisode(policy, job, self._settings.seed)
                running[arm].take_report(report)
                running[arm].begin(frames)
                _read(running[arm])

            # The demonstrator's actions, one by one, until a decision depends on the fact.
            actions: list[np.ndarray] = []
            first = next(iter(running.values()))
            script = _script(base, spec, self._robot)
            candidates: Candidates | None = base.candidates
            while candidates is None:
                action = next(script, None)
                if action is None:
                    raise NoPairError("the demonstrator reaches no decision that depends on a fact")
                actions.append(action)
                images = self._plan.of_chunk(first, 1)
                frames, _, terminated, truncated, report = env.step(
                    ChunkCommand(action[None], images=images)
                )
                if terminated or truncated:
                    raise NoPairError("the demonstrator ends it before a decision")
                for episode in running.values():
                    episode.set_actions(action[None])
                    episode.take_report(report)
                    episode.resume(frames)
                    _read(episode)
                candidates = base.candidates

            # What each policy would do now.
            chunks = {}
            execute = self._settings.execute or self._robot.action.execute
            for arm, policy in self._policies.items():
                chunk = policy.act([running[arm].episode], self._settings.flow_steps)[0]
                failure = running[arm].episode.failure
                if failure is not None:
                    raise NoPairError(f"the policy cannot act: {failure.reason}")
                chunks[arm] = chunk[:execute]
            state = np.asarray(frames["state"][-1], np.float64)
            return Decision(str(report.goal), candidates, state, chunks, actions)
        finally:
            env.close()

    def _score(self, spec: EpisodeSpec, decision: Decision, chunk: np.ndarray) -> float:
        """Execute a chunk at the decision of a scene; the share of what it approaches that is
        correct.
        """
        base, env = self._open(self._without_images, spec)
        try:
            env.reset(NOTHING)
            for action in decision.actions:
                env.step(ChunkCommand(action[None], images=NOTHING))
            start = base.tool
            env.step(ChunkCommand(chunk, images=NOTHING))
            return share_correct(decision.candidates, start, base.tool)
        finally:
            env.close()

    def _open(self, factory: EpisodeFactory, spec: EpisodeSpec) -> tuple[Any, ChunkEnv]:
        """The environment of a scene, and the same one as it takes chunks."""
        limit = self._settings.limit_of(spec.task)
        made = factory.open(spec.task, spec.split, spec.episode, limit, row=spec.row)
        factory = replace(factory, base=lambda **_: made, max_steps=limit)
        return made, factory(spec.task, spec.split, spec.episode)


def _read(running: RunningEpisode) -> None:
    """Take all waiting frames into memory."""
    while running.pieces:
        running.read()


def _script(base: Any, spec: EpisodeSpec, robot: Embodiment) -> Iterator[np.ndarray]:
    """Actions [w] of a demonstrator, one for each step that the caller performs in between."""
    if robot.action.space == CHOICES:
        while (choice := base.oracle()) is not None:
            yield choice_action(robot.action, choice)
    elif isinstance(base, EpisodeEnv):
        for action in base.environment.demonstrate(base.env):
            yield np.asarray(action, np.float32)
    else:
        yield from _recorded_actions(spec, robot)


def _recorded_actions(spec: EpisodeSpec, robot: Embodiment) -> Sequence[np.ndarray]:
    """What a demonstration of RoboMME executes, in the action space of a policy."""
    from mme_vla.envs.robomme.recording.recorder import Recorder

    space = str(robot.action.space)
    if robot.action.of_pose or space not in (*_RECORDED, "waypoint"):
        raise NoPairError(f"no demonstration has the actions of {robot.name}")
    task = make_task(spec.task, render=False, **spec.options)
    try:
        frames = Recorder(task, render=False).record().frames
    finally:
        task.close()
    executed = [frame for frame in frames if not frame.info["is_video_demo"]]
    if not executed:
        return ()
    if space == "waypoint":
        return list(motions_of(frames).targets)
    return [np.asarray(frame.action[_RECORDED[space]], np.float32) for frame in executed]


_RECORDED = {"joint_angle": "joint_action", "ee_pose": "eef_action"}
"""Action space → what a recorded step calls its action there."""


# Many pairs ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Accuracy:
    """Twin accuracy of one arm over the pairs of one or several tasks.

    accuracy, low, high: share of the pairs, a mean over tasks, with its 95 % interval.
    chance: what a guess has.
    """

    pairs: int
    accuracy: float
    low: float
    high: float
    chance: float


@dataclass(frozen=True)
class Twins:
    """The twin accuracy of a policy.

    tasks, suites: name → arm → accuracy.
    total: arm → accuracy.
    notes: what was left out.
    """

    model: str
    checkpoint: int | str
    tasks: Mapping[str, Mapping[str, Accuracy]]
    suites: Mapping[str, Mapping[str, Accuracy]]
    total: Mapping[str, Accuracy]
    notes: Sequence[str] = ()


def run_twins(
    policy: Policy,
    jobs: Sequence[Job],
    folder: Path,
    facts: RunKey,
    settings: RolloutSettings,
    options: RunOptions,
) -> Twins:
    """Run the pairs of these episodes that the folder lacks, and write `twins.json`.

    The policy acts as it is, and without memory where it has one whose entries can be removed.

    Raises:
        UserError: the policy reads subgoals, which would tell it the fact.
    """
    require(
        subgoal_kind(policy) is None,
        "Twins are for policies without subgoals: what a predictor reports would be measured, not"
        " the policy's memory.",
    )
    policies: dict[str, Policy] = {UNPROBED.name: policy}
    notes = []
    off = read_arm(MEMORY_OFF)
    why = lacking(off, policy, channel_of(policy), 0, boundaries=False)
    if why is None:
        policies[MEMORY_OFF] = ProbedPolicy(policy, off).eval()
        notes.append(
            f"{MEMORY_OFF} is this policy with its memory taken away, not a memoryless one: train"
            " present_modul or pi05 to compare."
        )
    else:
        notes.append(f"{MEMORY_OFF} was left out: it needs {why}.")
    begin_run(folder, run_settings(policy, facts, settings, None, options.source))

    # The pairs of this shard that the folder lacks.
    shard = options.shard
    path = folder / LINES
    if shard.count > 1:
        path = folder / f"twins-{shard.index}of{shard.count}.jsonl"
    local = list(jobs)[shard.index :: shard.count]
    known = {(line.task, line.episode) for line in read_twins(folder)}
    missing = [job for job in local if (job.task, job.episode) not in known]
    scenes = TwinScenes(policies, settings, options.base)
    bar: AbstractContextManager[Callable[[int], object]] = nullcontext(lambda _: None)
    if options.show_progress:
        bar = progress("twins", len(local), len(local) - len(missing), unit="pairs")
    with bar as advance:
        for job in missing:
            _append(path, scenes.run(job))
            advance(1)

    # The figures, over the pairs of every shard.
    selected = {(job.task, job.episode) for job in jobs}
    lines = [line for line in read_twins(folder) if (line.task, line.episode) in selected]
    suites = environment(settings.env).suites_of(job.task for job in jobs)
    twins = aggregate_twins(lines, suites)
    twins = replace(
        twins, model=facts.model, checkpoint=facts.checkpoint, notes=[*notes, *twins.notes]
    )
    write_json(folder / FIGURES, asdict(twins))
    return twins


def read_twins(folder: Path) -> list[TwinLine]:
    """The pairs of every shard."""
    lines: list[TwinLine] = []
    for path in sorted(folder.glob("twins*.jsonl")):
        lines += read_lines(path, partial(read_section, TwinLine), "pairs of twins")
    return lines


def _append(path: Path, line: TwinLine) -> None:
    """Add a line, which is on disk afterwards; one that was cut off is removed before it."""
    with path.open("ab+") as file:
        file.seek(0)
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)
        file.write(to_line(asdict(line)).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def aggregate_twins(lines: Sequence[TwinLine], task_suites: Mapping[str, str]) -> Twins:
    """Accuracy a task, a suite and in all; tasks weigh the same.

    task_suites: task → suite, of environments that are not RoboMME.
    """
    pairs: dict[str, list[TwinLine]] = {}
    reasons: dict[str, list[str]] = {}
    for line in lines:
        if line.left_out:
            reasons.setdefault(f"{line.task}: {line.left_out}", []).append(str(line.episode))
        else:
            pairs.setdefault(line.task, []).append(line)
    notes = []
    for reason, episodes in reasons.items():
        notes.append(f"Left out: {reason} (episodes {', '.join(episodes)}).")
    if not pairs:
        return Twins("", "", {}, {}, {}, notes)
    protocol = Protocol(tuple(pairs), task_suites=task_suites)
    tasks = {task: _accuracies([lines_of_task]) for task, lines_of_task in pairs.items()}
    suites = {}
    for suite in protocol.suites:
        suites[suite] = _accuracies([pairs[task] for task in protocol.choose("suite", suite)])
    return Twins("", "", tasks, suites, _accuracies(list(pairs.values())), notes)


def _accuracies(tasks: Sequence[Sequence[TwinLine]]) -> dict[str, Accuracy]:
    """Accuracy of each arm over the pairs of these tasks."""
    accuracies = {}
    for arm in tasks[0][0].arms:
        n_pairs = 0
        shares: list[np.ndarray] = []  # of each task, [pairs, 1]
        chances = []
        for lines in tasks:
            n_pairs += len(lines)
            shares.append(np.array([[line.arms[arm]] for line in lines]))
            chances.append(np.mean([line.chance for line in lines]))
        interval: Interval = mean_interval(shares)
        accuracies[arm] = Accuracy(
            pairs=n_pairs,
            accuracy=float(np.mean([outcomes.mean() for outcomes in shares])),
            low=interval.low,
            high=interval.high,
            chance=float(np.mean(chances)),
        )
    return accuracies


def twin_tables(twins: Twins) -> list[Table]:
    """The accuracy of each task, then of each suite and in all."""
    arms = list(twins.total)
    columns = ("", "pairs", *arms, "chance")
    rows = [_row(task, accuracies) for task, accuracies in twins.tasks.items()]
    rows += [_row(suite, accuracies) for suite, accuracies in twins.suites.items()]
    if twins.total:
        rows.append(_row("all", twins.total))
    first = len(twins.tasks)
    strong = {len(rows) - 1}
    return [Table("Twin accuracy (%)", columns, rows, {first}, strong, notes=twins.notes)]


def twins_text(twins: Twins) -> str:
    """The tables in Markdown, and what was left out."""
    return "\n".join([*map(to_markdown, twin_tables(twins)), *twins.notes])


def _row(name: str, accuracies: Mapping[str, Accuracy]) -> list[str]:
    cells = []
    for one in accuracies.values():
        interval = f"[{100 * one.low:.0f}, {100 * one.high:.0f}]"
        cells.append(f"{100 * one.accuracy:.0f} {interval}")
    one = next(iter(accuracies.values()))
    return [name, str(one.pairs), *cells, f"{100 * one.chance:.0f}"]
