"""A run of nanoMME: demonstrations, tokens, trainings and evaluations of all rows. What exists is
skipped.
"""

import logging
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

from mme_vla.data.console import progress
from mme_vla.embodiment import Embodiment
from mme_vla.envs.episodes import choose_episodes, choose_tasks
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.robomme.recording.frames import DECISIONS, FrameChoice
from mme_vla.envs.robomme.recording.processes import carry_out
from mme_vla.envs.rows import DIFFICULTIES
from mme_vla.errors import UserError, brief, counted, require
from mme_vla.evaluation.claims import choose_shard
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.extras.nano.board import MATCHED
from mme_vla.extras.nano.demonstrations import Scene, demonstrated
from mme_vla.extras.nano.evaluating import (
    DEMONSTRATOR,
    FREQUENT,
    ORACLE_FRAMES,
    PLANNER,
    RANDOM,
    Rules,
    built_scenes,
    evaluate_row,
    frequent_moves,
    play_all,
    record_videos,
)
from mme_vla.extras.nano.fitting import Training, compose_policy, train_in_process
from mme_vla.extras.nano.learning import check_reflection
from mme_vla.extras.nano.page import ends_of, outcome_lines, write_page
from mme_vla.extras.nano.settings import STAGES, NanoRun
from mme_vla.extras.nano.tokens import TokenStore
from mme_vla.utils import read_json, write_json

logger = logging.getLogger("mme_vla.nano")
SEEDS_APART = 100_000  # first seeds of two difficulties
RETRIES = 20  # scenes in a row that no demonstration succeeds in


def run(nano: NanoRun, extra_dirs: Sequence[Path] = ()) -> Path:
    """All stages of a run, up to `stage`; the path of its page, or of the folder that holds what
    was made.

    extra_dirs: trees of the user's own models, as `--config-dir` adds them.
    """
    until = STAGES.index(nano.stage)
    folder = Path(nano.output)
    choose_shard(nano.shard)  # read here, before hours of recording and training
    rows = compose_rows(nano, extra_dirs)
    folder.mkdir(parents=True, exist_ok=True)
    minutes = Minutes(folder / "clock.json")
    with minutes.of("demonstrations"):
        files = record_all(nano, folder / "demonstrations", rows.choices, rows.robot)
    if until < STAGES.index("tokens"):
        return folder / "demonstrations"
    store = TokenStore.of(folder / "tokens", list(rows.composed.values()))
    with minutes.of("tokens"):
        for _ in carry_out(files, store.make, nano.workers):
            pass
    if until < STAGES.index("train"):
        return store.folder
    jobs = trainings_of(nano, rows.composed, folder / "training", files, store)
    with minutes.of("training"):
        todo = [job for job in chain(*jobs.values()) if not job.done]
        for _ in carry_out(todo, train_in_process, nano.workers):
            pass
    if until < STAGES.index("evaluate"):
        return folder / "training"
    results = folder / nano.split
    with minutes.of("evaluation"):
        records = evaluate_all(nano, results, jobs, files, rows.robot)
    if nano.shard is not None or len(choose_tasks(nano.task)) > 1:
        for row, row_records in records.items():
            n_successes = sum(record.success for record in row_records)
            logger.info("%s: %d of %d episodes", row, n_successes, len(row_records))
        return results
    videos: list[Path] = []
    with minutes.of("videos"):
        if nano.videos:  # of the first row's first training
            row, (first, *others) = next(iter(jobs.items()))
            of_first = records[row][: len(records[row]) // (1 + len(others))]
            videos = record_videos(first.checkpoint, folder / "videos", of_first, rules_of(nano))
    trained = {}
    for row, of_row in jobs.items():
        trained[row] = [job.folder for job in of_row]
    page = write_page(folder, nano, records, rows.blind, minutes.spent, videos, trained, len(files))
    print(page)
    for line in outcome_lines(records, ends_of(trained)):
        print(line)
    return page


@dataclass(frozen=True)
class Rows:
    """The models of a run. composed: row → its configuration. choices: at which frames memories
    read demonstrations.

    blind: the row that all others are compared with.
    """

    composed: Mapping[str, Mapping[str, Any]]
    choices: Sequence[FrameChoice]
    robot: Embodiment
    blind: str | None


def compose_rows(nano: NanoRun, extra_dirs: Sequence[Path] = ()) -> Rows:
    """Every model at every budget."""
    words = [
        f"backbone={nano.with_backbone}",
        f"embodiment={nano.with_embodiment}",
        "policy.augment=false",
        f"seed={nano.seed}",
        *nano.overrides,
    ]
    compose_model = partial(
        compose_policy,
        memories=nano.memories,
        words=words,
        extra_dirs=extra_dirs,
        plugins=nano.plugins,
    )
    models = nano.models
    require(models, "No row is to be trained: name one, such as model=framesamp_modul.")
    composed: dict[str, dict[str, Any]] = {}
    for model in models:
        budgets = nano.budgets
        if model == MATCHED:  # it has the tokens of the current frame, at any budget
            budgets = (None,)
        for budget in budgets:
            each = compose_model(model, budget=budget)
            row = model
            if budget is not None and each["memory"] is not None:
                row = f"{model}@{budget}"
            composed[row] = each
    others = [compose_model(model) for model in nano.rendered_for if model not in models]
    robot = Embodiment.from_dict(next(iter(composed.values()))["embodiment"])
    for each in composed.values():
        vision = each["backbone"].get("vision")
        layout = vision.get("layout") if isinstance(vision, Mapping) else None
        check_reflection(nano.learning["reflect"], robot.action, layout)
    choices = [FrameChoice(DECISIONS, None, robot.action.execute)]
    for each in (*composed.values(), *others):
        if each["memory"]:
            choices.append(FrameChoice(DECISIONS, each["memory"], robot.action.execute))
    blind = None
    for row, each in composed.items():
        if blind is None and each["memory"] is None and not each["subgoal_text"]:
            blind = row
    return Rows(composed, choices, robot, blind)


def trainings_of(
    nano: NanoRun,
    composed: Mapping[str, Mapping[str, Any]],
    folder: Path,
    files: Sequence[Path],
    store: Any,
) -> dict[str, list[Training]]:
    """Row → its trainings, with consecutive seeds."""
    jobs: dict[str, list[Training]] = {}
    for row, each in composed.items():
        trainings = nano.also_trainings if nano.is_further(row) else nano.trainings
        jobs[row] = []
        for seed in range(nano.seed, nano.seed + trainings):
            job = Training(
                row,
                seed,
                {**each, "seed": seed},
                nano.train,
                nano.learning,
                folder / row / str(seed),
                files,
                store,
                nano.seed,
            )
            jobs[row].append(job)
    return jobs


def evaluate_all(
    nano: NanoRun,
    folder: Path,
    jobs: Mapping[str, Sequence[Training]],
    files: Sequence[Path],
    robot: Embodiment,
) -> dict[str, list[EpisodeRecord]]:
    """Row → the records of all its trainings; a row's folder is
    `<folder>/<row>/<training seed>`.
    """
    rules = rules_of(nano)
    specs = episodes_of(nano, folder, nano.episodes)
    further = specs
    if nano.also and nano.also_episodes is not None:
        further = episodes_of(nano, folder, nano.also_episodes)
    records: dict[str, list[EpisodeRecord]] = {}
    for row, of_row in jobs.items():
        selected = further if nano.is_further(row) else specs
        names = [row]
        model, at, budget = row.partition("@")
        if model == nano.oracle:
            names.append(f"{ORACLE_FRAMES}{at}{budget}")
        for name in names:
            ceiling = None if name == row else name
            records[name] = []
            for job in of_row:
                place = folder / name / str(job.seed)
                records[name] += evaluate_row(
                    job.folder, job.checkpoint, place, selected, rules, ceiling
                )
    if nano.shard is not None:
        return records

    # The rows that nothing was trained for
    by_choice = bool(robot.action.choice)
    untrained = []
    if nano.planner:
        untrained.append(DEMONSTRATOR if by_choice else PLANNER)
    if nano.floors:
        untrained += [RANDOM, FREQUENT]
    moves = frequent_moves(files, robot.action) if by_choice else {}
    for name in untrained:
        records[name] = play_all(name, folder / name / "0", specs, rules, moves)
    return records


def rules_of(nano: NanoRun) -> "Rules":
    """How the run's episodes are run."""
    return Rules(
        seed=nano.policy_seed,
        split=nano.split,
        max_steps=nano.max_steps,
        max_choices=nano.max_choices,
        only_possible=nano.only_possible,
        workers=nano.workers,
        shard=nano.shard,
    )


def episodes_of(nano: NanoRun, folder: Path, episodes: Any) -> list[EpisodeSpec]:
    """Those episodes of the split; with `replace` scenes that cannot be built are replaced by later
    ones.
    """
    if not nano.replace:
        return choose_episodes(nano.task, episodes, nano.split)
    specs, left_out = built_scenes(
        folder / "scenes.json", nano.task, nano.split, episodes, nano.workers
    )
    for line in left_out:
        logger.info("left out: %s", line)
    return specs


# Demonstrations -----------------------------------------------------------------------------------


def counts_of(
    task: Any, demonstrations: Mapping[str, Any], others: Mapping[str, Mapping[str, Any]] | None
) -> dict[tuple[str, str], int]:
    """How many demonstrations of each task and difficulty.

    Args:
        task: the run's tasks.
        demonstrations: difficulty → how many.
        others: of some tasks, other numbers.
    """
    counts: dict[tuple[str, str], int] = {}
    for name in choose_tasks(task):
        amounts = {**demonstrations, **(others or {}).get(name, {})}
        for level, amount in amounts.items():
            require(
                level in DIFFICULTIES and isinstance(amount, int) and amount >= 0,
                f"demonstrations={brief(amounts)}: write how many of each difficulty"
                f" ({', '.join(DIFFICULTIES)}), such as {{easy: 100}}.",
            )
            counts[name, level] = amount
    require(
        sum(counts.values()) >= 2,
        f"demonstrations={brief(demonstrations)}: it takes two, to learn from and to measure by.",
    )
    return counts


def plan_text(counts: Mapping[tuple[str, str], int]) -> str:
    """What is recorded in a line, as the difficulties that a command leaves out keep their numbers.

    >>> plan_text({("StopCube", "easy"): 120, ("StopCube", "hard"): 30})
    '150 demonstrations: 120 easy, 30 hard'
    """
    levels: Counter[str] = Counter()
    for (_, level), amount in counts.items():
        levels[level] += amount
    parts = [f"{levels[level]:,} {level}" for level in DIFFICULTIES if levels[level]]
    return f"{counted(levels.total(), 'demonstration')}: {', '.join(parts)}"


def record_all(
    nano: NanoRun, folder: Path, choices: Sequence[FrameChoice], robot: Embodiment
) -> list[Path]:
    """Demonstrate until there are as many as wanted, each in a file of its own; the files, task by
    task.

    choices: what the memories that will train on them read.
    robot: the one that does.
    """
    groups = []
    counts = counts_of(nano.task, nano.demonstrations, nano.demonstrations_of)
    logger.info(plan_text(counts))
    for (task, level), required in counts.items():
        (folder / task).mkdir(parents=True, exist_ok=True)
        first = nano.first_seed + DIFFICULTIES.index(level) * SEEDS_APART
        scene = Scene(
            task,
            first,
            level,
            folder / task,
            tuple(robot.camera_names),
            tuple(choices),
            nano.carried_out,
            robot.action,
        )
        groups.append(Group(scene, required))
    return demonstrate(groups, nano.workers)


@dataclass
class Group:
    """Scenes of one task and difficulty, of which so many are to be demonstrated.

    scene: the next one to try; seeds follow each other.
    files: of those that are demonstrated.
    failed: scenes in a row that no demonstration succeeded in.
    """

    scene: Scene
    required: int
    files: list[Path] = field(default_factory=list)
    failed: int = 0

    def next(self) -> list[Scene]:
        """The scenes to try now."""
        scenes = []
        for _ in range(min(RETRIES - self.failed, self.required - len(self.files))):
            scenes.append(self.scene)
            self.scene = replace(self.scene, seed=self.scene.seed + 1)
        return scenes

    def take(self, tried: Sequence[Scene]) -> None:
        """Note what came of them."""
        n_before = len(self.files)
        for scene in tried:
            if scene.made:
                self.files.append(scene.path)
            else:
                logger.info("left out: %s, seed %d, %s", scene.task, scene.seed, scene.difficulty)
        self.failed = self.failed + len(tried) if len(self.files) == n_before else 0
        if self.failed >= RETRIES:
            last = tried[-1]
            raise UserError(
                f"{last.task}: {self.failed} {last.difficulty} scenes in a row, to seed"
                f" {last.seed}, cannot be demonstrated."
            )


def demonstrate(groups: Sequence[Group], workers: int = 1) -> list[Path]:
    """The files of the first demonstrations of each group that succeed; existing ones are not made
    again.
    """
    total = sum(group.required for group in groups)
    with progress("record", total, unit="demonstrations") as advance:
        while lacking := [group for group in groups if len(group.files) < group.required]:
            tried = [group.next() for group in lacking]
            missing = []
            n_made = 0
            # In turn, so that an interrupted run has some of every group.
            for scene in chain(*zip_longest(*tried)):
                if scene is None:
                    continue
                if scene.tried:
                    n_made += scene.made
                else:
                    missing.append(scene)
            advance(n_made)
            for made in carry_out(missing, demonstrated, workers):
                advance(int(made))
            for group, scenes in zip(lacking, tried, strict=True):
                group.take(scenes)
    files: list[Path] = []
    for group in groups:
        files += group.files
    return files


class Minutes:
    """Minutes of each stage on the clock, added up over interrupted runs."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @property
    def spent(self) -> dict[str, float]:
        """Stage → minutes; other runs of the command may add to them meanwhile."""
        return read_json(self._path, "minutes of a run") if self._path.is_file() else {}

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Time what happens inside; a stage that had nothing to do counts its moment."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            minutes = (time.perf_counter() - begun) / 60
            spent = self.spent
            write_json(self._path, {**spent, stage: spent.get(stage, 0.0) + minutes})
