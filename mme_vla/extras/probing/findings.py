"""From a probe's lines to the effects of its interventions."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mme_vla.evaluation.results.scopes import counted
from mme_vla.extras.probing.lines import EntryLine, Line, MomentLine

AGES = (0, 16, 32, 64, 128, 256, 512)  # Where the bins of an entry's age begin, in frames
UNCHANGED = 0.0005
"""A change that is smaller, in normalised actions, is none: tables show it as 0.000."""


@dataclass(frozen=True)
class Effect:
    """The effect of an arm, or an entry, over some steps.

    change, spread, distance: means, as in `Change`.
    beyond: share of steps at which the change exceeds the spread.
    """

    moments: int
    change: float
    spread: float
    distance: float
    beyond: float

    @property
    def times(self) -> float | None:
        """How often the policy's own spread; None for a policy that has none."""
        return self.change / self.spread if self.spread > 0 else None


def effect(lines: Sequence[MomentLine] | Sequence[EntryLine]) -> Effect:
    """The effect over some lines, at least one."""
    changes = []
    spreads = []
    distances = []
    n_beyond = 0
    for line in lines:
        changes.append(line.change)
        spreads.append(line.spread)
        distances.append(line.distance if isinstance(line, MomentLine) else 0.0)
        n_beyond += line.change > line.spread
    return Effect(
        moments=len(lines),
        change=float(np.mean(changes)),
        spread=float(np.mean(spreads)),
        distance=float(np.mean(distances)),
        beyond=n_beyond / len(lines),
    )


@dataclass(frozen=True)
class Findings:
    """Everything a probe on recorded episodes found of one checkpoint."""

    moments: list[MomentLine]
    entries: list[EntryLine]

    @classmethod
    def of(cls, lines: Iterable[Line]) -> "Findings":
        """Sort the lines."""
        moments: list[MomentLine] = []
        entries: list[EntryLine] = []
        for line in lines:
            if isinstance(line, MomentLine):
                moments.append(line)
            else:
                entries.append(line)
        return cls(moments, entries)

    def arms(self) -> dict[str, Effect]:
        """The effect of every arm, in the order in which they came."""
        lines_of_arms = grouped(self.moments, lambda line: line.arm)
        return {name: effect(lines) for name, lines in lines_of_arms.items()}

    @property
    def changed(self) -> bool:
        """Whether any intervention, or any entry that was left out, changed a chunk at all."""
        effects = list(self.arms().values())
        if self.entries:
            effects.append(effect(self.entries))
        return any(effect_of.change >= UNCHANGED for effect_of in effects)

    @property
    def size(self) -> str:
        """What was measured, such as `12 decisions of 4 recorded episodes`."""
        episodes = {line.recording for line in self.moments}
        decisions = {(line.recording, line.step) for line in self.moments}
        return (
            f"{counted(len(decisions), 'decision')} of {counted(len(episodes), 'recorded episode')}"
        )

    def families(self) -> dict[str, list[tuple[float, Effect]]]:
        """Interventions of which several places of the dial were probed: dial and effect,
        ascending.
        """
        turned = [line for line in self.moments if line.dial is not None]
        families = {}
        for name, members in grouped(turned, lambda line: line.arm.partition(":")[0]).items():
            places = grouped(members, lambda line: line.dial or 0.0)
            if len(places) > 1:
                families[name] = [(dial, effect(places[dial])) for dial in sorted(places)]
        return families

    def decay(self, video: bool) -> list[tuple[float, Effect]]:
        """Mean age and effect of the entries of each bin of age, those of the video or of the
        execution.
        """
        entries = [entry for entry in self.entries if entry.video == video]
        bins = grouped(entries, lambda entry: int(np.searchsorted(AGES, entry.age, "right")))
        points = []
        for _, lines in sorted(bins.items()):
            mean_age = float(np.mean([line.age for line in lines]))
            points.append((mean_age, effect(lines)))
        return points

    def reach(self) -> float | None:
        """How far back what matters lies: mean age of the entries, weighted by their change; None
        without entries.
        """
        weights = np.array([entry.change for entry in self.entries])
        if weights.sum() <= 0:
            return None
        return float(np.average([entry.age for entry in self.entries], weights=weights))

    def from_video(self) -> float | None:
        """The share of all entries' changes that those of the conditioning video make; None without
        entries.
        """
        total = sum(entry.change for entry in self.entries)
        if total <= 0:
            return None
        return sum(entry.change for entry in self.entries if entry.video) / total

    def matters_most(self) -> dict[str, list[EntryLine]]:
        """For each task the step at which a single entry mattered most: all entries of
        that step.
        """
        strongest: dict[str, float] = {}
        entries: dict[str, list[EntryLine]] = {}
        moments = grouped(self.entries, lambda entry: (entry.task, entry.recording, entry.step))
        for (task, *_), lines in moments.items():
            change = max(line.change for line in lines)
            if task not in strongest or change > strongest[task]:
                strongest[task] = change
                entries[task] = lines
        return entries


def grouped[K, L](lines: Iterable[L], key: Callable[[L], K]) -> dict[K, list[L]]:
    """Lines by a key, in their order."""
    groups: dict[K, list[L]] = {}
    for line in lines:
        groups.setdefault(key(line), []).append(line)
    return groups


def by_recording(lines: Sequence[MomentLine]) -> list[Effect]:
    """The effect in each recorded episode."""
    return [effect(of_one) for of_one in grouped(lines, lambda line: line.recording).values()]
