"""From episode records to the figures of the tables: means over runs, deviations, intervals.

Nothing incomplete is averaged: a run enters a figure only if it has every episode the figure is
about, and a figure says how many of its episodes there are.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pandas as pd

from mme_vla.config.naming import DEFAULT_BUDGET
from mme_vla.envs.base import CHOICES
from mme_vla.envs.make import ROBOMME
from mme_vla.envs.metadata import BASE, base_of
from mme_vla.envs.rows import DIFFICULTIES
from mme_vla.errors import UserError, counted, did_you_mean, require
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import (
    EpisodeKey,
    EpisodeRecord,
    RunKey,
    check_settings,
    count_outcomes,
    merge,
)
from mme_vla.evaluation.results import paper
from mme_vla.evaluation.results.baselines import is_standing, missing_baselines
from mme_vla.evaluation.results.paper import PaperMethod, PaperResult
from mme_vla.evaluation.results.scopes import (
    MAX_STEPS,
    PAPER_ORDER,
    TASK_FACTS,
    Protocol,
    Scope,
    groupings_of,
    scopes,
    suites_of,
    tasks_of,
)
from mme_vla.evaluation.results.statistics import Interval, estimate, mean_interval
from mme_vla.policy.training_identity import TrainingIdentity, without_seed


def record_table(records: Sequence[EpisodeRecord]) -> pd.DataFrame:
    """The records as one table, a row each, in their order.

    Columns: `run`, `task`, `episode`, `difficulty`, `outcome`, `success` (0 or 1), and `record`,
    the record itself. Figures, comparisons and curves are made of it by grouping.
    """
    rows = []
    for r in records:
        rows.append((r.run, r.task, r.episode, r.difficulty, r.outcome, float(r.success), r))
    columns = ["run", "task", "episode", "difficulty", "outcome", "success", "record"]
    return pd.DataFrame(rows, columns=columns)


@dataclass(frozen=True)
class Figure:
    """One number of a table, in percent.

    mean, std: over the complete trainings, or over the complete runs of one; None without one
        (`std` needs two).
    interval: over episodes, and over trainings where there are several.
    runs, complete: runs there are, and those that have every episode of this figure.
    done, expected: episodes of all runs.
    partial: rate of the episodes that are done, if no run is complete.
    paper: what the paper reports here.
    full: whether the protocol has all episodes of the tasks here, not only some.
    """

    mean: float | None
    std: float | None
    interval: Interval | None
    runs: int
    complete: int
    done: int
    expected: int
    partial: float | None = None
    paper: PaperResult | None = None
    full: bool = True

    @property
    def value(self) -> float | None:
        """The mean, or the rate of the episodes that are done."""
        return self.partial if self.mean is None else self.mean

    @property
    def is_pale(self) -> bool:
        """Whether episodes are missing, so that the value says little of all of them."""
        return self.mean is None or not self.full


@dataclass
class Run:
    """One pass over the benchmark."""

    key: RunKey
    records: dict[EpisodeKey, EpisodeRecord]
    protocol: Protocol

    @property
    def episodes(self) -> dict[EpisodeKey, list[EpisodeRecord]]:
        """The records in order, as `pair` takes them."""
        return {key: [record] for key, record in sorted(self.records.items())}

    @property
    def averaged(self) -> list[EpisodeRecord]:
        """The records that the average is over."""
        tasks = self.protocol.averaged
        return [record for key, record in self.records.items() if key.task in tasks]

    @property
    def expected(self) -> int:
        return self.protocol.count(self.protocol.averaged)

    @property
    def complete(self) -> bool:
        return len(self.averaged) == self.expected

    @property
    def outcomes(self) -> dict[str, int]:
        return dict(count_outcomes(self.averaged))

    def successes(self, task: str) -> list[bool] | None:
        """Outcomes of a task's episodes in order, or None if some are missing."""
        outcomes = []
        for episode in self.protocol.numbers_of(task):
            record = self.records.get(EpisodeKey(task, episode))
            if record is None:
                return None
            outcomes.append(record.success)
        return outcomes


@dataclass
class Method:
    """All runs of one model by one recipe, with the figures of every scope in
    `figures[kind][name]`.

    label: the key's, unless that is of several methods.
    key: what its runs share (`_method_key`).
    table: its part of `record_table`.
    repeated, flipped: see `Comparison`.
    """

    label: str
    key: RunKey
    runs: list[Run]
    table: pd.DataFrame
    paper: PaperMethod | None
    figures: dict[str, dict[str, Figure]] = field(default_factory=dict)
    repeated: int = 0
    flipped: int = 0

    @property
    def average(self) -> Figure:
        return self.figures["average"]["average"]

    @property
    def trainings(self) -> list[list[Run]]:
        """The runs of each training; all in one group where records do not name their training."""
        return by_training(self.runs)

    @cached_property
    def success(self) -> pd.DataFrame:
        """Success of every episode, a column for each of `runs` by its number: 1, 0, or NaN where
        the run lacks the episode. The index is (task, episode), in order.
        """
        numbers = {run.key: number for number, run in enumerate(self.runs)}
        table = self.table.assign(number=[numbers[run] for run in self.table["run"]])
        return table.pivot(index=["task", "episode"], columns="number", values="success")

    @property
    def rates(self) -> pd.DataFrame:
        """Of every episode that all runs have: the share of each training's runs that solved it."""
        return over_trainings(self.success.dropna(), self.runs)


def over_trainings(success: pd.DataFrame, runs: Sequence[Run]) -> pd.DataFrame:
    """Means over the runs of each training, a column a training.

    success: columns are numbers in `runs`.
    """
    groups = training_numbers(runs)
    return success.T.groupby([groups[number] for number in success.columns]).mean().T


def training_numbers(runs: Sequence[Run]) -> list[int]:
    """The number of each run's training; one number where records do not name their training.

    Checkpoints of one training have weights each, so its seed tells it from others. Trainings of
    one seed have different weights at the same checkpoint, and are told apart by their order there.
    """
    weights: dict[tuple[int | None, int | str], list[str]] = {}
    numbers: dict[tuple[int | None, int], int] = {}
    result = []
    for run in runs:
        training = run.key.training or TrainingIdentity()
        place = 0
        if training.weights is not None:
            of_checkpoint = weights.setdefault((training.seed, run.key.checkpoint), [])
            if training.weights not in of_checkpoint:
                of_checkpoint.append(training.weights)
            place = of_checkpoint.index(training.weights)
        result.append(numbers.setdefault((training.seed, place), len(numbers)))
    return result


def by_training(runs: Sequence[Run]) -> list[list[Run]]:
    """Runs by their training, in their order."""
    groups: dict[int, list[Run]] = {}
    for number, run in zip(training_numbers(runs), runs, strict=True):
        groups.setdefault(number, []).append(run)
    return list(groups.values())


@dataclass
class Results:
    """Everything the tables and the report are made of. notes: what a reader has to know, one
    sentence each.
    """

    methods: list[Method]
    protocol: Protocol
    notes: list[str]

    def method(self, label: str) -> Method:
        """Find a method by its label, or by the name of its model where one method alone has it."""
        for method in self.methods:
            if method.label == label:
                return method
        of_model = [method for method in self.methods if method.key.model == label]
        if len(of_model) == 1:
            return of_model[0]
        raise UserError(
            f"No results of {label!r}. {did_you_mean(label, [m.label for m in self.methods])}"
        )


def aggregate(
    records: Iterable[EpisodeRecord],
    protocol: Protocol | None = None,
    split: str | None = None,
    conflicts: str = "refuse",
) -> Results:
    """Make all figures.

    records: of any number of runs; they are merged here.
    protocol: its tasks are `tasks_of(records)` by default.
    split: only these; needed if there are several.
    conflicts: see `merge`.
    """
    records = list(records)
    protocol = protocol or Protocol(tasks_of(records))
    protocol = replace(
        protocol,
        task_suites={**suites_of(records), **protocol.task_suites},
        groupings={**groupings_of(records), **protocol.groupings},
    )
    merged = merge(records, conflicts)
    splits = sorted({record.split for record in merged})
    require(
        split is not None or len(splits) < 2,
        f"These are results of several splits ({', '.join(splits)}): choose one with --split.",
    )
    included, n_outside = select(merged, protocol, split)
    _check_environments(included)
    check_settings(included)
    table = record_table(included)
    table["method"] = list(map(cache(_method_key), table["run"]))
    by_method = table.groupby("method", sort=False)
    methods = [_method(key, members, protocol) for key, members in by_method]
    methods.sort(key=lambda method: is_standing(method.key.model))  # last in every table
    repeats = repeated_episodes(records)
    for method in methods:
        for run in method.runs:
            repeated, flipped = repeats.get(run.key, (0, 0))
            method.repeated += repeated
            method.flipped += flipped
    notes = _tell_apart(methods)
    notes += _notes(methods, protocol, n_outside)
    return Results(methods, protocol, notes)


def select(
    records: Sequence[EpisodeRecord], protocol: Protocol, split: str | None = None
) -> tuple[list[EpisodeRecord], int]:
    """The records that count, and how many of the split are of other tasks or episodes.

    split: these alone; None for all.
    """
    known = {*PAPER_ORDER, *(record.task for record in records)}
    for task in protocol.tasks:
        if task not in known:
            raise UserError(
                f"RoboMME has no task {task!r}, and no record is of it. {did_you_mean(task, known)}"
            )
    selected = [r for r in records if split in (None, r.split)]
    if not selected:
        splits = sorted({record.split for record in records})
        of_split = f" of split {split!r}" if split else ""
        raise UserError(f"There is no record{of_split}; there are: {splits or 'none'}.")
    inside = [r for r in selected if protocol.expects(r.key)]
    included = inside
    if protocol.errors == "missing":
        included = [r for r in inside if r.outcome != "error"]
    require(
        included or not inside,
        f"All {len(inside)} episodes ended in an error, and errors=missing counts them as not run."
        " The same evaluation command tries them again.",
    )
    there = Protocol.of_records(selected)
    listed = []
    for task in there.tasks:
        numbers = there.numbers_of(task)  # ascending
        text = ",".join(map(str, numbers))
        if len(numbers) > 2 and len(numbers) == numbers[-1] - numbers[0] + 1:
            text = f"{numbers[0]}-{numbers[-1]}"  # as `episodes=` takes them
        listed.append(f"{task} {text}")
    require(
        included,
        f"None of the {len(selected)} records is of the tasks and episodes asked for; they are of"
        f" {'; '.join(listed)}.",
    )
    return included, len(selected) - len(inside)


def _method_key(run: RunKey) -> RunKey:
    """What the runs of one method share: not the checkpoint, the seeds or the split."""
    training = without_seed(run.training)
    # Shipped policies of one recipe, such as two sizes, are two methods.
    checkpoint = run.checkpoint if run.is_shipped else ""
    return run._replace(checkpoint=checkpoint, model_seed=0, split="", training=training)


def repeated_episodes(records: Iterable[EpisodeRecord]) -> dict[RunKey, tuple[int, int]]:
    """Of each run: how many episodes ended twice or more by themselves, and how many of those not
    always alike.

    An episode whose records are not of the same scene was not repeated, nor one whose record was
    copied.
    """
    table = record_table([record for record in records if record.outcome != "error"])
    counts: dict[RunKey, tuple[int, int]] = {}
    for (run, _, _), members in table.groupby(["run", "task", "episode"], sort=False):
        if len(members) < 2:
            continue
        distinct = {record.to_json(): record for record in members["record"]}
        if len(distinct) < 2 or not pair([{0: list(distinct.values())}]).keys:
            continue
        repeated, flipped = counts.get(run, (0, 0))
        flipped += int(members["outcome"].nunique() > 1)
        counts[run] = (repeated + 1, flipped)
    return counts


def _tell_apart(methods: Sequence[Method]) -> list[str]:
    """Give methods of one name but different configurations labels of their own, and say so."""
    kinds = {
        "model": "models",  # of a shipped checkpoint, which goes by the checkpoint's name
        "composition": "configurations",
        "recipe": "recipes of training",
        "data": "datasets",
    }
    notes = []
    counts = Counter(method.label for method in methods)
    for label, count in counts.items():
        if count == 1:
            continue
        same = [method for method in methods if method.label == label]
        rows = []
        for method in same:
            training = method.key.training or TrainingIdentity()
            rows.append((method.key.model, method.key.composition, training.recipe, training.data))
        facts = pd.DataFrame(rows, columns=list(kinds))
        facts = facts.loc[:, facts.nunique(dropna=False) > 1]
        names = list(facts)
        for method, values in zip(same, facts.fillna("unrecorded").to_numpy(), strict=True):
            for name, value in zip(names, values, strict=True):
                if name != "model":  # a digest
                    value = value[:10]
                method.label += f"#{value}"
        if "composition" in names:
            what = kinds["composition"]
        else:
            what = " and ".join(kinds[name] for name in names)
        note = (
            f"{len(same)} different {what} are called {label}; they are not averaged:"
            f" {', '.join(method.label for method in same)} (`{'` and `'.join(names)}` in their"
            " records"
        )
        if facts.isna().any(axis=None):
            note += "; records without it are of an earlier version"
        notes.append(f"{note}).")
    return notes


def _method(key: RunKey, table: pd.DataFrame, protocol: Protocol) -> Method:
    """One method from its part of the table, with its figures."""
    runs = []
    for run, members in table.groupby("run", sort=False):
        records = {record.key: record for record in members["record"]}
        runs.append(Run(run, records, protocol))
    runs.sort(
        key=lambda run: (
            (run.key.training or TrainingIdentity()).seed or 0,
            str(run.key.checkpoint).zfill(12),
            run.key.model_seed,
        )
    )
    known = None
    of_paper = all(r.split == BASE and r.env in (None, ROBOMME) for r in table["record"])
    of_benchmark = any(record.task in TASK_FACTS for record in table["record"])
    is_standard = key.event is None and key.memory_budget in (None, DEFAULT_BUDGET)
    if is_standard and of_benchmark and of_paper:
        known = paper.paper_method(key.model, key.subgoal)
    method = Method(key.label, key, runs, table, known)
    # Every episode that a run is to have, in order; NaN where it lacks it.
    keys = [(task, number) for task in protocol.tasks for number in protocol.numbers_of(task)]
    success = method.success.reindex(pd.MultiIndex.from_tuples(keys, names=["task", "episode"]))
    for scope in scopes(protocol):
        reported = _reported(known, scope)
        figure = _figure(success.loc[list(scope.tasks)], method, protocol)
        figure = replace(figure, paper=reported, full=protocol.has_all(scope.tasks))
        method.figures.setdefault(scope.kind, {})[scope.name] = figure
    # An episode that no run has may be of any difficulty, and keeps the figures incomplete.
    levels = table.groupby(["task", "episode"])["difficulty"].first().reindex(success.index)
    averaged = success.index.get_level_values("task").isin(protocol.averaged)
    for level in DIFFICULTIES:
        if (averaged & (levels == level)).any():
            rows = averaged & (levels.isna() | (levels == level))
            figure = _figure(success[rows], method, protocol)
            figure = replace(figure, full=protocol.has_all(protocol.averaged))
            method.figures.setdefault("difficulty", {})[level] = figure
    return method


def _figure(success: pd.DataFrame, method: Method, protocol: Protocol) -> Figure:
    """A figure from the runs that have all its episodes.

    success: these episodes, as `Method.success` has them.
    """
    done = success.notna()
    complete = success.loc[:, done.all()]
    n_runs = len(success.columns)
    n_complete = len(complete.columns)
    n_done = int(done.to_numpy().sum())
    if not n_complete:
        partial = float(100 * success.stack().mean()) if n_done else None
        return Figure(None, None, None, n_runs, 0, n_done, success.size, partial)
    trainings = over_trainings(complete, method.runs)
    several = len(trainings.columns) > 1
    units = trainings if several else complete
    rates = units.groupby(level="task").mean().mean()
    std = None
    if len(rates) > 1:
        std = float(100 * rates.to_numpy().std(ddof=1))
    of_tasks = list(by_task(units).values())
    interval = mean_interval(of_tasks, protocol.confidence)
    if several:
        trained = estimate([of_tasks]).interval(protocol.confidence)
        interval = interval.widen(trained.clip(0, 1))
    return Figure(
        float(100 * rates.to_numpy().mean()),
        std,
        interval.percent,
        n_runs,
        n_complete,
        n_done,
        success.size,
    )


def by_task(success: pd.DataFrame) -> dict[str, np.ndarray]:
    """The values of each task [episodes, columns], in the order of the tasks."""
    values = {}
    for task, members in success.groupby(level="task", sort=False):
        values[str(task)] = members.to_numpy()
    return values


def _reported(known: PaperMethod | None, scope: Scope) -> PaperResult | None:
    """The paper's number, where it is about the same tasks."""
    if known is None or not TASK_FACTS.keys() >= set(scope.tasks):
        return None
    if scope.kind == "task":
        return paper.per_task(known.name)[scope.name]
    # The benchmark's tasks of this name, which all have to be here
    tasks = set(scope.tasks)
    if scope.kind == "average":
        tasks = set(PAPER_ORDER)
    elif scope.kind in ("suite", "group"):
        tasks = {t.name for t in TASK_FACTS.values() if getattr(t, scope.kind) == scope.name}
    if not tasks <= set(scope.tasks):
        return None
    if scope.kind == "average":
        return paper.average(known.name)
    return paper.mean_over(known.name, scope.tasks)


def _check_environments(records: Sequence[EpisodeRecord]) -> None:
    seeds: dict[EpisodeKey, EpisodeRecord] = {}
    for record in records:
        first = seeds.setdefault(record.key, record)
        require(
            (first.seed, first.difficulty) == (record.seed, record.difficulty),
            f"{record.task} {record.episode} has seed {first.seed} ({first.difficulty}) in"
            f" {first.run}, but {record.seed} ({record.difficulty}) in {record.run}: these are"
            " different benchmarks.",
        )


_SETTINGS = {
    "max_steps": ("Step limits", "Episodes that need more steps fail under the smaller one."),
    "action_space": ("Action spaces", "A task is not equally hard by each."),
    "env": ("Environments", "Episodes of one number may be different ones."),
}
"""Field of records → what it is, and why results that differ in it are not alike."""


def setting_notes(records: Iterable[EpisodeRecord]) -> list[str]:
    """A sentence where a task was run with several step limits, action spaces or environments,
    variants of a split included.
    """
    runs: dict[tuple[str, str, str], dict[Any, RunKey]] = {}
    for record in records:
        for name in _SETTINGS:
            value = getattr(record, name)
            if value is not None:
                of_task = runs.setdefault((name, base_of(record.split), record.task), {})
                of_task.setdefault(value, record.run)
    notes: list[str] = []
    for (name, *_), of_task in runs.items():
        if len(of_task) > 1:
            what, effect = _SETTINGS[name]
            listed = "; ".join(f"{value} in {run}" for value, run in of_task.items())
            notes.append(f"{what} differ: {listed}. {effect}")
    return list(dict.fromkeys(notes))  # tasks of the same settings share one


def _notes(methods: Sequence[Method], protocol: Protocol, outside: int) -> list[str]:
    notes = []
    for method in methods:
        for run in method.runs:
            if not run.complete:
                notes.append(
                    f"Incomplete, not averaged: {run.key} has {len(run.averaged)} of {run.expected}"
                    " episodes."
                )
            errors = run.outcomes["error"]
            if errors:
                notes.append(
                    f"{run.key}: {counted(errors, 'episode')} ended in an error, which counts as a"
                    " failure."
                )
        if method.flipped:
            notes.append(
                f"{method.label}: of {counted(method.repeated, 'episode')} run more than once with"
                f" the same weights and seed, {method.flipped:,} did not always end alike"
                " (deterministic=true repeats runs)."
            )
        limits = {record.max_steps for record in method.table["record"]}
        if method.paper and limits != {MAX_STEPS}:
            limit_text = ", ".join(map(str, sorted(limits)))
            notes.append(
                f"{method.label} ran with a limit of {limit_text} steps; the paper's is"
                f" {MAX_STEPS}."
            )
        if method.paper and any(r.action_space == CHOICES for r in method.table["record"]):
            notes.append(
                f"{method.label} chose among options ({CHOICES}); the paper's policies move the"
                " robot themselves."
            )
        if len(method.runs) > 1:
            same = pair([run.episodes for run in method.runs])
            if same.left_out:
                notes.append(
                    f"{method.label}: its runs are not known to be of the same scenes in"
                    f" {counted(same.left_out, 'episode')}: the scenes differ or only some runs"
                    " name them; its mean is over all of them."
                )
    notes += setting_notes(record for method in methods for record in method.table["record"])
    splits = set()
    for method in methods:
        splits |= {record.split for record in method.table["record"] if record.task in TASK_FACTS}
    for split in sorted(splits - {BASE}):
        notes.append(
            f"Split {split!r}: figures of it are none of the benchmark's, which are of the {BASE}"
            " split's episodes."
        )
    if outside:
        notes.append(
            f"Left out: {counted(outside, 'record')} of other tasks, or of other episodes."
        )
    return notes + missing_baselines(method.key.model for method in methods)
