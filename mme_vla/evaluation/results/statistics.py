"""How sure a figure is: every interval, test and bootstrap of the results.

All of them hold for three episodes as well as for 800. Rates are shares (0 to 1), not percent.

- A rate: the score interval of Wilson (1927).
- A mean over tasks, or over repeated runs: the same, for an effective number of episodes (the
  design effect of survey statistics: Korn and Graubard 1998).
- A paired difference: the score interval of Tango (1998), at least as wide as the exact interval
  of the sign test (Clopper and Pearson 1934), for an effective number of pairs where tasks have
  unequal numbers (Kish 1965).
- A paired test: the exact sign test and the score test of that difference, the larger p of both.
  Several of them: Holm (1979).
- Several trainings: Student's t with the degrees of freedom of Welch (1938) and Satterthwaite
  (1946), for the variance between episodes and the one between trainings.
- A bootstrap: samples of n − 1 of n episodes (McCarthy and Snowden 1985).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import binomtest, norm, t


class Interval(NamedTuple):
    """A confidence interval."""

    low: float
    high: float

    @property
    def percent(self) -> "Interval":
        """The interval of a share, in percent."""
        return Interval(100 * self.low, 100 * self.high)

    def widen(self, other: "Interval") -> "Interval":
        """The smallest interval that has both in it."""
        return Interval(min(self.low, other.low), max(self.high, other.high))

    def clip(self, low: float, high: float) -> "Interval":
        """The part that a figure between `low` and `high` can have."""
        return Interval(max(self.low, low), min(self.high, high))


# Rates --------------------------------------------------------------------------------------------


def wilson(rate: float, trials: float, confidence: float = 0.95) -> Interval:
    """Wilson's score interval of a rate.

    `scipy.stats.binomtest` has it for counts; here `trials` may be an effective number.
    """
    z = norm.ppf(0.5 + confidence / 2)
    shrink = 1 + z * z / trials
    centre = (rate + z * z / (2 * trials)) / shrink
    half = z / shrink * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    return Interval(float(max(0.0, centre - half)), float(min(1.0, centre + half)))


def mean_over_tasks(tasks: Sequence[np.ndarray]) -> float:
    """The mean over tasks, of each task's mean over its episodes and runs."""
    return float(np.mean([outcomes.mean() for outcomes in tasks]))


def effective_trials(tasks: Sequence[np.ndarray]) -> float:
    """How many independent episodes a mean over tasks is worth: its p(1−p) over its variance.

    Runs of one episode share its scene and are not independent: a task has the variance that the
    differences between its episodes show, and at least that of as many independent trials. It is
    estimated with two episodes more, one solved and one not, since a few equal episodes do not show
    that there is none. The mean is worth at least its episodes: tasks that differ make it less
    uncertain, not more.

    tasks: of each, successes [episodes, runs], every run on the same episodes.
    """
    p = mean_over_tasks(tasks)
    variances = []
    inverse_episodes = []
    for outcomes in tasks:
        n_episodes, n_runs = outcomes.shape
        rates = np.append(outcomes.mean(1), [0, 1])
        independent = rates.mean() * (1 - rates.mean()) / n_runs
        variances.append(max(rates.var(), independent) / n_episodes)
        inverse_episodes.append(1 / n_episodes)
    n_tasks = len(tasks)
    at_least = n_tasks**2 / sum(inverse_episodes)
    return max(at_least, p * (1 - p) * n_tasks**2 / sum(variances))


def mean_interval(tasks: Sequence[np.ndarray], confidence: float = 0.95) -> Interval:
    """Wilson's interval of a mean over tasks, for other episodes of the same tasks.

    tasks: as `effective_trials` takes them.
    """
    return wilson(mean_over_tasks(tasks), effective_trials(tasks), confidence)


# Differences --------------------------------------------------------------------------------------


def paired_interval(gaps: Mapping[str, np.ndarray], confidence: float = 0.95) -> Interval:
    """Interval of a mean over tasks of paired differences.

    The wider of two: Tango's score interval, and the share of unequal pairs times the exact
    interval of how many of them favour the first side. It has 0 in it exactly where `paired_test`
    has p ≥ 1 − confidence. Of no unequal pair nothing is known but that they are rare, which is
    what the first one states.

    gaps: of each task, first side minus second of every pair, −1 … 1. Pairs of several runs have
        fractions, and count as so many pairs of single runs as their smaller spread is worth.
    """
    gained, lost, n_pairs = effective_pairs(gaps)
    score = tango(gained, lost, n_pairs, confidence)
    wins, losses = wins_losses(gaps)
    if not wins + losses:
        return score
    low, high = binomtest(wins, wins + losses).proportion_ci(confidence, "exact")
    share = (gained + lost) / n_pairs
    return score.widen(Interval(share * float(2 * low - 1), share * float(2 * high - 1)))


def effective_pairs(gaps: Mapping[str, np.ndarray]) -> tuple[float, float, float]:
    """The independent pairs of single runs that a mean over tasks is worth: those that only the
    first side solved, those that only the second did, and all.

    A pair of a task with fewer pairs weighs more. n weights w are worth (Σw)² / Σw² equal ones.
    """
    gained = lost = squared_weights = 0.0
    for values in gaps.values():
        weight = 1 / (len(values) * len(gaps))
        gained += weight * float(values[values > 0].sum())
        lost -= weight * float(values[values < 0].sum())
        squared_weights += weight**2 * len(values)
    n_pairs = 1 / squared_weights
    unequal = np.concatenate(list(gaps.values()))
    unequal = unequal[unequal != 0]
    if len(unequal):
        n_pairs *= float(np.abs(unequal).sum() / (unequal**2).sum())
    return gained * n_pairs, lost * n_pairs, n_pairs


def wins_losses(gaps: Mapping[str, np.ndarray]) -> tuple[int, int]:
    """How many pairs favour the first side, and the second."""
    values = np.concatenate(list(gaps.values()))
    return int((values > 0).sum()), int((values < 0).sum())


def tango(gained: float, lost: float, pairs: float, confidence: float = 0.95) -> Interval:
    """Score interval of a paired difference (Tango 1998, Statistics in Medicine 17, 891).

    gained, lost: pairs that only the first side, or only the second, solved.
    """
    z = norm.ppf(0.5 + confidence / 2)
    difference = (gained - lost) / pairs

    def excess(delta: float) -> float:
        """The squared score of a difference of `delta`, minus z², times its variance."""
        # `only_second`: likeliest share of pairs that only the second side solves.
        b = -gained - lost + (2 * pairs - gained + lost) * delta
        c = -lost * delta * (1 - delta)
        only_second = (math.sqrt(max(b * b - 8 * pairs * c, 0.0)) - b) / (4 * pairs)
        variance = pairs * (2 * only_second + delta * (1 - delta))
        return float((gained - lost - pairs * delta) ** 2 - z * z * variance)

    low, high = -1.0, 1.0
    # Effective numbers are rounded: where all pairs favour one side, nothing is left to search.
    if difference - 1e-9 > -1 and excess(-1.0) > 0:
        low = brentq(excess, -1.0, difference - 1e-9)
    if difference + 1e-9 < 1 and excess(1.0) > 0:
        high = brentq(excess, difference + 1e-9, 1.0)
    return Interval(float(low), float(high))


# Trainings ----------------------------------------------------------------------------------------


class Estimate(NamedTuple):
    """A figure that several trainings give, for other episodes of its tasks and other trainings.

    error: its standard error.
    freedom: degrees of freedom of that, effective ones.
    """

    value: float
    error: float
    freedom: float

    def interval(self, confidence: float = 0.95) -> Interval:
        half = self.error * float(t.ppf(0.5 + confidence / 2, self.freedom))
        return Interval(self.value - half, self.value + half)

    @property
    def p(self) -> float:
        """Two-sided p of a value of 0: below 1 − confidence where `interval` has no 0 in it."""
        if not self.error:
            return float(self.value == 0)
        return float(2 * t.sf(abs(self.value) / self.error, self.freedom))


def estimate(methods: Sequence[Sequence[np.ndarray]]) -> Estimate:
    """The sum of methods' means over tasks.

    The variance of a mean of n trainings is that of their means, over n: two trainings that happen
    to be alike count as little evidence, since their variance has one degree of freedom. The
    variance of episodes is that within each task. What cannot be seen (of one training, of one
    episode a task) is left out.

    methods: of each and each task, [episodes, trainings], already averaged over the runs of a
        training; the same episodes for all methods.
    """
    n_tasks = len(methods[0])
    value = 0.0
    parts = []  # variance and degrees of freedom
    for tasks in methods:
        of_trainings = np.mean([values.mean(0) for values in tasks], 0)
        value += float(of_trainings.mean())
        if len(of_trainings) > 1:
            parts.append((of_trainings.var(ddof=1) / len(of_trainings), len(of_trainings) - 1))
    for of_methods in zip(*methods, strict=True):
        episodes = np.sum([values.mean(1) for values in of_methods], 0)
        if len(episodes) > 1:
            parts.append((episodes.var(ddof=1) / len(episodes) / n_tasks**2, len(episodes) - 1))
    variance = float(sum(part for part, _ in parts))
    if not variance:
        return Estimate(value, 0.0, 1.0)
    freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
    return Estimate(value, math.sqrt(variance), float(freedom))


# Tests --------------------------------------------------------------------------------------------


def sign_test(first: int, second: int) -> float:
    """Exact two-sided p that as many of the differing pairs favour one side; on pairs of runs,
    McNemar's test.
    """
    if first + second == 0:
        return 1.0
    return float(binomtest(first, first + second).pvalue)


def paired_test(gaps: Mapping[str, np.ndarray]) -> float:
    """Two-sided p of a mean over tasks of paired differences: the larger of the sign test and the
    score test of the mean; 1 where most pairs favour one side and the mean the other.

    gaps: as `paired_interval` takes them.
    """
    wins, losses = wins_losses(gaps)
    gained, lost, _ = effective_pairs(gaps)
    if (wins - losses) * (gained - lost) <= 0:
        return 1.0
    score = abs(gained - lost) / math.sqrt(gained + lost)
    return max(sign_test(wins, losses), float(2 * norm.sf(score)))


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's correction for several comparisons, in the order given."""
    values = np.asarray(p_values, np.float64)
    order = np.argsort(values)
    factors = np.arange(len(values), 0, -1)
    corrected = np.empty_like(values)
    corrected[order] = np.maximum.accumulate(factors * values[order])
    capped: list[float] = corrected.clip(max=1.0).tolist()
    return capped


# Bootstrap ----------------------------------------------------------------------------------------


def percentiles(values: np.ndarray, confidence: float = 0.95) -> Interval:
    """The interval between two percentiles of resampled values; NaNs, which are not defined in a
    sample, left out.
    """
    tail = (1 - confidence) / 2
    low, high = np.nanquantile(values, [tail, 1 - tail])
    return Interval(float(low), float(high))


def sampled_interval(values: np.ndarray, exact: Interval) -> Interval:
    """`percentiles` of resampled values; where no sample differs, an exact interval.

    Equal outcomes of few episodes give equal samples. They are no certainty.
    """
    interval = percentiles(values)
    if interval.low < interval.high:
        return interval
    return exact


def resampled_means(
    tasks: Mapping[str, Sequence[np.ndarray]], samples: int, seed: int
) -> np.ndarray:
    """Means over tasks of each method [methods, samples], of episodes sampled within each task.

    Means of n − 1 of n episodes have the unbiased variance, those of n the (n − 1) / n of it. One
    episode gives itself.

    tasks: for each task one array of [episodes] a method. An episode is sampled for all methods
        alike.
    """
    rng = np.random.default_rng(seed)
    means: Any = 0
    for values_of_methods in tasks.values():
        n_episodes = len(values_of_methods[0])
        sampled = rng.integers(0, n_episodes, (samples, max(n_episodes - 1, 1)))
        means = means + np.stack([values[sampled].mean(1) for values in values_of_methods])
    return means / len(tasks)
