"""RoboMME-OOD and the hard test episodes: tables by tier beside published figures, twins, and
extrapolation.

The published figures are development records of the benchmark's authors (early October 2026): one
run a policy, 1,600 steps allowed, from `hongzefu/robomme_benchmark_MotionJEPA`, docs/validation
(`v9-two-policy-gl10-20261002-01`, `sg-eval-gl-20261004-01`, `sg-eval-gl-20261006-03`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from mme_vla.envs import metadata
from mme_vla.envs.make import make_task, require_simulator
from mme_vla.envs.metadata import BASE, HARD, TWIN, read_variant
from mme_vla.envs.rows import OOD, TIERS
from mme_vla.envs.scene_hash import scene_digest
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord, by_run, merge
from mme_vla.evaluation.results.aggregate import Interval, repeated_episodes, wilson
from mme_vla.evaluation.results.curves import curve_figure
from mme_vla.evaluation.results.paper import paper_table
from mme_vla.evaluation.results.scopes import PAPER_ORDER
from mme_vla.evaluation.results.tables import Table

SOURCE = "development records of the authors, one run each, 1,600 steps"
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


@dataclass(frozen=True)
class Share:
    """Successes among episodes, with Wilson's interval in percent."""

    won: int
    episodes: int
    interval: Interval

    @classmethod
    def of(cls, records: Sequence[EpisodeRecord], confidence: float) -> "Share":
        """Count the records; one at least."""
        won = sum(record.success for record in records)
        low, high = wilson(won / len(records), len(records), confidence)
        return cls(won, len(records), Interval(100 * low, 100 * high))

    @property
    def rate(self) -> float:
        """In percent."""
        return 100 * self.won / self.episodes

    def __str__(self) -> str:
        return f"{self.won}/{self.episodes}"

    @property
    def span(self) -> str:
        """The interval as text."""
        return f"[{self.interval.low:.1f}, {self.interval.high:.1f}]"


def base_of(split: str) -> str:
    """The split whose scenes a split varies, tiers counting as `ood`."""
    variant = read_variant(split)
    base = split if variant is None else variant.base
    return OOD if base.startswith(f"{OOD}:") else base


def tier_tables(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> list[Table]:
    """For each run on RoboMME-OOD: success by task and tier, beside the published figures."""
    merged = [
        r
        for r in merge(records, conflicts)
        if base_of(r.split) == OOD and read_variant(r.split) is None
    ]
    published = paper_table("ood")
    columns = [
        "task",
        *TIERS,
        "all",
        "%",
        f"{100 * confidence:g} %",
        *(row["method"] for row in published),
    ]
    tables = []
    for run, members in by_run(merged).items():
        rows = []
        for task in (*(t for t in PAPER_ORDER if any(r.task == t for r in members)), "all"):
            mine = [r for r in members if task in ("all", r.task)]
            cells = [[r for r in mine if r.difficulty == tier] for tier in TIERS]
            share = Share.of(mine, confidence)
            known = [_published(row, task) for row in published]
            rows.append(
                [
                    task,
                    *(str(Share.of(cell, confidence)) if cell else "–" for cell in cells),
                    str(share),
                    f"{share.rate:.1f}",
                    share.span,
                    *known,
                ]
            )
        title = f"{run} on RoboMME-OOD; published: {SOURCE}"
        tables.append(Table(title, columns, rows, {len(rows) - 1}, {len(rows) - 1}))
    return tables


def _published(row: dict[str, str], task: str) -> str:
    episodes = int(row["episodes"]) * (len(PAPER_ORDER) if task == "all" else 1)
    return f"{100 * int(row[task]) / episodes:.1f}"


def hard_table(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Table | None:
    """Success on the test split's hard episodes beside the published figures; None without such
    records.
    """
    merged = [r for r in merge(records, conflicts) if r.split == HARD]
    if not merged:
        return None
    rows = []
    for run, members in by_run(merged).items():
        share = Share.of(members, confidence)
        rows.append([str(run), str(share), f"{share.rate:.1f}", share.span])
    for row in paper_table("hard"):
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
    return Table(f"Hard test episodes; published: {SOURCE}", columns, rows, {len(by_run(merged))})


def twin_table(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Table | None:
    """Each split beside its twin, on their common episodes; None without a pair.

    In the twin what is to be remembered stays in view: what fails there is lost by control, and the
    difference to the split itself by memory. Flips are episodes that were run more than once alike
    and ended otherwise. Episodes whose scenes are not the same are left out, and counted in the
    table's notes.
    """
    merged = merge(records, conflicts)
    repeats = repeated_episodes(records)
    runs = by_run(merged)
    rows, notes = [], list[str]()
    for run, members in runs.items():
        twin = run._replace(split=TWIN if run.split == BASE else f"{TWIN}:{run.split}")
        sides = [
            {record.key: [record] for record in side} for side in (members, runs.get(twin, []))
        ]
        pairing = pair(sides)
        notes += pairing.notes(f"{run} and its twin")
        pairs = [(sides[0][key][0], sides[1][key][0]) for key in pairing.keys]
        if not pairs:
            continue
        base, visible = (Share.of(side, confidence) for side in zip(*pairs, strict=True))
        better = sum(b.success and not a.success for a, b in pairs)
        worse = sum(a.success and not b.success for a, b in pairs)
        repeated, flipped = (
            sum(n) for n in zip(repeats.get(run, (0, 0)), repeats.get(twin, (0, 0)), strict=True)
        )
        rows.append(
            [
                str(run),
                str(len(pairs)),
                f"{base.rate:.1f} {base.span}",
                f"{visible.rate:.1f} {visible.span}",
                f"{visible.rate - base.rate:+.1f}",
                f"{100 - visible.rate:.1f}",
                f"{better} : {worse}",
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
    title = "Twins: what memory loses and what control loses"
    return Table(title, columns, rows, notes=notes) if rows or notes else None


# Extrapolation ------------------------------------------------------------------------------------


@cache
def amount_of(task: str, split: str, key: EpisodeKey, scene: str | None = None) -> int | None:
    """How often, how many or how long an episode is, by `AMOUNTS`; scenes without a row are built
    for that.

    None where the scene cannot be built, or is another one here than the one with the digest
    `scene`.
    """
    from mme_vla.envs.robomme.scene.placement import SceneError

    spec = metadata.episode(task, split, key.episode)
    values: dict[str, Any] = dict(spec.row["spec"]) if spec.row is not None else {}
    if not values:
        require_simulator()
        env = make_task(task, render=False, **spec.options)
        try:
            env.reset()
            values = env.scene_values()["spec"]
            if scene is not None and scene_digest(env.placed_values()) != scene:
                return None
        except SceneError:
            return None
        finally:
            env.close()
    _, name, _ = AMOUNTS[task]
    part, value = name.split(".")
    amount = values[part][value]
    if isinstance(amount, list):
        return sum(amount) if task == "BinFill" else len(amount)
    return int(amount)


Extrapolation = dict[tuple[str, str], dict[int, Share]]
"""(model, task) → amount → success; all splits together."""


def extrapolation(
    records: Sequence[EpisodeRecord], confidence: float = 0.95, conflicts: str = "refuse"
) -> Extrapolation:
    """Success against the amount of what grows, over all splits of a model: training, test, stress
    and OOD.

    Twins, splits with sessions, and scenes that cannot be built or are other ones here are left
    out.
    """
    groups: dict[tuple[str, str], dict[int, list[EpisodeRecord]]] = {}
    for record in merge(records, conflicts):
        variant = read_variant(record.split)
        if record.task not in AMOUNTS or (
            variant is not None and (variant.twin or variant.sessions)
        ):
            continue
        amount = amount_of(record.task, record.split, record.key, record.named_scene)
        if amount is None:
            continue
        at = str(record.run._replace(split=BASE)), record.task
        groups.setdefault(at, {}).setdefault(amount, []).append(record)
    return {
        at: {amount: Share.of(members, confidence) for amount, members in sorted(by_amount.items())}
        for at, by_amount in groups.items()
    }


def extrapolation_table(curves: Extrapolation) -> Table | None:
    """Every point, a row each; amounts beyond the training range are marked. None
    without a point.
    """
    rows = []
    for (run, task), points in sorted(curves.items()):
        kind, _, (least, most) = AMOUNTS[task]
        for amount, share in points.items():
            trained = "trained" if least <= amount <= most else "beyond"
            rows.append(
                [run, task, kind, str(amount), trained, str(share), f"{share.rate:.1f}", share.span]
            )
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


def extrapolation_figures(curves: Extrapolation) -> dict[str, str]:
    """For each task the success of every run against the amount, the training range shaded; SVG."""
    figures = {}
    for task in dict.fromkeys(task for _, task in sorted(curves)):
        kind, _, (least, most) = AMOUNTS[task]
        runs = {
            run: [(amount, share.rate, share.interval) for amount, share in points.items()]
            for (run, of), points in curves.items()
            if of == task
        }
        figures[f"{task}, {kind}"] = curve_figure(runs, kind, (least - 0.5, most + 0.5))
    return figures
