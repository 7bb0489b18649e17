"""Two policies on the same scenes: how much better, and could it be chance."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from mme_vla.errors import counted, require
from mme_vla.evaluation.pairing import Pairing, pair
from mme_vla.evaluation.records import EpisodeKey
from mme_vla.evaluation.results.aggregate import Method, by_task
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.statistics import (
    Interval,
    estimate,
    holm,
    paired_interval,
    paired_test,
    wins_losses,
)


@dataclass(frozen=True)
class Comparison:
    """`first` minus `second`, in percentage points, over the episodes that all runs of both have.

    first_rate, second_rate, difference: means over tasks.
    first_solved, second_solved: of `episodes`, a mean over runs.
    interval: of the difference (`paired_interval`), with several trainings at least as wide as
        that of `estimate`.
    wins, losses: episodes that the first, or the second, solved in a larger share of its runs; the
        rest are ties.
    p: two-sided (`paired_test`; of single runs with equally many episodes a task McNemar's exact
        one), with several trainings at least that of `estimate`.
    corrected: by Holm, over all comparisons made together.
    significant: `corrected` is below 1 − confidence.
    smallest_p: the smallest that p can be with so many episodes.
    testable: whether that, corrected, is significant.
    repeated, flipped: episodes that were run twice with the same weights and seed, and those of
        them that then ended otherwise; of both methods.
    paired: whether episodes are paired; if not, wins and losses are 0, and interval and p are of
        the difference of two means.
    notes: which episodes were not paired, and which have no digest of their scene; a sentence each.
    gaps: the former.
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
    smallest_p: float = 0.0
    testable: bool = True
    repeated: int = 0
    flipped: int = 0
    paired: bool = True
    notes: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()
    first_solved: float = 0.0
    second_solved: float = 0.0

    @property
    def better_worse(self) -> str:
        """Wins and losses as text."""
        return f"{self.wins} : {self.losses}" if self.paired else "not paired"

    @property
    def verdict(self) -> str:
        """One sentence: what each side solved, and what that says."""
        sides = [f"{self.first} {self.first_rate:.1f} %", f"{self.second} {self.second_rate:.1f} %"]
        # Means over several runs are no counts.
        first = round(self.first_solved, 6)
        second = round(self.second_solved, 6)
        if self.paired and first.is_integer() and second.is_integer():
            sides = [
                f"{self.first} {first:g} of {self.episodes}",
                f"{self.second} {second:g} of {self.episodes}",
            ]
        text = " against ".join(sides)
        if self.significant:
            better = self.first if self.difference > 0 else self.second
            text += f": {better} is significantly better"
        elif not self.testable:
            text += ": too few episodes to tell"
        else:
            text += ": no significant difference"
        p = show_p(self.corrected)
        if self.corrected >= 0.001:
            p = f"= {p}"
        text += f" (p {p})"
        if self.flipped:
            text += (
                f"; of {counted(self.repeated, 'episode')} run twice alike,"
                f" {self.flipped:,} ended otherwise"
            )
        return text


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
    comparisons = [compare_two(first, second, protocol) for first, second in pairs]
    corrected = holm([comparison.p for comparison in comparisons])
    # Holm's values grow with every p: these are the smallest that all of them could have.
    smallest = holm([comparison.smallest_p for comparison in comparisons])
    level = 1 - protocol.confidence
    together = []
    for comparison, p, least in zip(comparisons, corrected, smallest, strict=True):
        significant = p < level
        testable = least < level
        together.append(
            replace(comparison, corrected=p, significant=significant, testable=testable)
        )
    return together


def pair_methods(first: Method, second: Method) -> Pairing[EpisodeKey]:
    """The episodes that every run of both methods has, of the same scenes."""
    return pair([run.episodes for run in (*first.runs, *second.runs)])


def why_unpaired(first: Method, second: Method) -> str:
    """Why no episode of two methods can be paired, in a sentence or two."""
    what = f"{first.label} and {second.label}"
    notes = pair_methods(first, second).notes(what)
    if notes:
        return " ".join(notes)
    return f"{what} have no episode in common: there is nothing to pair."


def compare(
    first: Method, second: Method, protocol: Protocol, over_trainings: bool = True
) -> Comparison:
    """Compare two methods.

    over_trainings: whether interval and p are for other trainings too, where a side has several.
    """
    require(first is not second, f"{first.label} cannot be compared with itself; name two methods.")
    pairing = pair_methods(first, second)
    require(pairing.keys, why_unpaired(first, second))
    shared = {key.task for key in pairing.keys}
    tasks = [task for task in protocol.averaged if task in shared]
    tasks = tasks or [task for task in protocol.tasks if task in shared]
    common = pd.MultiIndex.from_tuples(
        [key for key in pairing.keys if key.task in tasks], names=["task", "episode"]
    )
    # Episodes × trainings of each side, in the order of the protocol's tasks.
    first_rates = first.rates.loc[common].loc[tasks]
    second_rates = second.rates.loc[common].loc[tasks]
    gaps = (first_rates.mean(axis=1) - second_rates.mean(axis=1)).round(9)
    first_rate = _score(first_rates)
    second_rate = _score(second_rates)
    gaps_of_tasks = by_task(gaps)
    interval = paired_interval(gaps_of_tasks, protocol.confidence)
    p = paired_test(gaps_of_tasks)
    several = len(first_rates.columns) > 1 or len(second_rates.columns) > 1
    if over_trainings and several:
        sides = [list(by_task(rates).values()) for rates in (first_rates, -second_rates)]
        trained = estimate(sides)
        interval = interval.widen(trained.interval(protocol.confidence).clip(-1, 1))
        p = max(p, trained.p)
    wins, losses = wins_losses(gaps_of_tasks)
    smallest_p = paired_test({task: np.ones(len(values)) for task, values in gaps_of_tasks.items()})
    what = f"{first.label} − {second.label}"
    return Comparison(
        first.label,
        second.label,
        len(gaps),
        protocol.count(protocol.averaged),
        first_rate,
        second_rate,
        first_rate - second_rate,
        interval.percent,
        wins,
        losses,
        p,
        p,
        p < 1 - protocol.confidence,
        smallest_p,
        smallest_p < 1 - protocol.confidence,
        first.repeated + second.repeated,
        first.flipped + second.flipped,
        notes=tuple(pairing.notes(what)),
        gaps=tuple(pairing.gaps(what)),
        first_solved=float(first_rates.mean(axis=1).sum()),
        second_solved=float(second_rates.mean(axis=1).sum()),
    )


def _score(rates: pd.DataFrame) -> float:
    """The mean over the tasks in percent, rounded: equal counts, equal figures."""
    tasks = rates.groupby(level="task").mean()
    return round(100 * float(tasks.mean(axis=1).mean()), 9)
