"""Two policies on the same scenes: how much better, and could it be chance."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from mme_vla.errors import require
from mme_vla.evaluation.pairing import Pairing, pair
from mme_vla.evaluation.records import EpisodeKey
from mme_vla.evaluation.results.aggregate import Interval, Method, bootstrap
from mme_vla.evaluation.results.scopes import Protocol, scopes


def sign_test(first: int, second: int) -> float:
    """Exact two-sided p that as many of the differing pairs favour one side; on pairs of runs,
    McNemar's test.
    """
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


@dataclass(frozen=True)
class Comparison:
    """`first` minus `second`, in percentage points, over the episodes that all runs of both have.

    first_rate, second_rate, difference: means over tasks. interval: paired bootstrap over episodes,
    and over trainings. wins, losses: episodes that the first, or the second, solved in a larger
    share of its runs; the rest are ties. p: exact two-sided test on wins and losses (McNemar's
    where each has one run). corrected: by Holm, over all
        comparisons made together. significant: `corrected` is below 1 − confidence.
    suites: difference and interval of each suite.
    repeated, flipped: episodes that were run twice with the same weights and seed, and those of
    them that then ended
        otherwise; of both methods.
    paired: whether episodes are paired; if not, wins and losses are 0, and p is of the difference
    of two means. notes: which episodes were not paired, and which have no digest of their scene; a
    sentence each. gaps: the former.
    """

    first: str
    second: str
    episodes: int
    expected: int
    first_rate: float
    second_rate: float
    difference: float
    interval: Interval
    wins: int
    losses: int
    p: float
    corrected: float
    significant: bool
    suites: dict[str, tuple[float, Interval]]
    repeated: int = 0
    flipped: int = 0
    paired: bool = True
    notes: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()

    @property
    def better_worse(self) -> str:
        """Wins and losses as text."""
        return f"{self.wins} : {self.losses}" if self.paired else "not paired"

    @property
    def verdict(self) -> str:
        """One sentence."""
        text = self._judgement
        if self.repeated:
            text += (
                f"; of {self.repeated:,} episodes run twice alike, {self.flipped:,} ended otherwise"
            )
        return text

    @property
    def _judgement(self) -> str:
        p = (
            f"p {show_p(self.corrected)}"
            if self.corrected < 0.001
            else f"p = {show_p(self.corrected)}"
        )
        if self.significant:
            first_is_better = self.wins > self.losses if self.paired else self.difference > 0
            better, worse = (
                (self.first, self.second) if first_is_better else (self.second, self.first)
            )
            return f"{better} is significantly better than {worse} ({p})"
        return f"no significant difference between {self.first} and {self.second} ({p})"


def show_p(p: float) -> str:
    """A p value as one prints it."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def compare_all(
    pairs: Sequence[tuple[Method, Method]],
    protocol: Protocol,
    compare_two: Callable[[Method, Method, Protocol], Comparison] | None = None,
) -> list[Comparison]:
    """Compare pairs of methods, with p values corrected for their number. compare_two: by default
    `compare`.
    """
    compare_two = compare_two or compare
    made = [compare_two(first, second, protocol) for first, second in pairs]
    corrected = holm([comparison.p for comparison in made])
    level = 1 - protocol.confidence
    return [
        replace(c, corrected=p, significant=p < level) for c, p in zip(made, corrected, strict=True)
    ]


def pair_methods(first: Method, second: Method) -> Pairing[EpisodeKey]:
    """The episodes that every run of both methods has, of the same scenes."""
    runs = [run for method in (first, second) for run in method.runs]
    return pair([{key: [record] for key, record in sorted(run.records.items())} for run in runs])


def common_episodes(first: Method, second: Method) -> set[EpisodeKey]:
    """The episodes that `compare` pairs."""
    return set(pair_methods(first, second).keys)


def why_unpaired(first: Method, second: Method) -> str:
    """Why no episode of two methods can be paired, in a sentence or two."""
    what = f"{first.label} and {second.label}"
    notes = pair_methods(first, second).notes(what)
    return (
        " ".join(notes) if notes else f"{what} have no episode in common: there is nothing to pair."
    )


def compare(first: Method, second: Method, protocol: Protocol) -> Comparison:
    """Compare two methods."""
    require(first is not second, f"{first.label} cannot be compared with itself; name two methods.")
    rates, pairing = [_rates(method) for method in (first, second)], pair_methods(first, second)
    common = list(pairing.keys)
    require(common, why_unpaired(first, second))
    shared = [task for task in protocol.tasks if any(key.task == task for key in common)]
    tasks = [task for task in shared if task in protocol.averaged] or shared
    common = [key for key in common if key.task in tasks]
    by_task = {
        task: [
            np.array([side[key] for key in common if key.task == task]) for side in rates
        ]  # episodes × trainings
        for task in tasks
    }
    means = 100 * np.mean([[side.mean() for side in sides] for sides in by_task.values()], axis=0)
    means = means.round(9)  # equal counts, equal figures
    gaps = {task: first.mean(1) - second.mean(1) for task, (first, second) in by_task.items()}
    trained = any(len(method.trainings) > 1 for method in (first, second))
    sampled = {
        task: [sides[0], -sides[1]] if trained else [gaps[task][:, None]]
        for task, sides in by_task.items()
    }
    everything = np.concatenate(list(gaps.values()))
    wins, losses = int((everything > 0).sum()), int((everything < 0).sum())
    p = sign_test(wins, losses)
    suites = {}
    for scope in scopes(protocol):
        inside = [task for task in scope.tasks if task in gaps]
        if scope.kind == "suite" and inside:
            suites[scope.name] = (
                100 * float(np.mean([gaps[task].mean() for task in inside])),
                _interval({task: sampled[task] for task in inside}, protocol),
            )
    made = Comparison(
        first.label,
        second.label,
        len(common),
        len(protocol.averaged) * protocol.episodes,
        float(means[0]),
        float(means[1]),
        float(means[0] - means[1]),
        _interval(sampled, protocol),
        wins,
        losses,
        p,
        p,
        p < 1 - protocol.confidence,
        suites,
        first.repeated + second.repeated,
        first.flipped + second.flipped,
    )
    return _noted(made, pairing)


def compare_unpaired(first: Method, second: Method, protocol: Protocol) -> Comparison:
    """Compare the scores of two methods whose scenes are not known to be the same.

    p: of the difference of the means over tasks, by the normal approximation with the variances of
    both, each scene being worth the mean of its trainings. interval: the same difference ± its
    deviation.
    """
    rates = [_rates(method) for method in (first, second)]
    tasks = [
        task
        for task in protocol.averaged
        if all(any(key.task == task for key in side) for side in rates)
    ]
    require(
        tasks,
        f"{first.label} and {second.label} have no task in common: there is nothing to compare.",
    )
    means, variance = [], 0.0
    for side in rates:
        scenes = [
            np.array([np.mean(side[key]) for key in side if key.task == task]) for task in tasks
        ]
        means.append(100 * float(np.mean([of_task.mean() for of_task in scenes])))
        variance += (
            sum(float(of_task.var()) / len(of_task) for of_task in scenes) * (100 / len(tasks)) ** 2
        )
    difference, deviation = round(means[0] - means[1], 9), math.sqrt(variance)
    p = 1.0 if difference == 0 else 0.0
    if deviation > 0:
        p = math.erfc(abs(difference) / deviation / math.sqrt(2))
    half = NormalDist().inv_cdf(0.5 + protocol.confidence / 2) * deviation
    made = Comparison(
        first.label,
        second.label,
        min(len(side) for side in rates),
        len(protocol.averaged) * protocol.episodes,
        means[0],
        means[1],
        difference,
        Interval(difference - half, difference + half),
        0,
        0,
        p,
        p,
        p < 1 - protocol.confidence,
        {},
        first.repeated + second.repeated,
        first.flipped + second.flipped,
        paired=False,
    )
    return _noted(made, pair_methods(first, second))


def _noted(comparison: Comparison, pairing: Pairing[EpisodeKey]) -> Comparison:
    what = f"{comparison.first} − {comparison.second}"
    return replace(comparison, notes=tuple(pairing.notes(what)), gaps=tuple(pairing.gaps(what)))


def _rates(method: Method) -> dict[EpisodeKey, list[float]]:
    """For each episode that every run has: the share of each training's runs that solved it."""
    common = set.intersection(*(set(run.records) for run in method.runs))
    return {
        key: [
            float(np.mean([run.records[key].success for run in runs])) for runs in method.trainings
        ]
        for key in sorted(common)
    }


def _interval(gaps: dict[str, list[np.ndarray]], protocol: Protocol) -> Interval:
    low, high = bootstrap(gaps, protocol.confidence, protocol.samples, protocol.seed)
    return Interval(100 * low, 100 * high)
