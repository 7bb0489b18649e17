"""From a probe's lines to the figures of its page."""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mme_vla.errors import require
from mme_vla.evaluation.results.compare import Comparison
from mme_vla.evaluation.results.report import Section, html_page
from mme_vla.evaluation.results.tables import Table, comparison_table, to_markdown
from mme_vla.extras.probing.lines import EntryLine, Line, MomentLine
from mme_vla.extras.probing.recordings import Recording
from mme_vla.utils import require_earlier, write_atomically
from mme_vla.utils.media import Tile, contact_sheet
from mme_vla.utils.pages import render
from mme_vla.utils.style import COLOURS, FAINT, figure, legend, rgb, svg

if TYPE_CHECKING:
    from PIL.Image import Image


MEASURES = {
    "evidence": ("drop:all", "nothing is remembered"),
    "order": ("shuffle", "contents change places"),
    "clock": ("delay:64", "everything seems 64 frames later"),
    "pause": ("pause", "64 still frames"),
    "interference": ("distract:1", "one unrelated episode first"),
}
"""What a probe's table has one column for: the arm that measures it, and what that does."""
AGES = (0, 16, 32, 64, 128, 256, 512)  # Where the bins of an entry's age begin, in frames


@dataclass(frozen=True)
class Effect:
    """The effect of an arm, or an entry, over some steps.

    change, spread, distance: means, as in `Change`. beyond: share of steps at which the change
    exceeds the spread.
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
    changes = np.array([line.change for line in lines])
    spreads = np.array([line.spread for line in lines])
    distances = np.array([getattr(line, "distance", 0.0) for line in lines])
    return Effect(
        moments=len(lines),
        change=float(changes.mean()),
        spread=float(spreads.mean()),
        distance=float(distances.mean()),
        beyond=float((changes > spreads).mean()),
    )


@dataclass(frozen=True)
class Findings:
    """Everything a probe on recorded episodes found of one checkpoint."""

    moments: list[MomentLine]
    entries: list[EntryLine]

    @classmethod
    def of(cls, lines: Iterable[Line]) -> "Findings":
        """Sort the lines."""
        every = list(lines)
        return cls(
            [x for x in every if isinstance(x, MomentLine)],
            [x for x in every if isinstance(x, EntryLine)],
        )

    def arms(self) -> dict[str, Effect]:
        """The effect of every arm, in the order in which they came."""
        lines_of_arms = _grouped(self.moments, lambda line: line.arm)
        return {name: effect(lines) for name, lines in lines_of_arms.items()}

    def families(self) -> dict[str, list[tuple[float, Effect]]]:
        """Interventions of which several places of the dial were probed: dial and effect,
        ascending.
        """
        turned = [line for line in self.moments if line.dial is not None]
        families = {}
        for name, members in _grouped(turned, lambda line: line.arm.partition(":")[0]).items():
            places = _grouped(members, lambda line: line.dial or 0.0)
            if len(places) > 1:
                families[name] = [(dial, effect(places[dial])) for dial in sorted(places)]
        return families

    def decay(self, video: bool) -> list[tuple[float, Effect]]:
        """Mean age and effect of the entries of each bin of age, those of the video or of the
        execution.
        """
        entries = [entry for entry in self.entries if entry.video == video]
        bins = _grouped(entries, lambda entry: int(np.searchsorted(AGES, entry.age, "right")))
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
        moments = _grouped(self.entries, lambda entry: (entry.task, entry.recording, entry.step))
        for (task, *_), lines in moments.items():
            change = max(line.change for line in lines)
            if task not in strongest or change > strongest[task]:
                strongest[task] = change
                entries[task] = lines
        return entries


def _grouped[K, L](lines: Iterable[L], key: Callable[[L], K]) -> dict[K, list[L]]:
    groups: dict[K, list[L]] = {}
    for line in lines:
        groups.setdefault(key(line), []).append(line)
    return groups


def show(effect_of: Effect | None) -> str:
    """A change as a table has it: the change, and how many of the policy's own spread that is."""
    if effect_of is None:
        return "–"
    text = f"{effect_of.change:.3f}"
    if effect_of.times is not None:
        text += f" ({effect_of.times:.1f}×)"
    return text


def arms_table(findings: Findings) -> Table:
    """Every arm over all steps."""
    rows = []
    for name, effect_of in findings.arms().items():
        lines = [line for line in findings.moments if line.arm == name]
        ages = [age for line in lines for age in line.touched]
        touched = f"{np.mean(ages):.0f}" if ages else "–"
        times = "–" if effect_of.times is None else f"{effect_of.times:.1f}×"
        rows.append(
            [
                name,
                str(effect_of.moments),
                touched,
                f"{effect_of.change:.3f}",
                f"{effect_of.spread:.3f}",
                times,
                f"{100 * effect_of.beyond:.0f} %",
                f"{effect_of.distance:.3f}",
            ]
        )
    columns = (
        "arm",
        "moments",
        "age touched",
        "change",
        "own spread",
        "times that",
        "beyond it",
        "energy distance",
    )
    return Table("What each intervention does to the chunk", columns, rows)


def phases_table(findings: Findings) -> Table:
    """Every arm by task and sub-task."""
    groups = _grouped(findings.moments, lambda line: (line.arm, line.task, line.phase))
    phases = sorted({(task, phase) for _, task, phase in groups})
    named = [f"{task or 'task'} · {phase + 1}" for task, phase in phases]
    rows = []
    for name in findings.arms():
        cells = []
        for task, phase in phases:
            lines = groups.get((name, task, phase))
            cells.append(show(effect(lines) if lines else None))
        rows.append([name, *cells])
    return Table("By task and sub-task", ("arm", *named), rows)


def checkpoints_table(findings: dict[str, Findings]) -> Table:
    """One row a checkpoint: what it takes from its memory."""
    rows = []
    for name, checkpoint in findings.items():
        arms = checkpoint.arms()
        cells = [show(arms.get(arm)) for arm, _ in MEASURES.values()]
        reach, video = checkpoint.reach(), checkpoint.from_video()
        cells.append("–" if reach is None else f"{reach:.0f}")
        cells.append("–" if video is None else f"{100 * video:.0f} %")
        rows.append([name, *cells])
    return Table(
        "What is taken from memory",
        ("checkpoint", *MEASURES, "reach (frames)", "from the video"),
        rows,
    )


_ON = {
    "distract": "episodes before one's own",
    "delay": "frames that the clock runs ahead",
    "pause": "still frames",
    "recent": "frames that may be remembered",
    "drop": "entries taken away",
}


def effects(findings: Findings) -> str:
    """A bar an arm: the mean change of the chunk; the line is the policy's own spread."""
    arms = findings.arms()
    with figure((10.4, 3.4)) as (canvas, (axes,)):
        axes.bar(
            range(len(arms)),
            [arm_effect.change for arm_effect in arms.values()],
            0.7,
            color=COLOURS[0],
        )
        ends = [(i - 0.42, i + 0.42) for i in range(len(arms))]
        axes.hlines(
            [arm_effect.spread for arm_effect in arms.values()],
            *zip(*ends, strict=True),
            color=COLOURS[1],
            lw=2,
            label="the policy's own spread",
        )
        axes.set_xticks(
            range(len(arms)), list(arms), rotation=25, ha="right", rotation_mode="anchor"
        )
        axes.set_ylabel("change of the chunk")
        legend(canvas, axes, 3)
        return svg(canvas)


def decay(findings: Findings) -> str:
    """What an entry matters by its age, those of the video and of the execution."""
    with figure((5.6, 3.4)) as (canvas, (axes,)):
        for name, video, colour in (("video", True, COLOURS[0]), ("execution", False, COLOURS[1])):
            points = findings.decay(video)
            mine = [e for e in findings.entries if e.video == video]
            if mine:
                axes.scatter(
                    [e.age for e in mine],
                    [e.change for e in mine],
                    s=8,
                    color=colour,
                    alpha=0.25,
                    lw=0,
                )
                means = [point.change for _, point in points]
                axes.plot([age for age, _ in points], means, "-o", color=colour, ms=5, label=name)
        stds = [entry.spread for entry in findings.entries]
        if stds:
            axes.axhline(sum(stds) / len(stds), color=FAINT, lw=1, ls="--", label="own spread")
        axes.set_xlabel("age of the entry (frames)")
        axes.set_ylabel("change without it")
        legend(canvas, axes, 3)
        return svg(canvas)


def dials(findings: Findings) -> dict[str, str]:
    """A curve for each intervention of which several places of the dial were probed."""
    figures = {}
    for name, points in findings.families().items():
        with figure((5.6, 3.0)) as (canvas, (axes,)):
            axes.plot(
                [0, *(x for x, _ in points)],
                [0, *(f.change for _, f in points)],
                "-o",
                color=COLOURS[0],
                ms=5,
            )
            axes.axhline(points[0][1].spread, color=COLOURS[1], lw=1, ls="--")
            axes.set_xlabel(_ON.get(name, name))
            axes.set_ylabel("change of the chunk")
            figures[name] = svg(canvas)
    return figures


PAGE, TABLE, IMAGES = "page.html", "table.md", "remembered"
VIDEO, EXECUTION, NOW = rgb("video"), rgb("series-1"), rgb("border")
UNITS = (
    "Change: root mean square distance of two chunks of the same noise, in normalised actions (1 is"
    " half of what the training data span). In brackets: how many times what chunks differ by that"
    " differ in noise alone."
)


def remembered_image(lines: Sequence[EntryLine], recording: Recording) -> "Image":
    """The frames remembered at a step, each with its age and how the chunk changes without it; the
    current one last.

    lines: of one step. recording: theirs.
    """
    step, tiles = lines[0].step, []
    for line in sorted(lines, key=lambda line: line.time):
        label = f"{line.age} ago: {line.change:.2f}"
        tiles.append(Tile(recording.frame(line.time), label, VIDEO if line.video else EXECUTION))
    tiles.append(Tile(recording.frame(step), f"now: frame {step}", NOW))
    title = f"{lines[0].task or recording.name}: change of the chunk without each entry"
    return contact_sheet(tiles, min(len(tiles), 8), title, None)


MARK = "takes from its memory"  # stands in the heading of each page and table


def check_outputs(folder: Path, claimed: bool) -> None:
    """Make sure that the page, the table and the images of a probe replace nothing but earlier
    ones.

    Args:
        claimed: whether the folder holds an earlier probe, to which the images in it belong.

    Raises:
        UserError: a file of somebody's own is in the place of one.
    """
    for name in (PAGE, TABLE):
        require_earlier(folder / name, MARK)
    images = folder / IMAGES
    require(
        claimed or not images.exists() or (images.is_dir() and not any(images.iterdir())),
        f"{images} exists, and no probe is in {folder} that it could belong to: nothing is written"
        " into it. Choose another output, or move it away yourself.",
    )


def write_images(findings: Findings, recordings: Sequence[Recording], folder: Path) -> list[Path]:
    """Render the step of each task at which an entry mattered most; entries that are
    frames alone.
    """
    by_name = {recording.name: recording for recording in recordings}
    paths = []
    for task, lines in findings.matters_most().items():
        recording = by_name.get(lines[0].recording)
        if recording is None or lines[0].store != "memory":
            continue
        needed = np.unique([*(line.time for line in lines), lines[0].step])
        if not recording.source.rendered(recording.episode)[needed].all():
            continue
        (folder / IMAGES).mkdir(parents=True, exist_ok=True)
        path = folder / IMAGES / f"{task or 'task'}.png"
        remembered_image(lines, recording).save(path)
        paths.append(path)
    return paths


def write_page(
    folder: Path,
    name: str,
    findings: Findings,
    comparisons: Sequence[Comparison] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Write `page.html` and `table.md` into the probe's folder."""
    sections, tables = [], []
    if findings.moments:
        tables = [checkpoints_table({name: findings}), arms_table(findings), phases_table(findings)]
        sections.append(Section("In short", tables=tables[:1], caption=UNITS))
        sections.append(Section("Interventions", effects(findings)))
        curves = []
        if findings.entries:
            caption = "Each entry left out by itself."
            curves.append(Section("Decay with distance", decay(findings), caption=caption))
        for dial, curve in dials(findings).items():
            caption = "Dashed: the policy's own spread."
            curves.append(Section(f"Over the dial: {dial}", curve, caption=caption))
        in_pairs = len(curves) - len(curves) % 2
        sections += [replace(curve, half=True) for curve in curves[:in_pairs]]
        sections += curves[in_pairs:]
        sections += [Section(table.title, tables=[table]) for table in tables[1:]]
    images = [(path.stem, _encoded(path)) for path in sorted((folder / IMAGES).glob("*.png"))]
    if images:
        caption = "The step of each task at which a single entry mattered most."
        sections.append(Section("What was remembered", images=images, caption=caption))
    verdicts = [comparison.verdict for comparison in comparisons]
    if comparisons:
        tables.append(comparison_table(comparisons))
        sections.append(
            Section("In closed loop", tables=tables[-1:], caption="; ".join(verdicts) + ".")
        )
    page = html_page(f"What {name} {MARK}", sections, notes=notes)
    text = render(
        "probe.md", name=name, tables=map(to_markdown, tables), verdicts=verdicts, notes=notes
    )
    for file, content in ((PAGE, page), (TABLE, text)):
        with write_atomically(folder / file) as draft:
            draft.write_text(content, encoding="utf-8")
    return folder / PAGE


def table_of(findings: Mapping[str, Findings]) -> str:
    """Several checkpoints beside each other, in Markdown."""
    return to_markdown(checkpoints_table(dict(findings)))


def _encoded(path: Path) -> str:
    """An image as WEBP in base64."""
    from PIL import Image

    out = BytesIO()
    with Image.open(path) as image:
        image.save(out, format="WEBP", quality=80)
    return base64.b64encode(out.getvalue()).decode()
