"""From episode records to the figures of the tables: means over runs, deviations, intervals.

Nothing incomplete is averaged: a run enters a figure only if it has every episode the figure is
about, and a figure says how many of its episodes there are.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from mme_vla.envs.metadata import is_other
from mme_vla.envs.rows import DIFFICULTIES
from mme_vla.errors import UserError, did_you_mean, require
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import (
    EpisodeKey,
    EpisodeRecord,
    RunKey,
    by_run,
    count_outcomes,
    merge,
)
from mme_vla.evaluation.results import paper
from mme_vla.evaluation.results.paper import PaperMethod, PaperResult
from mme_vla.evaluation.results.scopes import (
    MAX_STEPS,
    PAPER_ORDER,
    TASK_FACTS,
    Protocol,
    Scope,
    scopes,
    suites_of,
    tasks_of,
)

Outcomes = np.ndarray  # Successes [episodes, runs]: every run on the same episodes


class Interval(NamedTuple):
    """A confidence interval."""

    low: float
    high: float


def mean_std(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean and sample standard deviation (divisor n − 1), as the released aggregation; one value
    has none.
    """
    array = np.asarray(values, np.float64)
    return float(array.mean()), float(array.std(ddof=1)) if len(array) > 1 else None


def wilson(rate: float, trials: float, confidence: float = 0.95) -> Interval:
    """Wilson's score interval of a proportion; `trials` may be an effective number."""
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    centre = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    half = (
        z
        / (1 + z * z / trials)
        * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    )
    return Interval(max(0.0, centre - half), min(1.0, centre + half))


def effective_trials(outcomes: Outcomes) -> float:
    """How many independent trials the repeats of the same episodes are worth.

    Runs of one episode share its scene, so they are not independent: p(1−p) over the variance of
    the mean that the differences between episodes show, never less than the episodes and never more
    than all trials.
    """
    episodes, runs = outcomes.shape
    p = outcomes.mean()
    if runs == 1 or episodes == 1:
        return float(episodes)
    variance = outcomes.mean(1).var(ddof=1) / episodes
    worth = p * (1 - p) / variance if variance > 0 else (0.0 if p in (0, 1) else math.inf)
    return float(np.clip(worth, episodes, episodes * runs))


def task_interval(outcomes: Outcomes, confidence: float = 0.95) -> Interval:
    """Wilson's interval of one task, for the effective number of trials of all its runs."""
    return wilson(float(outcomes.mean()), effective_trials(outcomes), confidence)


def bootstrap(
    tasks: Mapping[str, Sequence[np.ndarray]],
    confidence: float = 0.95,
    samples: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Percentile interval of a mean over tasks, resampling episodes within each task, and trainings
    for all.

    tasks: see `resampled_means`. The figure of several methods is the sum of theirs.
    """
    return percentiles(resampled_means(tasks, samples, seed).sum(0), confidence)


def percentiles(values: np.ndarray, confidence: float = 0.95) -> Interval:
    """The interval between two percentiles of resampled values; NaNs, which are not defined in a
    sample, left out.
    """
    tail = (1 - confidence) / 2
    low, high = np.nanquantile(values, [tail, 1 - tail])
    return Interval(float(low), float(high))


def resampled_means(
    tasks: Mapping[str, Sequence[np.ndarray]], samples: int, seed: int
) -> np.ndarray:
    """Means over tasks of each method [methods, samples], of episodes sampled within each task, and
    of trainings.

    tasks: for each task one array of [episodes, trainings] a method, already averaged over the runs
    of a training: an episode is sampled with all of them, for all methods alike. Of one training
    none is sampled.
    """
    rng = np.random.default_rng(seed)
    counts = [values.shape[1] for values in next(iter(tasks.values()))]
    one = rng if max(counts) == 1 else np.random.default_rng([seed, 1])
    # How often each training is sampled, as shares: [samples, trainings] a method.
    shares = [
        one.multinomial(n, np.full(n, 1 / n), samples) / n if n > 1 else np.ones((samples, 1))
        for n in counts
    ]
    means = np.zeros((len(counts), samples))
    for of_methods in tasks.values():
        n_episodes = len(of_methods[0])
        sampled = rng.integers(0, n_episodes, (samples, n_episodes))
        for method, (values, share) in enumerate(zip(of_methods, shares, strict=True)):
            means[method] += sum(
                values[:, i][sampled].mean(1) * share[:, i] for i in range(values.shape[1])
            )
    return means / len(tasks)


DEFAULT_BUDGET = 512


@dataclass(frozen=True)
class Figure:
    """One number of a table, in percent.

    mean, std: over the complete trainings, or over the complete runs of one; None without one
    (`std` needs two). interval: over episodes, and over trainings where there are several.
    runs, complete: runs there are, and those that have every episode of this figure.
    done, expected: episodes of all runs. partial: rate of the episodes that are done, if no run is
    complete. paper: what the paper reports here.
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


@dataclass
class Run:
    """One pass over the benchmark."""

    key: RunKey
    records: dict[EpisodeKey, EpisodeRecord]
    protocol: Protocol

    @property
    def averaged(self) -> list[EpisodeRecord]:
        """The records that the average is over."""
        return [
            record for key, record in self.records.items() if key.task in self.protocol.averaged
        ]

    @property
    def expected(self) -> int:
        return len(self.protocol.averaged) * self.protocol.episodes

    @property
    def complete(self) -> bool:
        return len(self.averaged) == self.expected

    @property
    def outcomes(self) -> dict[str, int]:
        return dict(count_outcomes(self.averaged))

    def successes(self, task: str) -> list[bool] | None:
        """Outcomes of a task's episodes in order, or None if some are missing."""
        keys = [EpisodeKey(task, episode) for episode in range(self.protocol.episodes)]
        if any(key not in self.records for key in keys):
            return None
        return [self.records[key].success for key in keys]


@dataclass
class Method:
    """All runs of one model by one recipe, with the figures of every scope in
    `figures[kind][name]`.

    recipe, data: digests of what its trainings share; None where records do not name them.
    event: what happened in the rollouts; None for the plain ones.
    repeated, flipped: see `Comparison`.
    """

    label: str
    model: str
    subgoal: str | None
    memory_budget: int | None
    runs: list[Run]
    paper: PaperMethod | None
    composition: str | None = None
    recipe: str | None = None
    data: str | None = None
    event: str | None = None
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

    @property
    def complete(self) -> bool:
        return all(run.complete for run in self.runs)


def by_training(runs: Iterable[Run]) -> list[list[Run]]:
    """Runs by the seed of their training, in their order; one group where records do not name their
    training.
    """
    groups: dict[int | None, list[Run]] = {}
    for run in runs:
        groups.setdefault(None if run.key.training is None else run.key.training.seed, []).append(
            run
        )
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
        """Find a method."""
        for method in self.methods:
            if method.label == label:
                return method
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

    records: of any number of runs; they are merged here. protocol: its tasks are
    `tasks_of(records)` by default. split: only these; needed if there are several. conflicts: see
    `merge`.
    """
    records = list(records)
    protocol = protocol or Protocol(tasks_of(records))
    protocol = replace(protocol, task_suites={**suites_of(records), **protocol.task_suites})
    merged = merge(records, conflicts)
    known = {*PAPER_ORDER, *(record.task for record in merged)}
    for task in protocol.tasks:
        if task not in known:
            raise UserError(
                f"RoboMME has no task {task!r}, and no record is of it. {did_you_mean(task, known)}"
            )
    splits = sorted({record.split for record in merged})
    if split is None and len(splits) > 1:
        raise UserError(
            f"These are results of several splits ({', '.join(splits)}): choose one with --split."
        )
    selected = [r for r in merged if split in (None, r.split)]
    require(
        selected,
        f"There is no record{f' of split {split!r}' if split else ''}; there are:"
        f" {splits or 'none'}.",
    )
    inside = [r for r in selected if protocol.expects(r.key)]
    counted = [r for r in inside if not (protocol.errors == "missing" and r.outcome == "error")]
    require(
        counted,
        f"None of the {len(selected)} records is of the tasks and episodes asked for (0 …"
        f" {protocol.episodes - 1}).",
    )
    _check_environments(counted)
    groups: dict[tuple[Any, ...], list[Run]] = {}
    for key, members in by_run(counted).items():
        run = Run(key, {record.key: record for record in members}, protocol)
        trained = (None, None) if key.training is None else (key.training.recipe, key.training.data)
        group = key.model, key.subgoal, key.memory_budget, key.composition, *trained, key.event
        groups.setdefault(group, []).append(run)
    methods = [_method(runs, protocol, *group) for group, runs in groups.items()]
    repeats = repeated_episodes(records)
    for method in methods:
        counts = [repeats[run.key] for run in method.runs if run.key in repeats]
        method.repeated, method.flipped = (
            (sum(column) for column in zip(*counts, strict=True)) if counts else (0, 0)
        )
    apart = _tell_apart(methods)
    return Results(
        methods, protocol, [*apart, *_notes(methods, protocol, len(selected) - len(inside))]
    )


def repeated_episodes(records: Iterable[EpisodeRecord]) -> dict[RunKey, tuple[int, int]]:
    """Of each run: how many episodes ended twice or more by themselves, and how many of those not
    always alike.

    An episode whose records are not of the same scene was not repeated.
    """
    episodes: dict[RunKey, dict[EpisodeKey, list[EpisodeRecord]]] = {}
    for record in records:
        if record.outcome != "error":
            episodes.setdefault(record.run, {}).setdefault(record.key, []).append(record)
    counts: dict[RunKey, tuple[int, int]] = {}
    for run, of_run in episodes.items():
        for key in pair([of_run]).keys:
            results = [record.outcome for record in of_run[key]]
            if len(results) > 1:
                repeated, flipped = counts.get(run, (0, 0))
                counts[run] = repeated + 1, flipped + (len(set(results)) > 1)
    return counts


def _tell_apart(methods: Sequence[Method]) -> list[str]:
    """Give methods of one name but different configurations labels of their own, and say so."""
    notes = []
    for label in [
        name for name, count in Counter(method.label for method in methods).items() if count > 1
    ]:
        same = [method for method in methods if method.label == label]
        names = [
            name
            for name in ("composition", "recipe", "data")
            if len({getattr(m, name) for m in same}) > 1
        ]
        for method in same:
            digests = [(getattr(method, name) or "unrecorded")[:10] for name in names]
            method.label = "#".join([label, *digests])
        kinds = {
            "composition": "configurations",
            "recipe": "recipes of training",
            "data": "datasets",
        }
        what = (
            "configurations"
            if "composition" in names
            else " and ".join(kinds[name] for name in names)
        )
        lacking = any(getattr(method, name) is None for method in same for name in names)
        notes.append(
            f"{len(same)} different {what} are called {label}; they are not averaged:"
            f" {', '.join(method.label for method in same)} (the digest of"
            f" `{'` and `'.join(names)}` in their records"
            + ("; records without it are of an earlier version)." if lacking else ").")
        )
    return notes


def _method(
    runs: list[Run],
    protocol: Protocol,
    model: str,
    subgoal: str | None,
    budget: int | None,
    composition: str | None,
    recipe: str | None,
    data: str | None,
    event: str | None,
) -> Method:
    papers = (
        event is None
        and budget in (None, DEFAULT_BUDGET)
        and not any(is_other(run.key.split) for run in runs)
    )
    known = paper.paper_method(model, subgoal) if papers else None
    label = model if subgoal is None else f"{model}+{subgoal}"
    label = label if budget is None else f"{label}@{budget}"
    label = label if event is None else f"{label} · {event}"
    runs = sorted(
        runs, key=lambda run: (_seed(run), str(run.key.checkpoint).zfill(12), run.key.model_seed)
    )
    method = Method(label, model, subgoal, budget, runs, known, composition, recipe, data, event)
    for scope in scopes(protocol):
        reported = _reported(known, scope, protocol)
        figure = _figure(
            runs, scope.tasks, protocol, lambda run, task: run.successes(task), reported
        )
        method.figures.setdefault(scope.kind, {})[scope.name] = figure
    difficulties = {key: record.difficulty for run in runs for key, record in run.records.items()}
    complete_tasks = {
        task for task in protocol.averaged for run in runs if run.successes(task) is not None
    }
    for level in DIFFICULTIES:
        level_tasks = {key.task for key, of in difficulties.items() if of == level} & set(
            protocol.averaged
        )
        # A task without the level is left out; one that is not whole yet may have it, and keeps the
        # figure incomplete.
        tasks = tuple(
            task for task in protocol.averaged if task in level_tasks or task not in complete_tasks
        )
        if level_tasks:
            figure = _figure(runs, tasks, protocol, _of_difficulty(level, difficulties), None)
            method.figures.setdefault("difficulty", {})[level] = figure
    return method


def _seed(run: Run) -> int:
    return 0 if run.key.training is None else run.key.training.seed or 0


def _of_difficulty(
    level: str, difficulties: dict[EpisodeKey, str]
) -> Callable[[Run, str], list[bool] | None]:
    def pick(run: Run, task: str) -> list[bool] | None:
        outcomes = run.successes(task)
        if outcomes is None:
            return None
        return [won for e, won in enumerate(outcomes) if difficulties[EpisodeKey(task, e)] == level]

    return pick


def _figure(
    runs: Sequence[Run],
    tasks: tuple[str, ...],
    protocol: Protocol,
    pick: Callable[[Run, str], list[bool] | None],
    reported: PaperResult | None,
) -> Figure:
    """A figure over whole tasks, from the runs that have all of them."""
    per_run = [[pick(run, task) for task in tasks] for run in runs]
    full = [run for run, of_tasks in zip(runs, per_run, strict=True) if None not in of_tasks]
    complete = [
        [task for task in of_tasks if task is not None]
        for of_tasks in per_run
        if None not in of_tasks
    ]
    done = [record for run in runs for key, record in run.records.items() if key.task in tasks]
    counts = {
        "runs": len(runs), "complete": len(complete), "done": len(done),
        "expected": len(runs) * len(tasks) * protocol.episodes,
    }  # fmt: skip
    if not complete:
        partial = 100 * sum(record.success for record in done) / len(done) if done else None
        return Figure(None, None, None, **counts, partial=partial, paper=reported)
    # episodes × runs
    matrices = [np.array([run[i] for run in complete], np.float64).T for i in range(len(tasks))]
    place = {id(run): number for number, run in enumerate(full)}
    rows = [[place[id(run)] for run in members] for members in by_training(full)]
    # episodes × trainings
    trainings = [np.stack([matrix[:, row].mean(1) for row in rows], 1) for matrix in matrices]
    units = trainings if len(rows) > 1 else matrices
    mean, std = mean_std(
        [float(np.mean([unit[:, r].mean() for unit in units])) for r in range(units[0].shape[1])]
    )
    if len(tasks) == 1 and len(rows) == 1:
        interval = task_interval(matrices[0], protocol.confidence)
    else:
        episodes = {task: [matrix] for task, matrix in zip(tasks, trainings, strict=True)}
        interval = bootstrap(episodes, protocol.confidence, protocol.samples, protocol.seed)
        if interval.low == interval.high:
            # all episodes of a task alike, as with no success at all: nothing to draw
            trials = sum(map(len, trainings))
            interval = wilson(
                float(np.mean([values.mean() for values in trainings])), trials, protocol.confidence
            )
    percent = Interval(100 * interval.low, 100 * interval.high)
    return Figure(100 * mean, None if std is None else 100 * std, percent, **counts, paper=reported)


def _reported(known: PaperMethod | None, scope: Scope, protocol: Protocol) -> PaperResult | None:
    """The paper's number, where it is about the same tasks."""
    if known is None or not TASK_FACTS.keys() >= set(scope.tasks):
        return None
    if scope.kind == "task":
        return paper.per_task(known.name)[scope.name]
    if not set(protocol.tasks) >= set(PAPER_ORDER):
        return None
    if scope.kind == "average":
        return paper.average(known.name)
    return (paper.suite_mean if scope.kind == "suite" else paper.group_mean)(known.name, scope.name)


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
                    f"{run.key}: {errors} episodes ended in an error and count as failures."
                )
        if method.repeated:
            notes.append(
                f"{method.label}: {method.repeated:,} episodes were run more than once with the"
                f" same weights and seed; {method.flipped:,} of them did not always end alike"
                " (deterministic=true repeats runs)."
            )
        limits = {record.max_steps for run in method.runs for record in run.records.values()}
        if method.paper and limits != {MAX_STEPS}:
            limit_text = ", ".join(map(str, sorted(limits)))
            notes.append(
                f"{method.label} ran with a limit of {limit_text} steps; the paper's is"
                f" {MAX_STEPS}."
            )
        if len(method.runs) > 1:
            same = pair(
                [{key: [record] for key, record in run.records.items()} for run in method.runs]
            )
            if same.left_out:
                notes.append(
                    f"{method.label}: its runs are not known to be of the same scenes in"
                    f" {same.left_out} episodes, whose scenes differ or are named in some runs"
                    " only; its mean is over all of them."
                )
    for split in sorted({run.key.split for method in methods for run in method.runs}):
        if is_other(split):
            notes.append(
                f"Split {split!r}: scenes beyond the benchmark's own; figures of it are none of the"
                " benchmark's."
            )
    if outside:
        notes.append(
            f"{outside} records of other tasks, or of episodes from {protocol.episodes} on, are"
            " left out."
        )
    return notes
