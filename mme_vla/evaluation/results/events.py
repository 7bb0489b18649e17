"""Runs with events beside their matched arms, the same scenes and noise without: pairs, and success
over length.

Trainings of one recipe on the same data are one row and one curve.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import pandas as pd

from mme_vla.errors import counted, require
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord, RunKey, merge
from mme_vla.evaluation.results.aggregate import Method, Results
from mme_vla.evaluation.results.compare import show_p
from mme_vla.evaluation.results.curves import Curves, Place, curves_of
from mme_vla.evaluation.results.statistics import sign_test
from mme_vla.evaluation.results.tables import Table
from mme_vla.memory.perturbation import split_word
from mme_vla.policy.training_identity import without_seed
from mme_vla.registry import PERTURBATIONS

_PAIR = ["training", "task", "episode", "without", "with", "idle"]
"""Columns of a table of pairs: success without and with the event, and whether it did not act."""
NO_EVENTS = "None of these records is of an event: evaluate with event=pause:100, for instance."


def matched_methods(results: Results) -> list[tuple[Method, Method]]:
    """Every method with an event and the same one without, where there is one."""
    methods = {method.key: method for method in results.methods}
    matched = []
    for method in results.methods:
        baseline = methods.get(method.key._replace(event=None))
        if method.key.event is not None and baseline is not None:
            matched.append((method, baseline))
    return matched


def did_not_act(record: EpisodeRecord) -> list[str]:
    """The events of a record whose place never came: a sub-task that did not begin, a step beyond
    the end. None of an episode that ended in an error, perhaps before.
    """
    if record.outcome == "error":
        return []
    return [entry["event"] for entry in record.events if entry["step"] is None]


def idle_events(records: Sequence[EpisodeRecord]) -> list[str]:
    """A line for each event that did not act in some episodes."""
    counts: Counter[str] = Counter()
    for record in records:
        counts.update(did_not_act(record))
    lines = []
    for event, count in counts.items():
        episodes = counted(count, "episode")
        lines.append(f"event={event} did not act in {episodes}: its place never came.")
    return lines


def event_table(records: Sequence[EpisodeRecord], conflicts: str = "refuse") -> Table:
    """Of every recipe, event and task: both success rates, and which outcomes the event changed.

    A rate is the mean over tasks, then over trainings, ± its sample standard deviation. Pairs are
    those of all trainings; an episode that ended in an error is a failure. p is a sign test over
    scenes: one is lost, or gained, where more trainings lose it than gain it, or fewer.
    """
    merged = merge(records, conflicts)
    require(any(record.event for record in merged), NO_EVENTS)
    runs: dict[RunKey, dict[EpisodeKey, list[EpisodeRecord]]] = {}
    for record in merged:
        runs.setdefault(record.run, {})[record.key] = [record]

    # The pairs of every recipe, and notes on episodes that were not paired for their scenes.
    groups: dict[RunKey, list[list[Any]]] = {}
    notes: list[str] = []
    for run, disturbed in runs.items():
        matched = runs.get(run._replace(event=None), {})
        if run.event is None:
            continue
        if not matched:
            notes.append(f"{run}: left out of the pairs, for the same run without it is not here.")
            continue
        pairing = pair([disturbed, matched])
        notes += pairing.notes(str(run))
        for key in pairing.keys:
            record = disturbed[key][0]
            group = groups.setdefault(run._replace(training=without_seed(run.training)), [])
            outcomes = [matched[key][0].success, record.success]
            group.append(
                [run.training, key.task, key.episode, *outcomes, bool(did_not_act(record))]
            )

    rows: list[list[str]] = []
    rules: set[int] = set()
    for run, group in groups.items():
        pairs = pd.DataFrame(group, columns=_PAIR)
        parts = dict(list(pairs.groupby("task", sort=False)))
        if len(parts) > 1:
            parts["all"] = pairs
        for task, part in parts.items():
            rows.append([str(run._replace(event=None)), str(run.event), task, *_counts(part)])
        rules.add(len(rows))
    columns = [
        "run", "event", "task", "trainings", "pairs", "without (%)", "with (%)", "kept", "lost",
        "gained", "p, uncorrected", "did not act",
    ]  # fmt: skip
    return Table(
        "Events beside their matched arms", columns, rows, rules - {len(rows)}, notes=notes
    )


def _counts(pairs: pd.DataFrame) -> list[str]:
    """The cells of one row from "trainings" on."""
    # Of each training the mean over tasks, without and with the event
    by_task = pairs.groupby(["training", "task"], sort=False, dropna=False)[["without", "with"]]
    rates = 100 * by_task.mean().groupby("training", sort=False, dropna=False).mean()
    cells = [str(len(rates)), str(len(pairs))]
    for side in rates:
        cell = f"{rates[side].mean():.1f}"
        if len(rates) > 1:
            cell += f" ± {rates[side].std():.1f}"
        cells.append(cell)
    both = pairs["without"] & pairs["with"]
    lost = pairs["without"] & ~pairs["with"]
    gained = ~pairs["without"] & pairs["with"]
    cells += [str(both.sum()), str(lost.sum()), str(gained.sum())]
    # How many more trainings lost an episode than gained it
    balances = (lost.astype(int) - gained).groupby([pairs["task"], pairs["episode"]]).sum()
    p = sign_test(int((balances > 0).sum()), int((balances < 0).sum()))
    return [*cells, show_p(p), str(pairs["idle"].sum())]


def event_curves(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Curves:
    """Success over the number of every event that has one; the plain run is at its
    neutral number.
    """
    return curves_of(merge(records, conflicts), _place, confidence, same_scenes=True)


def _place(record: EpisodeRecord) -> Place:
    recipe = record.run._replace(training=without_seed(record.training))
    word = None if record.event is None else split_word(record.event)
    if word is None or word.value is None:
        return Place(recipe)
    neutral = 0.0
    if word.name in PERTURBATIONS:
        neutral = PERTURBATIONS[word.name].neutral
    dial = word.name
    if word.unit is not None:
        dial += f"@{word.unit}:{word.number}"
    return Place(recipe._replace(event=None), dial, word.value, neutral)
