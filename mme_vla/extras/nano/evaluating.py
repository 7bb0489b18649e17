"""Rows in closed loop: policies, the floors and ceilings beside them, and the scenes that all of
them see.
"""

import shutil
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.waypoints import Motions
from mme_vla.embodiment.robomme import benchmark_action
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import choose_episodes, choose_tasks
from mme_vla.envs.make import make_env, make_task
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.observations import Include
from mme_vla.envs.robomme.recording.frames import motions_of
from mme_vla.envs.robomme.recording.processes import carry_out
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import SceneError, require
from mme_vla.evaluation.claims import choose_shard
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord, RecordLog, read_records
from mme_vla.evaluation.rollout.evaluation import (
    VIDEOS,
    EvaluationRun,
    RunOptions,
    facts_of,
    predictor_of,
)
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import RECORDS, begin_run
from mme_vla.extras.nano.demonstrations import Demonstration
from mme_vla.extras.nano.rows import CONFIG, TRAINED
from mme_vla.extras.play.game import MAX_CHOICES, ChoiceSession
from mme_vla.extras.play.players import OraclePlayer, Player, RandomPlayer, play
from mme_vla.extras.probing.arms import lacking, read_arm
from mme_vla.extras.probing.channels import channel_of
from mme_vla.extras.probing.probed import ProbedPolicy
from mme_vla.extras.probing.run import named
from mme_vla.policy.base import Policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.utils import read_json, write_json

PLANNER, DEMONSTRATOR, RANDOM, FREQUENT = "planner", "demonstrator", "random", "frequent"
ORACLE_FRAMES = "oracle_frames"
"""The ceiling of a memory that chooses frames: its policies, which choose among those at which a
sub-task began.
"""
KINDS = {PLANNER: "ceiling", DEMONSTRATOR: "ceiling", RANDOM: "floor", FREQUENT: "floor"}
ORACLE = "oracle"


@dataclass(frozen=True)
class Rules:
    """How episodes are run; `max_choices` and `only_possible` are nano's own.

    seed: of a policy's noise.
    max_steps: control steps until the outcome is timeout; 0: as many as the split allows.
    max_choices: actions until it is; None: no limit for policies, `MAX_CHOICES` for rows without a
        training.
    only_possible: offer no option whose every object is out of reach.
    shard: which of several processes this is, `0/2` or `1/2`; None: the only one.
    """

    split: str = "test"
    seed: int = 7
    max_steps: int = 0
    max_choices: int | None = None
    only_possible: bool = False
    workers: int = 1
    shard: str | None = None

    @property
    def steps(self) -> int:
        """Control steps until the outcome is timeout."""
        return self.max_steps or environment("mme_vla").step_limit(self.split)


@dataclass(frozen=True)
class Play:
    """An episode to be played by what is no policy. moves: of `frequent`, see `frequent_moves`."""

    name: str
    spec: EpisodeSpec
    rules: Rules
    moves: Sequence[Mapping[str, Any]] = ()


class FrequentPlayer(Player):
    """The choice that demonstrations make most often at this place of an episode of this task."""

    model = FREQUENT
    needs_images = False

    def __init__(self, moves: Sequence[Mapping[str, Any]]) -> None:
        self._moves = moves

    def choose(self, session: ChoiceSession) -> tuple[dict[str, Any], dict[str, Any]]:
        move = dict(self._moves[min(len(session.decisions), len(self._moves) - 1)])
        offered = [option.label for option in session.options]
        if move["choice"] not in offered:
            move["choice"] = offered[0]
        return move, {}


def frequent_moves(files: Sequence[Path], space: Any) -> dict[str, list[dict[str, Any]]]:
    """Task → for each place in an episode the most frequent letter, and the middle of its points in
    pixels.
    """
    # Task → place in an episode → the choices made there
    choices: dict[str, dict[int, list[np.ndarray]]] = defaultdict(lambda: defaultdict(list))
    for file in files:
        demonstration = Demonstration.load(file, images=False)
        for place, row in enumerate(demonstration.motions.targets):
            choices[demonstration.task][place].append(row)
    moves: dict[str, list[dict[str, Any]]] = {}
    for task, places in choices.items():
        moves[task] = []
        for _, rows in sorted(places.items()):
            table = np.stack(rows)
            letters = table[:, list(space.choice)].argmax(1)
            best = Counter(letters.tolist()).most_common(1)[0][0]
            action = benchmark_action(space, np.median(table[letters == best], axis=0))
            letter = str(action["choice"]).lower()
            moves[task].append({"choice": letter, "point": [float(x) for x in action["point"]]})
    return moves


def play_episode(job: Play) -> EpisodeRecord:
    """Play an episode; a choice that cannot be carried out is a failure, as it is a policy's."""
    spec, rules = job.spec, job.rules
    if job.name == PLANNER:
        return replay(spec, rules.steps)
    player: Player
    if job.name == FREQUENT:
        player = FrequentPlayer(job.moves)
    elif job.name == RANDOM:
        player = RandomPlayer()
    else:
        assert job.name == DEMONSTRATOR
        player = OraclePlayer()
    env = make_env(
        spec.task, spec.split, spec.episode, "multi_choice", max_steps=rules.steps, render=False,
        include=Include(possible=rules.only_possible),
    )  # fmt: skip
    session = ChoiceSession(env, spec, rules.max_choices or MAX_CHOICES, images=False)
    try:
        record = play(session, player).record(job.name, 0, 0, rules.steps)
    finally:
        session.close()
    if record.outcome == "error":
        return replace(record, outcome="fail", error=None, extra={}, refused=record.error)
    return replace(record, extra={})


def replay(spec: EpisodeSpec, max_steps: int) -> EpisodeRecord:
    """Demonstrate an episode without images, and repeat the planned motions in the environment of
    the policies.
    """
    motions = _planned(spec)
    env = make_env(
        spec.task, spec.split, spec.episode, "waypoint", max_steps=max_steps, render=False
    )
    targets = [] if motions is None else list(motions.targets)
    status = "fail"
    reason = None
    try:
        env.reset()
        for target in targets:
            *_, info = env.step(target)
            status, reason = str(info["status"]), info.get("error_message")
            if status != "ongoing":
                break
        scene = env.scene_digest
        steps = env.steps_counted
    finally:
        env.close()
    extra: dict[str, Any] = {"status": status, "demonstrated": motions is not None}
    refused = str(reason) if reason else None  # why a motion was not carried out
    outcome = status if status in ("success", "fail", "timeout") else "fail"
    return EpisodeRecord(
        PLANNER, "none", 0, spec.task, spec.episode, spec.seed, spec.difficulty, outcome, steps,
        split=spec.split,
        max_steps=max_steps, action_space="waypoint", extra=extra, scene=scene,
        refused=refused,
    )  # fmt: skip


def _planned(spec: EpisodeSpec) -> Motions | None:
    from mme_vla.envs.robomme.recording.recorder import Recorder

    try:
        env = make_task(spec.task, render=False, **spec.options)
    except SceneError:
        return None
    try:
        result = Recorder(env, render=False).record()
        return motions_of(result.frames) if result.success else None
    finally:
        env.close()


def play_all(
    name: str, folder: Path, specs: Sequence[EpisodeSpec], rules: Rules, moves: Mapping[str, Any]
) -> list[EpisodeRecord]:
    """A row that nothing was trained for: plays what `folder` has no record of yet; its records of
    these episodes.
    """
    settings = {**asdict(rules), "model": name, "max_steps": rules.steps}
    del settings["workers"], settings["shard"]
    begin_run(folder, settings)
    (folder / CONFIG).write_text(f"name: {name}\n", encoding="utf-8")
    write_json(folder / TRAINED, {"row": name, "kind": KINDS[name], "trained": False, "seed": 0})
    file = folder / RECORDS
    known = {record.key for record in read_records(file)} if file.is_file() else set()
    selected = {EpisodeKey(spec.task, spec.episode): spec for spec in specs}
    missing = []
    for key, spec in selected.items():
        if key not in known:
            missing.append(Play(name, spec, rules, moves.get(spec.task, ())))
    with RecordLog(file) as log:
        for record in carry_out(missing, play_episode, rules.workers):
            log.append(record)
    return [record for record in read_records(file) if record.key in selected]


def run_checkpoint(
    checkpoint: Path,
    folder: Path,
    specs: Sequence[EpisodeSpec],
    rules: Rules,
    video: str = "none",
    oracle: bool = False,
) -> list[EpisodeRecord]:
    """Run what `folder` has no record of yet; all records. A policy that reads subgoals gets the
    simulator's.

    oracle: the memory chooses among the frames at which a sub-task began, as the probe's arm of
        this name.
    """
    policy: Policy = MMEPolicy.from_pretrained(str(checkpoint)).eval()
    subgoal_source = None if subgoal_kind(policy) is None else ORACLE
    subgoals = predictor_of(policy, subgoal_source)
    settings = RolloutSettings.from_config(
        {
            "seed": rules.seed,
            "split": rules.split,
            "max_steps": rules.steps,
            "workers": rules.workers,
            "max_actions": rules.max_choices,
            "only_possible": rules.only_possible,
            "video": video,
        }
    )
    facts = facts_of(policy, None, str(checkpoint), settings, None if subgoals is None else ORACLE)
    facts = facts._replace(checkpoint=checkpoint.name)
    if oracle:
        arm = read_arm(ORACLE)
        why = lacking(arm, policy, channel_of(policy), 0, boundaries=True)
        require(
            why is None,
            f"oracle={facts.model}: it needs {why}. Name another model, or set oracle=null.",
        )
        policy = ProbedPolicy(policy, arm).eval()
        facts = facts._replace(model=named(facts.model, arm))
    jobs = [Job(spec.task, spec.split, spec.episode) for spec in specs]
    options = RunOptions(subgoals=subgoals, shard=choose_shard(rules.shard), source=str(checkpoint))
    return EvaluationRun(policy, jobs, folder, facts, settings, options).run().records


def evaluate_row(
    training: Path,
    checkpoint: Path,
    folder: Path,
    specs: Sequence[EpisodeSpec],
    rules: Rules,
    oracle: str | None = None,
) -> list[EpisodeRecord]:
    """Evaluate one training into a row's folder, which then says all about it (`config.yaml`,
    `trained.json`).

    oracle: name of the row in which it is evaluated with the oracle's frames, a ceiling.
    """
    records = run_checkpoint(checkpoint, folder, specs, rules, oracle=oracle is not None)
    # Only then: a folder of other weights was refused, and keeps its files.
    shutil.copy(training / CONFIG, folder / CONFIG)
    about = read_json(training / TRAINED, "a training's end")
    if oracle is not None:
        about |= {"row": oracle, "kind": "ceiling"}
    write_json(folder / TRAINED, about)
    return records


def record_videos(
    checkpoint: Path, folder: Path, records: Sequence[EpisodeRecord], rules: Rules
) -> list[Path]:
    """Videos of the first success and the first failure of these records, run once more with every
    frame rendered.

    folder: of the videos; what it has is not rendered again.
    """
    alone = replace(rules, workers=1, shard=None)
    for name, won in (("success", True), ("failure", False)):
        outcomes = [record for record in records if record.success is won]
        if outcomes:
            first = outcomes[0]
            specs = choose_episodes(first.task, [first.episode], first.split)
            run_checkpoint(checkpoint, folder / name, specs, alone, video="all")
    return sorted(folder.glob(f"*/{VIDEOS}/*.mp4"))


def built_scenes(
    file: Path, tasks: str | Sequence[str], split: str, count: int, workers: int
) -> tuple[list[EpisodeSpec], list[str]]:
    """The first so many episodes of each task whose scenes can be built, and which were left out
    and why.

    file: keeps both, so that they are looked for once.
    """
    # Episode → why its scene cannot be built, empty if it can
    tried: dict[str, str] = {}
    if file.is_file():
        tried = read_json(file, "the scenes of a split")["tried"]
    source = environment("mme_vla")
    while True:
        built: list[EpisodeSpec] = []
        untried: list[EpisodeSpec] = []
        for task in choose_tasks(tasks):
            good: list[EpisodeSpec] = []
            fresh: list[EpisodeSpec] = []
            for spec in source.episodes(task, split):
                reason = tried.get(_key(spec))
                if reason is None:
                    fresh.append(spec)
                elif not reason:
                    good.append(spec)
            n_missing = max(count - len(good), 0)
            require(
                len(fresh) >= n_missing,
                f"{task}: of split {split} fewer than {count} scenes can be built.",
            )
            built += good[:count]
            untried += fresh[:n_missing]
        if not untried:
            break
        for key, reason in carry_out(untried, tried_scene, workers):
            tried[key] = reason
            write_json(file, {"split": split, "tried": dict(sorted(tried.items()))})
    left_out = [f"{key}: {reason}" for key, reason in sorted(tried.items()) if reason]
    return built, left_out


def _key(spec: EpisodeSpec) -> str:
    return f"{spec.task} {spec.episode}"


def tried_scene(spec: EpisodeSpec) -> tuple[str, str]:
    """Task and number of an episode, and why its scene cannot be built; empty if it can."""
    try:
        make_task(spec.task, render=False, **spec.options).close()
    except SceneError as error:
        return _key(spec), str(error)
    return _key(spec), ""
