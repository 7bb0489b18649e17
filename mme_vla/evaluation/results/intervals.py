"""The statistics of the results: deviations, intervals, paired tests. Rates are fractions."""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

Outcomes = np.ndarray
"""Successes [episodes, runs]: every run on the same episodes."""


class Interval(NamedTuple):
    """A confidence interval."""

    low: float
    high: float


def mean_std(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean and sample standard deviation (divisor n − 1), as the released aggregation; one value has none."""
    if not values:
        raise ValueError("mean_std() needs at least one value.")
    array = np.asarray(values, np.float64)
    return float(array.mean()), float(array.std(ddof=1)) if len(array) > 1 else None


def wilson(rate: float, trials: float, confidence: float = 0.95) -> Interval:
    """Wilson's score interval of a proportion; `trials` may be an effective number."""
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    centre = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    return Interval(max(0.0, centre - half), min(1.0, centre + half))


def effective_trials(outcomes: Outcomes) -> float:
    """How many independent trials the repeats of the same episodes are worth.

    Runs of one episode share its scene, so they are not independent: p(1−p) over the variance of the mean that the
    differences between episodes show, never less than the episodes and never more than all trials.
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
    tasks: Mapping[str, np.ndarray], confidence: float = 0.95, samples: int = 10_000, seed: int = 0
) -> Interval:
    """Percentile interval of a mean over tasks, drawing episodes anew within each task.

    Args:
        tasks: for each task a number per episode [episodes], already averaged over the runs: an episode is drawn with
            all of them.
    """
    rng = np.random.default_rng(seed)
    means = np.zeros(samples)
    for values in tasks.values():
        means += values[rng.integers(0, len(values), (samples, len(values)))].mean(1)
    tail = (1 - confidence) / 2
    low, high = np.quantile(means / len(tasks), [tail, 1 - tail])
    return Interval(float(low), float(high))


def sign_test(first: int, second: int) -> float:
    """Exact two-sided p that as many of the differing pairs favour one side; on pairs of runs, McNemar's test."""
    n = first + second
    tail = sum(math.comb(n, k) for k in range(min(first, second) + 1))
    return min(1.0, 2 * tail / 2**n)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's correction for several comparisons, in the order given."""
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    corrected, highest = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[i]))
        corrected[i] = highest
    return corrected
