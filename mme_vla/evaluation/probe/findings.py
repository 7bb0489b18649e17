"""From a probe's lines to the figures of its page."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mme_vla.evaluation.probe.lines import EntryLine, Line, MomentLine
from mme_vla.evaluation.results.tables import Table

MEASURES = {
    "evidence": ("drop:all", "nothing is remembered"),
    "order": ("shuffle", "contents change places"),
    "clock": ("delay:64", "everything seems 64 frames later"),
    "pause": ("pause", "64 still frames"),
    "interference": ("distract:1", "one unrelated episode first"),
}
"""What a probe's table has one column for: the arm that measures it, and what that does."""
AGES = (0, 16, 32, 64, 128, 256, 512)
"""Where the bins of an entry's age begin, in frames."""


@dataclass(frozen=True)
class Effect:
    """What an arm, or an entry, did over some moments.

    change, spread, distance: means, as in `Change`. beyond: share of moments at which the change exceeds the spread.
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
    changes, spreads = np.array([x.change for x in lines]), np.array([x.spread for x in lines])
    distances = [x.distance for x in lines if isinstance(x, MomentLine)]
    return Effect(
        len(lines), float(changes.mean()), float(spreads.mean()), float(np.mean(distances)) if distances else 0.0,
        float((changes > spreads).mean()),
    )  # fmt: skip


@dataclass(frozen=True)
class Findings:
    """Everything a probe on recorded episodes found of one checkpoint."""

    moments: list[MomentLine]
    entries: list[EntryLine]

    @classmethod
    def of(cls, lines: Iterable[Line]) -> "Findings":
        """Sort the lines."""
        every = list(lines)
        return cls([x for x in every if isinstance(x, MomentLine)], [x for x in every if isinstance(x, EntryLine)])

    def arms(self) -> dict[str, Effect]:
        """The effect of every arm, in the order in which they came."""
        return {name: effect(lines) for name, lines in _grouped(self.moments, lambda line: line.arm).items()}

    def families(self) -> dict[str, list[tuple[float, Effect]]]:
        """Interventions of which several places of the dial were probed: dial and effect, ascending."""
        dials: dict[str, dict[float, list[MomentLine]]] = {}
        for line in self.moments:
            if line.dial is not None:
                dials.setdefault(line.arm.partition(":")[0], {}).setdefault(line.dial, []).append(line)
        return {
            name: [(dial, effect(lines)) for dial, lines in sorted(found.items())]
            for name, found in dials.items()
            if len(found) > 1
        }

    def decay(self, video: bool) -> list[tuple[float, Effect]]:
        """Mean age and effect of the entries of each bin of age, those of the video or of the execution."""
        mine = [entry for entry in self.entries if entry.video == video]
        bins = _grouped(mine, lambda entry: int(np.searchsorted(AGES, entry.age, "right")))
        return [(float(np.mean([e.age for e in lines])), effect(lines)) for _, lines in sorted(bins.items())]

    def reach(self) -> float | None:
        """How far back what matters lies: mean age of the entries, weighted by their change; None without entries."""
        weights = np.array([entry.change for entry in self.entries])
        return float(np.average([e.age for e in self.entries], weights=weights)) if weights.sum() > 0 else None

    def from_video(self) -> float | None:
        """The share of all entries' changes that those of the conditioning video make; None without entries."""
        total = sum(entry.change for entry in self.entries)
        return sum(entry.change for entry in self.entries if entry.video) / total if total > 0 else None

    def matters_most(self) -> dict[str, list[EntryLine]]:
        """For each task the moment at which a single entry mattered most: all entries of that moment."""
        found: dict[str, list[EntryLine]] = {}
        moments = _grouped(self.entries, lambda e: (e.task, e.recording, e.step))
        for (task, *_), lines in moments.items():
            if task not in found or max(e.change for e in lines) > max(e.change for e in found[task]):
                found[task] = lines
        return found


def _grouped[K, L](lines: Iterable[L], key: Callable[[L], K]) -> dict[K, list[L]]:
    groups: dict[K, list[L]] = {}
    for line in lines:
        groups.setdefault(key(line), []).append(line)
    return groups


def show(found: Effect | None) -> str:
    """A change as a table has it: the change, and how many of the policy's own spread that is."""
    if found is None:
        return "–"
    return f"{found.change:.3f}" + ("" if found.times is None else f" ({found.times:.1f}×)")


def arms_table(findings: Findings) -> Table:
    """Every arm over all moments."""
    rows = []
    for name, found in findings.arms().items():
        lines = [line for line in findings.moments if line.arm == name]
        ages = [age for line in lines for age in line.touched]
        touched = f"{np.mean(ages):.0f}" if ages else "–"
        times = "–" if found.times is None else f"{found.times:.1f}×"
        rows.append([name, str(found.moments), touched, f"{found.change:.3f}", f"{found.spread:.3f}", times,
                     f"{100 * found.beyond:.0f} %", f"{found.distance:.3f}"])  # fmt: skip
    columns = ("arm", "moments", "age touched", "change", "own spread", "times that", "beyond it", "energy distance")
    return Table("What each intervention does to the chunk", columns, rows)


def phases_table(findings: Findings) -> Table:
    """Every arm by task and sub-task."""
    places = sorted({(line.task, line.phase) for line in findings.moments})
    named = [f"{task or 'task'} · {phase + 1}" for task, phase in places]
    rows = []
    for name in findings.arms():
        cells = []
        for place in places:
            lines = [line for line in findings.moments if line.arm == name and (line.task, line.phase) == place]
            cells.append(show(effect(lines) if lines else None))
        rows.append([name, *cells])
    return Table("By task and sub-task", ("arm", *named), rows)


def checkpoints_table(findings: dict[str, Findings]) -> Table:
    """One row a checkpoint: what it takes from its memory."""
    rows = []
    for name, found in findings.items():
        arms, reach, video = found.arms(), found.reach(), found.from_video()
        cells = [show(arms.get(arm)) for arm, _ in MEASURES.values()]
        rows.append([name, *cells, "–" if reach is None else f"{reach:.0f}",
                     "–" if video is None else f"{100 * video:.0f} %"])  # fmt: skip
    return Table("What is taken from memory", ("checkpoint", *MEASURES, "reach (frames)", "from the video"), rows)
