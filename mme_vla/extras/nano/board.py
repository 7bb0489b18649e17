"""The board of nanoMME: rows in the order of their success, and what the differences between them
are worth.

Scenes are the same for all rows. Means are over tasks. Intervals come from a bootstrap over scenes,
with the noise between trainings that the rows show together. P values are of the trained policies,
on these scenes.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise
from math import factorial, prod
from typing import Literal

import numpy as np

from mme_vla.errors import require
from mme_vla.evaluation.results import paper
from mme_vla.evaluation.results.aggregate import Figure, Method, aggregate
from mme_vla.evaluation.results.compare import (
    Comparison,
    compare,
    compare_all,
    pair_methods,
)
from mme_vla.evaluation.results.paper import PaperMethod
from mme_vla.evaluation.results.scopes import PAPER_ORDER, Protocol, scopes
from mme_vla.evaluation.results.statistics import (
    Interval,
    holm,
    percentiles,
    resampled_means,
    sampled_interval,
    wilson,
)
from mme_vla.extras.nano.rows import CHOICES, Trained, Training
from mme_vla.extras.nano.unpaired import compare_unpaired

SAMPLES = 2000
"""Of the bootstrap."""
PERMUTATIONS = 9999
MATCHED = "present_modul"
"""The floor with as many parameters as policies with memory, and tokens of the current
frame alone.
"""


@dataclass(frozen=True, eq=False)
class Row:
    """A row of the board.

    facts: of its first training.
    is_local: whether it is the user's.
    recordings: digests of the data that its trainings learned from.
    """

    name: str
    facts: Trained
    method: Method
    is_local: bool = False
    recordings: frozenset[str] = frozenset()

    @property
    def kind(self) -> str:
        """A `policy` with memory, a `floor` or a `ceiling`, as one is that reads the simulator's
        subgoals.
        """
        subgoal = self.method.key.subgoal
        if subgoal == "oracle":
            return "ceiling"
        if self.facts.trained and self.facts.budget is None and subgoal is None:
            return "floor"  # it has no memory
        if self.name.partition(" ")[0].partition("@")[0] == MATCHED:
            return "floor"
        return self.facts.kind

    @property
    def average(self) -> Figure:
        return self.method.average

    @property
    def budget(self) -> str:
        """The memory tokens in the row's name; empty for the default."""
        return self.name.partition(" ")[0].partition("@")[2]

    @property
    def paper(self) -> PaperMethod | None:
        """The published method that the row is, at its default budget."""
        if self.budget:
            return None
        known = paper.paper_method(self.name, self.method.key.subgoal)
        reported = [line["method"] for line in paper.paper_table("suites")]
        return known if known and known.name in reported else None

    def outcomes(self, task: str) -> np.ndarray:
        """Success of a task [scenes, trainings], averaged over the noise seeds of a training."""
        trainings = []
        for training in self.method.trainings:
            runs = np.array([run.successes(task) for run in training], np.float64)
            trainings.append(runs.mean(0))
        return np.stack(trainings, 1)

    def mean(self, tasks: Sequence[str]) -> np.ndarray:
        """Success over tasks in percent, of each training."""
        return 100 * np.mean([self.outcomes(task).mean(0) for task in tasks], 0)


@dataclass(frozen=True)
class Separation:
    """Whether memories differ on a task at a budget; success in percent.

    memories: how many.
    lowest, mean, highest: of their success.
    deviation: standard one between memories, less what trainings add.
    noise: between trainings of one memory, None with one training each.
    floor, ceiling: of the best floor and of the best ceiling.
    p: of `homogeneity` of all policies.
    repeated: how many memories have several trainings.
    p_repeated: of these over trainings, None where they are too few for a p below 0.05. Both are
        corrected by Holm over the tasks of the budget.
    """

    budget: str
    task: str
    memories: int
    lowest: float
    mean: float
    highest: float
    deviation: float
    noise: float | None
    floor: float | None
    ceiling: float | None
    p: float
    repeated: int
    p_repeated: float | None


@dataclass(frozen=True)
class Agreement:
    """Rank correlations of so many methods with the published ranking, over the tasks
    of a scope.
    """

    scope: str
    methods: int
    spearman: float
    spearman_interval: Interval
    kendall: float
    kendall_interval: Interval


@dataclass(frozen=True)
class Target:
    """A number that the benchmark aims at. reached: None where a row of it was not run."""

    name: str
    measured: str = "not run yet"
    interval: str = ""
    test: str = ""
    reached: bool | None = None


class Board:
    """All rows, best first."""

    def __init__(self, rows: Mapping[str, Sequence[Training]], samples: int = SAMPLES) -> None:
        """Make the figures. rows: as `read_rows` gives them."""
        require(rows, "There are no rows: train one with model=…, or name folders with rows=….")
        first = next(iter(rows.values()))[0]  # the scenes of all rows are the same
        counts = Counter(key.task for key in first.scenes)
        # In the paper's order; other tasks behind, in that of the records
        tasks = [task for task in PAPER_ORDER if task in counts]
        tasks += [task for task in counts if task not in PAPER_ORDER]
        amounts = set(counts.values())
        require(
            len(amounts) == 1,
            f"Tasks have {sorted(amounts)} scenes: a board has as many of each task.",
        )
        self.protocol = Protocol(tuple(tasks), amounts.pop())
        self.samples = samples
        self.split = first.records[0].split
        self.action_space = first.action_space
        made = [_row(name, trainings, self.protocol) for name, trainings in rows.items()]
        self.rows = sorted(made, key=lambda row: -self.success(row))

    def of_kind(self, kind: str) -> list[Row]:
        """The rows that are a `policy`, a `floor` or a `ceiling`."""
        return [row for row in self.rows if row.kind == kind]

    @property
    def ranked(self) -> list[Row]:
        """The rows that have a place: all but ceilings."""
        return [row for row in self.rows if row.kind != "ceiling"]

    def success(self, row: Row, tasks: Sequence[str] = ()) -> float:
        """A row's success over tasks, by default all, in percent."""
        # equal counts, equal figures
        return round(float(row.mean(tasks or self.protocol.tasks).mean()), 9)

    def noise(self, tasks: Sequence[str] = ()) -> float | None:
        """Standard deviation of success between trainings of one row, over all rows; None where
        none has two.
        """
        return pooled([row.mean(tasks or self.protocol.tasks) for row in self.rows])

    def draws(self, rows: Sequence[Row], tasks: Sequence[str]) -> np.ndarray:
        """Bootstrap of the rows' success over tasks [rows, samples], in percent, on the same scenes
        for all.

        The mean of n trainings has normal noise of 1/√n of the deviation between trainings: of all
        rows, or the row's own where that is larger, without the variance of single episodes, which
        the sampled scenes have already.
        """
        values: dict[str, list[np.ndarray]] = {}
        for task in tasks:
            values[task] = [row.outcomes(task).mean(1) for row in rows]
        means = 100 * resampled_means(values, self.samples, seed=0)
        rng = np.random.default_rng([0, 2])
        shared = self._training_deviation(self.rows, tasks)
        for row, sampled in zip(rows, means, strict=True):
            if row.facts.trained:
                deviation = max(shared, self._training_deviation([row], tasks))
                sampled += rng.normal(0, deviation / len(row.method.trainings) ** 0.5, len(sampled))
        return means.clip(0, 100).round(9)

    def _training_deviation(self, rows: Sequence[Row], tasks: Sequence[str]) -> float:
        """Deviation of success between trainings of one row, without the variance of single
        episodes.
        """
        success: list[np.ndarray] = []
        variances: list[float] = []
        degrees: list[int] = []
        for row in rows:
            n_trainings = len(row.method.trainings)
            if n_trainings > 1:
                success.append(row.mean(tasks))
                variances.append(sum(row.outcomes(task).var(1, ddof=1).sum() for task in tasks))
                degrees.append(n_trainings - 1)
        if not success:
            return 0.0
        noise = pooled(success) or 0.0
        # The variance of single episodes, in points of the mean over tasks and episodes
        points = 100 / len(tasks) / self.protocol.episodes
        of_episodes = np.average(variances, weights=degrees) * points**2
        return float(max(0.0, noise**2 - of_episodes) ** 0.5)

    @cached_property
    def sampled(self) -> dict[str, np.ndarray]:
        """`draws` over all tasks by row."""
        draws = self.draws(self.rows, self.protocol.tasks)
        return {row.name: sampled for row, sampled in zip(self.rows, draws, strict=True)}

    def interval(self, row: Row) -> Interval:
        """Of a row's success over all tasks, in percent; Wilson's where no draw differs."""
        scenes = len(self.protocol.tasks) * self.protocol.episodes
        exact = wilson(self.success(row) / 100, scenes).percent
        return sampled_interval(self.sampled[row.name], exact)

    @cached_property
    def places(self) -> dict[str, tuple[int, Interval]]:
        """Place of each ranked row, equal rows sharing the better one, and an interval of it
        (`draws`).
        """
        means = np.array([self.success(row) for row in self.ranked])
        draws = np.array([self.sampled[row.name] for row in self.ranked])
        places = {}
        for row, mean, sampled in zip(self.ranked, means, draws, strict=True):
            place = 1 + int((means > mean).sum())
            places[row.name] = (place, percentiles(1 + (draws > sampled).sum(0)))
        return places

    def neighbours(self) -> list[Comparison]:
        """Each row and the next; of a user's rows, with those beside them, the best and the trained
        floors.

        P values are corrected for the number of these comparisons. Intervals are of `draws`.
        """
        ranked = self.ranked
        pairs = list(pairwise(ranked))
        local = [row for row in ranked if row.is_local]
        if local:
            pairs = [pair for pair in pairs if pair[0].is_local or pair[1].is_local]
            floors = [row for row in ranked if row.kind == "floor" and row.facts.trained]
            for row in local:
                pairs += [(other, row) for other in (ranked[0], *floors) if other is not row]
        unique = {}
        for first, second in pairs:
            unique[frozenset((first.name, second.name))] = (first, second)
        return self._compared(list(unique.values()))

    def variants(self, part: Literal["memory", "integration"]) -> list[Comparison]:
        """Pairs of `<memory>_<integration>` at the default budget that differ in this part alone.

        Of memories with several integrations. P values and intervals as in `neighbours`.
        """
        rows = [row for row in self.of_kind("policy") if not row.budget and not row.is_local]
        parts = {row.name: row.name.rpartition("_")[::2] for row in rows}
        count = Counter(memory for memory, _ in parts.values())
        several = []
        for row in rows:
            memory, _ = parts[row.name]
            if memory and count[memory] > 1:
                several.append(row)
        varied = ("memory", "integration").index(part)
        several.sort(key=lambda row: parts[row.name][1 - varied])
        pairs = []
        for first, second in combinations(several, 2):
            mine, other = parts[first.name], parts[second.name]
            if mine[varied] != other[varied] and mine[1 - varied] == other[1 - varied]:
                pairs.append((first, second))
        return self._compared(pairs)

    def _compared(self, pairs: Sequence[tuple[Row, Row]]) -> list[Comparison]:
        methods = [(first.method, second.method) for first, second in pairs]
        comparisons = []
        for comparison in compare_all(methods, self.protocol, _compare):
            difference = self.sampled[comparison.first] - self.sampled[comparison.second]
            interval = sampled_interval(difference, comparison.interval)
            comparisons.append(replace(comparison, interval=interval))
        return comparisons

    @cached_property
    def apart(self) -> list[Row]:
        """The rows whose scenes are not known to be those of the board's own rows: compared by
        score, unpaired.
        """
        reference = next((row for row in self.rows if not row.is_local), self.rows[0])
        return [row for row in self.rows if pair_methods(row.method, reference.method).left_out]

    @cached_property
    def separations(self) -> list[Separation]:
        """Of each budget that several memories have, and each task."""
        separations: list[Separation] = []
        # Outcomes change places within a scene, so all must be of the same one.
        policies = [row for row in self.of_kind("policy") if row not in self.apart]
        budgets = {row.budget for row in self.rows}
        for budget in sorted(budgets, key=lambda budget: (len(budget), budget)):
            rows = [row for row in policies if row.budget == budget]
            if len(rows) < 2:
                continue
            tested = [self._separation(budget, task, rows) for task in self.protocol.tasks]
            over_policies = holm([separation.p for separation in tested])
            # Whether trainings are enough for a test is the same for all tasks.
            p_trainings = [s.p_repeated for s in tested if s.p_repeated is not None]
            over_trainings: Sequence[float | None] = [None] * len(tested)
            if p_trainings:
                over_trainings = holm(p_trainings)
            corrected = zip(tested, over_policies, over_trainings, strict=True)
            for separation, p, p_repeated in corrected:
                separations.append(replace(separation, p=p, p_repeated=p_repeated))
        return separations

    def _best(self, kind: str, task: str) -> float | None:
        """Success of the best row of a kind on a task, in percent; None where there is none."""
        return max((self.success(row, [task]) for row in self.of_kind(kind)), default=None)

    def _separation(self, budget: str, task: str, rows: Sequence[Row]) -> Separation:
        success: list[np.ndarray] = []  # of each memory, that of its trainings in percent
        outcomes: list[np.ndarray] = []  # of each memory, [scenes, trainings]
        for row in rows:
            success.append(row.mean([task]))
            outcomes.append(row.outcomes(task))
        means = np.array([of_row.mean() for of_row in success])
        n_trainings = np.array([len(of_row) for of_row in success])
        # Of the variance between memories, trainings add 1/n of that between trainings.
        noise = pooled(success)
        variance = means.var(ddof=1) - (noise or 0) ** 2 * np.mean(1 / n_trainings)
        repeated = [of_row for of_row in outcomes if of_row.shape[1] > 1]
        smallest = smallest_p(n_trainings[n_trainings > 1].tolist())
        p_repeated = None
        if smallest * len(self.protocol.tasks) < 0.05:
            p_repeated = homogeneity(repeated, over_trainings=True)
        return Separation(
            budget,
            task,
            len(rows),
            float(means.min()),
            float(means.mean()),
            float(means.max()),
            float(max(0, variance)) ** 0.5,
            noise,
            self._best("floor", task),
            self._best("ceiling", task),
            homogeneity(outcomes),
            len(repeated),
            p_repeated,
        )

    @property
    def published(self) -> list[tuple[Row, PaperMethod]]:
        """The rows that the paper reports, its best first; none on a board of other tasks."""
        if not set(self.protocol.tasks) <= set(PAPER_ORDER):
            return []
        known = []
        for row in self.rows:
            method = row.paper
            if method is not None:
                known.append((row, method))
        return sorted(known, key=lambda pair: -published_success(pair[1], PAPER_ORDER))

    def agreements(self) -> list[Agreement]:
        """Rank correlations with the published success over all tasks, of memories alone, by suite
        and by task.

        Scopes with fewer than three rows, or where all are equal, are left out. Intervals are of
        `draws`. Published figures are fixed.
        """
        memories = [(row, method) for row, method in self.published if row.kind == "policy"]
        compared = []
        for kind in ("average", "suite", "task"):
            for scope in scopes(self.protocol):
                if scope.kind == kind:
                    compared.append((scope.name, scope.tasks, self.published))
        compared.insert(1, ("average, memories alone", self.protocol.tasks, memories))
        made = []
        for name, tasks, pairs in compared:
            if len(pairs) < 3:
                continue
            means = np.array([self.success(row, tasks) for row, _ in pairs])
            reported = np.array([published_success(method, tasks) for _, method in pairs])
            if np.ptp(means) and np.ptp(reported):
                draws = self.draws([row for row, _ in pairs], tasks).T
                agreement = Agreement(
                    name,
                    len(pairs),
                    float(spearman(means, reported)),
                    percentiles(spearman(draws, reported)),
                    float(kendall(means, reported)),
                    percentiles(kendall(draws, reported)),
                )
                made.append(agreement)
        return made

    def targets(self) -> list[Target]:
        """What the best policy is to reach by choices, and its advantage over the floor of as many
        parameters.
        """
        if self.action_space != CHOICES:
            return []
        first = Target("best memory solves at least 60 % of all episodes")
        second = Target(f"{MATCHED} solves at most half of that")
        policies = self.of_kind("policy")
        if not policies:
            return [first, second]

        best = policies[0]
        success = self.success(best)
        low, high = self.interval(best)
        first = replace(
            first,
            measured=f"{success:.1f} % ({best.name})",
            interval=f"[{low:.1f}, {high:.1f}]",
            reached=success >= 60,
        )
        matched = next((row for row in self.rows if row.name == MATCHED), None)
        if matched is None or not success:
            return [first, second]

        share = self.success(matched) / success
        low, high = percentiles(self.sampled[MATCHED] / self.sampled[best.name])
        second = replace(
            second,
            measured=f"{100 * share:.0f} % of it",
            interval=f"[{100 * low:.0f}, {100 * high:.0f}]",
            reached=share <= 0.5,
        )

        # The advantage in each suite, corrected for their number
        comparisons: list[Comparison] = []
        intervals: list[Interval] = []
        for suite in self.protocol.suites:
            tasks = tuple(self.protocol.choose("suite", suite))
            protocol = replace(self.protocol, tasks=tasks)
            comparisons.append(_compare(best.method, matched.method, protocol))
            of_best, of_matched = self.draws([best, matched], tasks)
            intervals.append(percentiles(of_best - of_matched))
        corrected = holm([comparison.p for comparison in comparisons])
        targets = [first, second]
        rows = zip(self.protocol.suites, comparisons, intervals, corrected, strict=True)
        for suite, comparison, (low, high), p in rows:
            advantage = Target(
                f"significant advantage in {suite}",
                f"{comparison.difference:+.1f} points",
                f"[{low:+.1f}, {high:+.1f}]",
                f"{comparison.better_worse}, p = {p:.4f}",
                reached=p < 0.05 and low > 0,
            )
            targets.append(advantage)
        return targets


def _row(name: str, trainings: Sequence[Training], protocol: Protocol) -> Row:
    # of all: in a row other data are another recording, not another method
    data = trainings[0].facts.data
    records = []
    for training in trainings:
        for record in training.records:
            identity = record.training and replace(record.training, data=data)
            records.append(replace(record, training=identity))
    methods = aggregate(records, protocol).methods
    require(
        len(methods) == 1,
        f"The row {name} holds {len(methods)} methods: {', '.join(m.label for m in methods)}.",
    )
    methods[0].label = name
    recordings = frozenset(training.facts.data for training in trainings if training.facts.data)
    return Row(name, trainings[0].facts, methods[0], trainings[0].is_local, recordings)


def published_success(method: PaperMethod, tasks: Sequence[str]) -> float:
    """A method's published success over tasks, in percent."""
    return float(np.mean([paper.per_task(method.name)[task].mean for task in tasks]))


def pooled(groups: Sequence[np.ndarray]) -> float | None:
    """Standard deviation within groups; None where none has two values."""
    degrees = sum(len(group) - 1 for group in groups)
    squares = sum(float(((group - group.mean()) ** 2).sum()) for group in groups)
    return (squares / degrees) ** 0.5 if degrees else None


def smallest_p(sizes: Sequence[int]) -> float:
    """The smallest p that memories of so many trainings can have: 1 / the number of ways to deal
    out the trainings.
    """
    # memories of as many trainings may change places
    alike = [factorial(count) for count in Counter(sizes).values()]
    return prod(map(factorial, sizes)) * prod(alike) / factorial(sum(sizes))


def _compare(first: Method, second: Method, protocol: Protocol) -> Comparison:
    """Of the trained policies: scene by scene where all scenes are the same, else by score."""
    if pair_methods(first, second).left_out:
        return compare_unpaired(first, second, protocol)
    return compare(first, second, protocol, over_trainings=False)


def homogeneity(
    groups: Sequence[np.ndarray],
    permutations: int = PERMUTATIONS,
    seed: int = 0,
    over_trainings: bool = False,
) -> float:
    """P that memories which do not differ would differ as much: a permutation test of the variance
    between them.

    groups: of each memory, outcomes [scenes, trainings].
    over_trainings: trainings change places between memories: they are what another training would
        change. Otherwise outcomes do within each scene, which tests these policies alone.
    """
    outcomes = np.concatenate(groups, 1)  # scenes × trainings of all memories
    sizes = [group.shape[1] for group in groups]
    starts = np.cumsum([0, *sizes[:-1]])
    rng = np.random.default_rng(seed)

    def variance(means: np.ndarray) -> np.ndarray:
        """Of the memories' means, from trainings' means [..., trainings]."""
        return (np.add.reduceat(means, starts, -1) ** 2 / sizes).sum(-1)

    if over_trainings:
        permuted = rng.permuted(np.tile(outcomes.mean(0), (permutations, 1)), axis=1)
    else:
        permuted = np.zeros((permutations, outcomes.shape[1]))
        for scene in outcomes:
            permuted += rng.permuted(np.tile(scene, (permutations, 1)), axis=1) / len(outcomes)
    return float(
        (1 + (variance(permuted) >= variance(outcomes.mean(0)) - 1e-12).sum()) / (1 + permutations)
    )


def spearman(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Spearman's rank correlation of each row of values [..., n] with reference [n]; NaN where all
    are equal.
    """
    from scipy.stats import rankdata

    first = rankdata(values, axis=-1)
    first -= first.mean(-1, keepdims=True)
    second = rankdata(reference)
    second -= second.mean()
    return _ratio((first * second).sum(-1), (first**2).sum(-1) * (second**2).sum())


def kendall(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Kendall's tau-b of each row of values [..., n] with reference [n]; NaN where all
    are equal.
    """
    first = np.sign(values[..., :, None] - values[..., None, :])
    second = np.sign(reference[:, None] - reference[None, :])
    return _ratio((first * second).sum((-1, -2)), (first**2).sum((-1, -2)) * (second**2).sum())


def _ratio(product: np.ndarray, squares: np.ndarray) -> np.ndarray:
    return np.divide(
        product, np.sqrt(squares), out=np.full(np.shape(product), np.nan), where=squares > 0
    )
