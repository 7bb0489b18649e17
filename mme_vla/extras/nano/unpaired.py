"""Two methods whose scenes are not known to be the same, compared by score.

The interval is that of Agresti and Caffo (2000).
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import norm

from mme_vla.errors import require
from mme_vla.evaluation.results.aggregate import Method, by_task
from mme_vla.evaluation.results.compare import Comparison, pair_methods
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.statistics import Interval, effective_trials, mean_over_tasks


def compare_unpaired(first: Method, second: Method, protocol: Protocol) -> Comparison:
    """Compare the scores of two methods whose scenes are not known to be the same."""
    # Each scene is worth the mean of its trainings.
    first_scenes = by_task(first.rates.mean(axis=1).to_frame())
    second_scenes = by_task(second.rates.mean(axis=1).to_frame())
    tasks = [task for task in protocol.averaged if task in first_scenes and task in second_scenes]
    require(
        tasks,
        f"{first.label} and {second.label} have no task in common: there is nothing to compare.",
    )
    first_values = [first_scenes[task] for task in tasks]
    second_values = [second_scenes[task] for task in tasks]
    first_rate = 100 * mean_over_tasks(first_values)
    second_rate = 100 * mean_over_tasks(second_values)
    interval, p = unpaired_difference(first_values, second_values, protocol.confidence)
    all_solved = [np.ones_like(values) for values in first_values]
    none_solved = [np.zeros_like(values) for values in second_values]
    _, smallest_p = unpaired_difference(all_solved, none_solved, protocol.confidence)
    pairing = pair_methods(first, second)
    what = f"{first.label} − {second.label}"
    return Comparison(
        first.label,
        second.label,
        min(len(first.rates), len(second.rates)),
        protocol.count(protocol.averaged),
        first_rate,
        second_rate,
        round(first_rate - second_rate, 9),
        interval.percent,
        0,
        0,
        p,
        p,
        p < 1 - protocol.confidence,
        smallest_p,
        smallest_p < 1 - protocol.confidence,
        first.repeated + second.repeated,
        first.flipped + second.flipped,
        paired=False,
        notes=tuple(pairing.notes(what)),
        gaps=tuple(pairing.gaps(what)),
    )


def unpaired_difference(
    first: Sequence[np.ndarray], second: Sequence[np.ndarray], confidence: float = 0.95
) -> tuple[Interval, float]:
    """Interval and p of the difference between two means over the same tasks, of other scenes.

    Each side is counted with two scenes more, one solved and one not (Agresti and Caffo 2000), so
    that few scenes with equal outcomes are no certainty. p is of the normal approximation that the
    interval is of.

    first, second: as `effective_trials` takes them.
    """
    rates = []
    variance = 0.0
    for tasks in (first, second):
        trials = effective_trials(tasks)
        rate = (trials * mean_over_tasks(tasks) + 1) / (trials + 2)
        variance += rate * (1 - rate) / (trials + 2)
        rates.append(rate)
    difference = rates[0] - rates[1]
    deviation = math.sqrt(variance)
    half = float(norm.ppf(0.5 + confidence / 2)) * deviation
    p = float(2 * norm.sf(abs(difference) / deviation))
    return Interval(max(-1.0, difference - half), min(1.0, difference + half)), p
