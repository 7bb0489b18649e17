"""The bootstrap of report cards and of nanoMME's board: intervals of resampled values."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mme_vla.evaluation.results.statistics import Interval


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
    """Means over tasks of each method [methods, samples], of episodes sampled within each task
    (Efron and Tibshirani 1993).

    tasks: for each task one array of [episodes] a method. An episode is sampled for all methods
        alike.
    """
    rng = np.random.default_rng(seed)
    means: Any = 0
    for values_of_methods in tasks.values():
        n_episodes = len(values_of_methods[0])
        sampled = rng.integers(0, n_episodes, (samples, n_episodes))
        means = means + np.stack([values[sampled].mean(1) for values in values_of_methods])
    return means / len(tasks)
