"""RoboMME-OOD and the hard test episodes: tables by tier beside published figures, twins, and
extrapolation.

The published figures are development records of the benchmark's authors (early October 2026): one
run a policy, 1,600 steps allowed, from `hongzefu/robomme_benchmark_MotionJEPA`, docs/validation
(`v9-two-policy-gl10-20261002-01`, `sg-eval-gl-20261004-01`, `sg-eval-gl-20261006-03`).
"""

from collections.abc import Sequence
from contextlib import closing
from functools import cache
from typing import Any

import numpy as np

from mme_vla.envs import metadata
from mme_vla.envs.make import make_task, require_simulator
from mme_vla.envs.metadata import BASE, HARD, TWIN, read_variant
from mme_vla.envs.rows import OOD, TIERS
from mme_vla.envs.scene_hash import scene_digest
from mme_vla.errors import SceneError
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord, RunKey, merge
from mme_vla.evaluation.results.aggregate import record_table, repeated_episodes
from mme_vla.evaluation.results.curves import Curves, count_successes, run_names, stress_figures
from mme_vla.evaluation.results.paper import paper_table
from mme_vla.evaluation.results.scopes import PAPER_ORDER
from mme_vla.evaluation.results.tables import Table, span

SOURCE = "development records of the authors, one run each, 1,600 steps"
FULL_SPLIT = {HARD: BASE, **{f"{OOD}:{tier}": OOD for tier in TIERS}}
"""Split → the split whose scenes it has some of, with their seeds."""
AMOUNTS: dict[str, tuple[str, str, tuple[int, int]]] = {
    "PickXtimes": ("count", "objects.num_repeats", (1, 5)),
    "SwingXtimes": ("count", "objects.num_repeats", (1, 3)),
    "StopCube": ("count", "actions.stop_time", (2, 5)),
    "VideoRepick": ("count", "objects.num_repeats", (1, 3)),
    "BinFill": ("count", "objects.target_numbers", (1, 5)),
    "VideoUnmaskSwap": ("swaps", "objects.n_swaps", (1, 3)),
    "ButtonUnmaskSwap": ("swaps", "objects.n_swaps", (1, 3)),
    "VideoUnmask": ("picks", "objects.n_picks", (1, 2)),
    "ButtonUnmask": ("picks", "objects.n_picks", (1, 2)),
    "PickHighlight": ("picks", "objects.highlight_ids", (1, 3)),
    "PatternLock": ("path length", "actions.path_nodes", (2, 8)),
    "RouteStick": ("path length", "actions.turns", (2, 7)),
}
"""Task → what grows in harder scenes, the value that says it, and its range in the training
episodes.
"""


def tier_tables(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> list[Table]:
    """For each run on RoboMME-OOD: success by task and tier, beside the published figures of the
    same tasks. Rates are means over tasks, here and below.
    """
    of_tiers = []
    for record in merge(records, conflicts):
        if record.split.partition(":")[0] == OOD:  # a tier too, and no twin
            of_tiers.append(record)
    published = paper_table("ood")
    columns = ["task", *TIERS, "all", "%", f"{100 * confidence:g} %"]
    columns += [row["method"] for row in published]
    tables = []
    for run, members in record_table(of_tiers).groupby("run", sort=False):
        parts = {}
        for task in PAPER_ORDER:
            part = members[members["task"] == task]
            if not part.empty:
                parts[task] = part
        tasks = list(parts)
        parts["all"] = members
        rows = []
        for task, part in parts.items():
            row = [task]
            for tier in TIERS:
                cell = part[part["difficulty"] == tier]
                row.append("–" if cell.empty else str(count_successes(cell, confidence)))
            share = count_successes(part, confidence)
            row += [str(share), f"{share.rate:.1f}", span(share.interval)]
            names = tasks if task == "all" else [task]
            for line in published:
                solved = sum(int(line[name]) for name in names)
                row.append(f"{100 * solved / len(names) / int(line['episodes']):.1f}")
            rows.append(row)
        last = len(rows) - 1
        title = f"{run} on RoboMME-OOD; published: {SOURCE}"
        n_published = sum(len(metadata.episodes(task, OOD)) for task in tasks)
        notes = _partial(run, len(members), n_published)
        tables.append(Table(title, columns, rows, {last}, {last}, notes=notes))
    return tables


def _partial(run: RunKey, done: int, published: int) -> list[str]:
    """A note where a run has only some of the episodes that published figures are of."""
    if done == published:
        return []
    return [f"{run} has {done:,} of the {published:,} episodes that published figures are of."]


def hard_table(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Table | None:
    """Success on the test split's hard episodes beside the published figures; None without such
    records.
    """
    merged = [r for r in merge(records, conflicts) if r.split == HARD]
    if not merged:
        return None
    published = paper_table("hard")
    rows = []
    notes: list[str] = []
    for run, members in record_table(merged).groupby("run", sort=False):
        share = count_successes(members, confidence)
        rows.append([str(run), str(share), f"{share.rate:.1f}", span(share.interval)])
        notes += _partial(run, len(members), int(published[0]["episodes"]))
    n_runs = len(rows)
    for row in published:
        won = [int(n) for n in row["won"].split()]
        rate = 100 * sum(won) / len(won) / int(row["episodes"])
        rows.append(
            [
                f"{row['method']}, published",
                f"{', '.join(map(str, won))} of {row['episodes']}",
                f"{rate:.1f}",
                "",
            ]
        )
    columns = ["run", "successes", "%", f"{100 * confidence:g} %"]
    title = f"Hard test episodes; published: {SOURCE}"
    return Table(title, columns, rows, {n_runs}, notes=notes)


def twin_table(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Table | None:
    """Each split beside its twin, on their common episodes; None without a pair.

    In the twin what is to be remembered stays in view: what fails there is lost by control, and the
    difference to the split itself by memory. Flips are episodes that were run more than once alike
    and ended otherwise. Episodes whose scenes are not the same are left out, and counted in the
    table's notes.
    """
    repeats = repeated_episodes(records)
    runs: dict[RunKey, dict[EpisodeKey, list[EpisodeRecord]]] = {}
    for record in merge(records, conflicts):
        runs.setdefault(record.run, {})[record.key] = [record]
    rows = []
    notes: list[str] = []
    for run, episodes in runs.items():
        twin = run._replace(split=f"{TWIN}:{run.split}")
        if run.split == BASE:
            twin = run._replace(split=TWIN)
        if twin not in runs:
            continue
        pairing = pair([episodes, runs[twin]])
        notes += pairing.notes(f"{run} and its twin")
        if not pairing.keys:
            continue
        base = record_table([episodes[key][0] for key in pairing.keys])
        visible = record_table([runs[twin][key][0] for key in pairing.keys])
        gaps = visible["success"] - base["success"]
        base_share = count_successes(base, confidence)
        visible_share = count_successes(visible, confidence)
        repeated, flipped = np.add(repeats.get(run, (0, 0)), repeats.get(twin, (0, 0)))
        rows.append(
            [
                str(run),
                str(len(gaps)),
                f"{base_share.rate:.1f} {span(base_share.interval)}",
                f"{visible_share.rate:.1f} {span(visible_share.interval)}",
                f"{visible_share.rate - base_share.rate:+.1f}",
                f"{100 - visible_share.rate:.1f}",
                f"{(gaps > 0).sum()} : {(gaps < 0).sum()}",
                f"{flipped} of {repeated}" if repeated else "none run twice",
            ]
        )
    columns = [
        "run",
        "episodes",
        "split (%)",
        "twin (%)",
        "lost by memory",
        "lost by control",
        "gained : lost",
        "flips of equal runs",
    ]
    if not rows and not notes:
        return None
    title = "Twins: what memory loses and what control loses"
    return Table(title, columns, rows, notes=notes)


# Extrapolation ------------------------------------------------------------------------------------


@cache
def amount_of(task: str, split: str, key: EpisodeKey, scene: str | None = None) -> int | None:
    """How often, how many or how long an episode is, by `AMOUNTS`; scenes without a row are built
    for that.

    None where the scene cannot be built, or is another one here than the one with the digest
    `scene`.
    """
    spec = metadata.episode(task, split, key.episode)
    values: dict[str, Any] = dict(spec.row["spec"]) if spec.row is not None else {}
    if not values:
        require_simulator()
        try:
            with closing(make_task(task, render=False, **spec.options)) as env:
                env.reset()
                values = env.scene_values()["spec"]
                if scene is not None and scene_digest(env.placed_values()) != scene:
                    return None
        except SceneError:
            return None
    _, name, _ = AMOUNTS[task]
    part, value = name.split(".")
    amount = values[part][value]
    if isinstance(amount, list):
        return sum(amount) if task == "BinFill" else len(amount)
    return int(amount)


def extrapolation(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Curves:
    """Success against the amount of what grows, over all splits of a model: training, test, stress
    and OOD. The dial of a curve is what grows.

    Twins, and scenes that cannot be built or are other ones here, are left out. A scene of two
    splits, the test split and its hard episodes or `ood` and a tier, counts once, as it first came.
    """
    counted = []
    amounts = []
    scenes = set()
    for record in merge(records, conflicts):
        variant = read_variant(record.split)
        if variant is not None and variant.twin:
            continue
        if record.task not in AMOUNTS:
            continue
        amount = amount_of(record.task, record.split, record.key, record.named_scene)
        split = FULL_SPLIT.get(record.split, record.split)
        number = record.seed if split in FULL_SPLIT.values() else record.episode
        scene = record.run._replace(split=split), record.task, number
        if amount is not None and scene not in scenes:
            scenes.add(scene)
            counted.append(record)
            amounts.append(amount)
    table = record_table(counted)
    runs = [run._replace(split=BASE) for run in table["run"]]
    names = run_names(runs)
    table["run"] = [names[run] for run in runs]
    table["amount"] = amounts
    curves: Curves = {}
    for (run, task, amount), members in table.groupby(["run", "task", "amount"], sort=False):
        kind, _, _ = AMOUNTS[task]
        curves.setdefault((run, task, kind), {})[amount] = count_successes(members, confidence)
    return {curve: dict(sorted(points.items())) for curve, points in curves.items()}


def extrapolation_table(curves: Curves) -> Table | None:
    """Every point, a row each; amounts beyond the training range are marked. None
    without a point.
    """
    rows = []
    for (run, task, kind), points in sorted(curves.items()):
        _, _, (least, most) = AMOUNTS[task]
        for amount, share in points.items():
            trained = "trained" if least <= amount <= most else "beyond"
            cells = [str(share), f"{share.rate:.1f}", span(share.interval)]
            rows.append([run, task, kind, f"{amount:g}", trained, *cells])
    columns = [
        "run",
        "task",
        "what grows",
        "amount",
        "training range",
        "successes",
        "success (%)",
        "interval",
    ]
    return Table("Extrapolation", columns, rows) if rows else None


def extrapolation_figures(curves: Curves) -> dict[str, str]:
    """For each task the success of every run against the amount, the training range shaded; SVG."""
    training = {task: (least - 0.5, most + 0.5) for task, (_, _, (least, most)) in AMOUNTS.items()}
    return stress_figures(curves, "", training)
