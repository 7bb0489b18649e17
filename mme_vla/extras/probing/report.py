"""The page of a probe: what was found first, then the figures, and what their words mean."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from mme_vla.errors import require
from mme_vla.evaluation.results.compare import Comparison, show_p
from mme_vla.evaluation.results.report import Section, html_page
from mme_vla.evaluation.results.scopes import counted
from mme_vla.evaluation.results.tables import Table, to_markdown
from mme_vla.extras.probing.arms import UNPROBED, meanings_of
from mme_vla.extras.probing.conclusions import conclude
from mme_vla.extras.probing.findings import Effect, Findings, by_recording, effect, grouped
from mme_vla.extras.probing.lines import EntryLine, MomentLine
from mme_vla.extras.probing.recordings import Recording
from mme_vla.utils import read_bytes, write_text
from mme_vla.utils.media import Tile, contact_sheet
from mme_vla.utils.pages import render
from mme_vla.utils.style import COLOURS, FAINT, INK, figure, legend, rgb, svg

if TYPE_CHECKING:
    from PIL.Image import Image


MEASURES = {
    "evidence": ("drop:all", "everything remembered is removed: is the memory read at all?"),
    "order": ("shuffle", "what is remembered changes places: does it matter when it was?"),
    "clock": ("delay:64", "entries seem to be later: are they found by their time?"),
    "pause": ("pause", "time stands still for a while: does that disturb?"),
    "interference": ("distract:1", "another episode is seen first: does it disturb?"),
}
"""What a probe's table has one column for: the arm that measures it, and what that does."""
REACH = ("reach", "mean age of the entries, weighted by how much the actions change without them")
FROM_VIDEO = ("from the video", "share of those changes that entries of the video make")
COLUMNS = (
    ("change", "distance of two chunks of actions that start from the same noise, with and without"
     " the intervention, root mean square (1 is half of what the training data span)"),
    ("own spread", "distance of two chunks that differ in noise alone: what a change is compared"
     " with"),
    ("times", "change / own spread"),
    ("above", "share of the decisions at which the change exceeds the own spread"),
    ("age", "mean age in frames of the entries that the intervention changes"),
    ("energy", "energy distance of the two distributions of chunks, 0 where they are one"),
)  # fmt: skip
"""What the columns of the table of arms mean."""


def show(effect_of: Effect | None) -> str:
    """A change as a table has it: the change, and how many of the policy's own spread that is."""
    if effect_of is None:
        return "–"
    text = f"{effect_of.change:.3f}"
    if effect_of.times is not None:
        text += f" ({effect_of.times:.1f}×)"
    return text


def arms_table(findings: Findings, meanings: Mapping[str, str] | None = None) -> Table:
    """Every arm over all decisions. meanings: what each does, for a column of its own."""
    rows = []
    for name, effect_of in findings.arms().items():
        ages: list[int] = []
        for line in findings.moments:
            if line.arm == name:
                ages += line.touched
        row = [name]
        if meanings is not None:
            row.append(meanings.get(name, ""))
        row += [
            f"{effect_of.change:.3f}",
            f"{effect_of.spread:.3f}",
            "–" if effect_of.times is None else f"{effect_of.times:.1f}×",
            f"{100 * effect_of.beyond:.0f} %",
            f"{np.mean(ages):.0f}" if ages else "–",
            f"{effect_of.distance:.3f}",
        ]
        rows.append(row)
    columns = ["arm", *(name for name, _ in COLUMNS)]
    if meanings is not None:
        columns.insert(1, "what it does")
    return Table("What each intervention does to the actions", columns, rows)


def phases_table(findings: Findings) -> Table | None:
    """Every arm by task and sub-task; None where all decisions are of one."""
    groups = grouped(findings.moments, lambda line: (line.task, line.phase))
    if len(groups) < 2:
        return None
    arms = list(findings.arms())
    rows = []
    for (task, phase), lines in sorted(groups.items()):
        by_arm = grouped(lines, lambda line: line.arm)
        cells = []
        for arm in arms:
            effect_of = effect(by_arm[arm]) if arm in by_arm else None
            if effect_of is None:
                cells.append("–")
            elif effect_of.times is None:
                cells.append(f"{effect_of.change:.3f}")
            else:
                cells.append(f"{effect_of.times:.1f}×")
        rows.append([phase_name(task, phase, lines), *cells])
    return Table("By task and sub-task", ("task and sub-task", *arms), rows)


MOST_WORDS = 3
"""Different words of a sub-task's texts that are named; of more there is an ellipsis."""


def phase_name(task: str, phase: int, lines: Sequence[MomentLine]) -> str:
    """The name of a sub-task: its number, and the words of its texts."""
    name = f"sub-task {phase + 1}"
    if task:
        name = f"{task}, {name}"
    texts = sorted({line.subgoal for line in lines if line.subgoal})
    if not texts:
        return name
    words = [text.split() for text in texts]
    if len({len(of_one) for of_one in words}) > 1:
        # Texts of several lengths: what all of them begin with.
        beginning = []
        for column in zip(*words, strict=False):
            if len(set(column)) > 1:
                break
            beginning.append(column[0])
        return f"{name}: {' '.join([*beginning, '…'])}"
    shared: list[str] = []
    for column in zip(*words, strict=True):
        different = sorted(set(column))
        word = "/".join(different) if len(different) <= MOST_WORDS else "…"
        if word != "…" or shared[-1:] != ["…"]:
            shared.append(word)
    return f"{name}: {' '.join(shared)}"


def measures_table(findings: Findings, explained: bool = False) -> Table:
    """The measures of one checkpoint, a row each, without those that were not probed. explained:
    with a column that says what each measures.
    """
    arms = findings.arms()
    rows = []
    for measure, (arm, question) in MEASURES.items():
        if arm in arms:
            rows.append([measure, question, arm, show(arms[arm])])
    reach, video = findings.reach(), findings.from_video()
    if reach is not None:
        rows.append([*REACH, "each entry removed", counted(round(reach), "frame")])
    if video is not None:
        rows.append([*FROM_VIDEO, "each entry removed", f"{100 * video:.0f} %"])
    columns = ["measure", "what is measured", "intervention", "change"]
    if not explained:
        del columns[1]
        rows = [[row[0], *row[2:]] for row in rows]
    return Table("In short", columns, rows)


def loop_table(comparisons: Sequence[Comparison], meanings: Mapping[str, str] | None) -> Table:
    """Every arm in closed loop beside the unprobed run. meanings: as for `arms_table`."""
    rows = []
    for c in comparisons:
        episodes = c.episodes
        significant = "no"
        if c.significant:
            significant = "yes"
        elif not c.testable:
            significant = "too few episodes"
        row = [c.first]
        if meanings is not None:
            row.append(meanings.get(c.first, ""))
        row += [
            f"{round(c.first_solved, 1):g} of {episodes}",
            f"{round(c.second_solved, 1):g} of {episodes}",
            f"{c.difference:+.0f}",
            f"[{c.interval.low:+.0f}, {c.interval.high:+.0f}]",
            c.better_worse,
            show_p(c.corrected),
            significant,
        ]
        rows.append(row)
    columns = [name for name, _ in LOOP_COLUMNS]
    if meanings is not None:
        columns.insert(1, "what it does")
    return Table("In closed loop", columns, rows)


LOOP_COLUMNS = (
    ("arm", "the same scenes and the same noise as the unprobed run"),
    ("solved", "scenes solved under the arm"),
    (UNPROBED.name, "of these, scenes that the policy solves as it is"),
    ("difference", "of the success rates, in percentage points"),
    ("95 %", "interval of the difference"),
    ("gained : lost", "scenes that only the arm solves, and only the unprobed run"),
    ("p", "exact sign test on those, corrected by Holm for the number of arms"),
    ("significant", "whether p is below 0.05"),
)
"""What the columns of the table of the closed loop mean."""


@dataclass(frozen=True)
class Dial:
    """How a curve over an intervention's number is called. neutral: whether 0 changes nothing."""

    title: str
    axis: str
    neutral: bool = True


_DIALS = {
    "distract": Dial("More other episodes first", "episodes that are seen first"),
    "delay": Dial("Entries seem later and later", "frames that entries seem later"),
    "pause": Dial("Longer pauses", "still frames"),
    "recent": Dial("A longer or shorter past", "frames that may be remembered", False),
    "drop": Dial("More entries removed", "entries removed"),
}


def effects(findings: Findings) -> str:
    """A bar an arm: the mean change of the chunk. A dot: one recorded episode. The line is the
    policy's own spread.
    """
    arms = findings.arms()
    places = np.arange(len(arms))[::-1]
    with figure((5.8, 1.3 + 0.3 * len(arms))) as (canvas, (axes,)):
        axes.barh(places, [arm.change for arm in arms.values()], 0.62, color=COLOURS[0])
        label = "one recorded episode"
        for place, (name, arm) in zip(places, arms.items(), strict=True):
            lines = [line for line in findings.moments if line.arm == name]
            values = [episode.change for episode in by_recording(lines)]
            axes.plot(
                values, [place] * len(values), "o", color=INK, ms=3.5, alpha=0.6, lw=0, label=label
            )
            label = ""
            if arm.times is not None:
                right = max([arm.change, arm.spread, *values])
                axes.annotate(
                    f"{arm.times:.1f}×",
                    (right, place),
                    xytext=(7, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=9,
                )
        axes.vlines(
            [arm.spread for arm in arms.values()],
            places - 0.42,
            places + 0.42,
            color=COLOURS[1],
            lw=2,
            label="the policy's own spread",
        )
        axes.set_yticks(places, list(arms))
        axes.tick_params(axis="y", length=0)
        axes.grid(False, axis="y")
        axes.grid(True, axis="x")
        axes.set_xlim(left=0)
        axes.margins(x=0.12)
        axes.set_xlabel("change of the actions (normalised)")
        legend(canvas, axes, 3)
        return svg(canvas)


def decay(findings: Findings) -> str:
    """What an entry matters by its age, those of the video and of the execution."""
    with figure((5.6, 3.4)) as (canvas, (axes,)):
        for name, video, colour in (("video", True, COLOURS[0]), ("execution", False, COLOURS[1])):
            ages = []
            changes = []
            for entry in findings.entries:
                if entry.video == video:
                    ages.append(entry.age)
                    changes.append(entry.change)
            if ages:
                axes.scatter(ages, changes, s=12, color=colour, alpha=0.45, lw=0)
                points = findings.decay(video)
                means = [point.change for _, point in points]
                axes.plot([age for age, _ in points], means, "-o", color=colour, ms=5, label=name)
        stds = [entry.spread for entry in findings.entries]
        if stds:
            axes.axhline(sum(stds) / len(stds), color=FAINT, lw=1, ls="--", label="own spread")
        axes.set_ylim(bottom=0)
        axes.set_xlabel("age of the entry (frames)")
        axes.set_ylabel("change without it")
        legend(canvas, axes, 3)
        return svg(canvas)


def dials(findings: Findings) -> list[Section]:
    """A curve for each intervention of which several places of the dial were probed: the mean, and
    a dot a recorded episode.
    """
    sections = []
    for name, points in findings.families().items():
        dial = _DIALS.get(name, Dial(f"More of {name}", name, False))
        of_family = [line for line in findings.moments if line.arm.partition(":")[0] == name]
        places: list[float] = []
        means: list[float] = []
        if dial.neutral:
            places.append(0)
            means.append(0)
        with figure((5.6, 3.0)) as (canvas, (axes,)):
            for place, effect_of in points:
                lines = [line for line in of_family if line.dial == place]
                values = [episode.change for episode in by_recording(lines)]
                axes.plot([place] * len(values), values, "o", color=INK, ms=3, alpha=0.5, lw=0)
                places.append(place)
                means.append(effect_of.change)
            axes.plot(places, means, "-o", color=COLOURS[0], ms=5)
            axes.axhline(points[0][1].spread, color=COLOURS[1], lw=1, ls="--")
            axes.set_ylim(bottom=0)
            axes.set_xlabel(dial.axis)
            axes.set_ylabel("change of the actions")
            svg_text = svg(canvas)
        caption = "A dot: one recorded episode. Dashed: the policy's own spread."
        sections.append(Section(dial.title, svg_text, caption=caption))
    return sections


PAGE, TABLE, IMAGES = "page.html", "table.md", "remembered"
ONLINE = "online"
"""Folder of the closed loop."""
VIDEO, EXECUTION, NOW = rgb("video"), rgb("series-1"), rgb("border")
UNITS = (
    "Change: distance of two chunks of actions that start from the same noise, in normalised"
    " actions (one is half of what the training data span). In brackets: how many times the"
    " distance of two chunks that differ in noise alone."
)


def remembered_image(lines: Sequence[EntryLine], recording: Recording, columns: int = 8) -> "Image":
    """The frames remembered at a step, each with its age and how the chunk changes without it; the
    current one last.

    lines: of one step.
    recording: theirs.
    columns: frames a row.
    """
    step = lines[0].step
    tiles = []
    for line in sorted(lines, key=lambda line: line.time):
        label = f"{line.age} ago: {line.change:.2f}"
        tiles.append(Tile(recording.frame(line.time), label, VIDEO if line.video else EXECUTION))
    tiles.append(Tile(recording.frame(step), f"now: frame {step}", NOW))
    title = f"{lines[0].task or recording.name}: change of the chunk without each entry"
    return contact_sheet(tiles, columns, title)


MARK = "takes from its memory"  # in the heading of each page and table


def require_earlier(path: Path, *marks: str) -> Path:
    """Return where a command is to write a page of a fixed name, if none is there but an earlier
    one of its own.

    Args:
        marks: texts that stand in every page of the command.

    Raises:
        UserError: a file is there in which one of them is missing.
    """
    if path.exists() or path.is_symlink():
        content = read_bytes(path, "a page") if path.is_file() else b""
        require(
            all(mark.encode() in content for mark in marks),
            f"{path} exists, and was not written by this command: it is not replaced. Choose"
            " another output, or move it away yourself.",
        )
    return path


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


@dataclass(frozen=True)
class Notes:
    """What a reader has to know beside the figures.

    warnings: sentences on what was run.
    left_out: why some of the default arms are not there.
    """

    warnings: Sequence[str] = ()
    left_out: Sequence[str] = ()


def write_page(
    folder: Path,
    name: str,
    checkpoint: int | str,
    findings: Findings,
    comparisons: Sequence[Comparison] = (),
    notes: Notes = Notes(),
) -> Path:
    """Write `page.html` and `table.md` into the probe's folder.

    comparisons: of each arm, as `first`, with the unprobed run.
    """
    lead = conclude(findings, comparisons)
    meanings = meanings_of([*findings.arms(), *(c.first for c in comparisons)])
    sections: list[Section] = []
    tables: list[Table] = []
    sizes = [f"checkpoint {checkpoint}"]
    if findings.moments:
        sizes.append(findings.size)
        if findings.changed:
            sections += _offline_sections(findings, meanings)
            tables += [measures_table(findings), arms_table(findings)]
            by_phase = phases_table(findings)
            tables += [] if by_phase is None else [by_phase]
        else:
            # What changes nothing has no figure: its numbers are there for who wants them.
            table = arms_table(findings, meanings)
            folded = [(f"The {counted(len(table.rows), 'intervention')} in numbers", table)]
            sections.append(Section("On recorded episodes", folded=folded, terms=COLUMNS))
    images = [(path.stem, _encoded(path)) for path in sorted((folder / IMAGES).glob("*.png"))]
    if images and findings.changed:
        caption = "The step of each task at which a single entry mattered most."
        sections.append(Section("What was remembered", images=images, caption=caption))
    if comparisons:
        episodes = max(comparison.episodes for comparison in comparisons)
        sizes.append(f"{counted(episodes, 'scene')} in closed loop")
        table = loop_table(comparisons, meanings)
        videos = _videos(folder)
        section = Section("In closed loop", tables=[table], terms=LOOP_COLUMNS, links=videos)
        if not any(comparison.wins or comparison.losses for comparison in comparisons):
            folded = [(f"{counted(len(table.rows), 'arm')}, all with equal outcomes", table)]
            section = Section("In closed loop", folded=folded, terms=LOOP_COLUMNS, links=videos)
        else:
            tables.append(loop_table(comparisons, None))
        sections.append(section)
    page = html_page(
        f"What {name} {MARK}",
        sections,
        " · ".join(sizes),
        notes=notes.warnings,
        lead=lead,
        footnotes=notes.left_out,
    )
    text = render(
        "probe.md",
        name=name,
        sizes=" · ".join(sizes),
        lead=lead,
        tables=map(to_markdown, tables),
        terms=_terms_of(tables, meanings),
        notes=[*notes.warnings, *notes.left_out],
    )
    for file, content in ((PAGE, page), (TABLE, text)):
        write_text(folder / file, content)
    return folder / PAGE


def _videos(folder: Path) -> list[tuple[str, str]]:
    """Each video of the closed loop: its arm and name, and its address from the page."""
    videos = []
    for path in sorted((folder / ONLINE).rglob("*.mp4")):
        place = path.relative_to(folder)
        videos.append((f"{place.parts[1]}: {path.stem}", quote(place.as_posix())))
    return videos


def _terms_of(tables: Sequence[Table], meanings: Mapping[str, str]) -> list[tuple[str, str]]:
    """The measures and arms that some tables have a row of, the columns of the arms, and what they
    mean.
    """
    questions = {name: question for name, (_, question) in MEASURES.items()}
    of_columns = dict([*COLUMNS, *LOOP_COLUMNS[1:]])  # but that of the arms' names
    known = {**of_columns, **questions, **dict([REACH, FROM_VIDEO]), **meanings}
    names: dict[str, None] = {}
    for table in tables:
        if table.columns[0] == "arm":
            names |= dict.fromkeys(name for name in table.columns if name in of_columns)
        if table.columns[0] in ("arm", "measure"):
            names |= dict.fromkeys(row[0] for row in table.rows)
    return [(name, known[name]) for name in names if known.get(name)]


def _offline_sections(findings: Findings, meanings: Mapping[str, str]) -> list[Section]:
    """The sections on recorded episodes, the short one first."""
    measures = measures_table(findings, explained=True)
    sections = []
    if measures.rows:
        sections.append(Section("In short", tables=[measures], caption=UNITS))
    caption = "A bar is the mean over all decisions, a dot that of one recorded episode."
    sections.append(Section("What each intervention changes", effects(findings), caption=caption))
    curves = []
    if findings.entries:
        caption = "Each entry left out by itself: dots single entries, lines means."
        curves.append(Section("At what age an entry matters", decay(findings), caption=caption))
    curves += dials(findings)
    in_pairs = len(curves) - len(curves) % 2
    sections += [replace(curve, half=True) for curve in curves[:in_pairs]]
    sections += curves[in_pairs:]
    table = arms_table(findings, meanings)
    sections.append(Section(table.title, tables=[table], terms=COLUMNS))
    by_phase = phases_table(findings)
    if by_phase is not None:
        caption = "How many times the policy's own spread the actions change by."
        sections.append(Section(by_phase.title, tables=[by_phase], caption=caption))
    return sections


def table_of(findings: Mapping[str, Findings]) -> str:
    """Several checkpoints beside each other, in Markdown, and what the columns mean."""
    rows = []
    for name, checkpoint in findings.items():
        arms = checkpoint.arms()
        cells = [show(arms.get(arm)) for arm, _ in MEASURES.values()]
        reach, video = checkpoint.reach(), checkpoint.from_video()
        cells.append("–" if reach is None else f"{reach:.0f}")
        cells.append("–" if video is None else f"{100 * video:.0f} %")
        rows.append([name, *cells])
    columns = ("checkpoint", *MEASURES, "reach (frames)", "from the video")
    table = Table("What is taken from memory", columns, rows)
    terms = [f"- {name}: {question}" for name, (_, question) in MEASURES.items()]
    for name, meaning in (REACH, FROM_VIDEO):
        terms.append(f"- {name}: {meaning}")
    return "\n".join([to_markdown(table), *terms, "", UNITS])


def _encoded(path: Path) -> str:
    """An image as WEBP in base64."""
    from PIL import Image

    out = BytesIO()
    with Image.open(path) as image:
        image.save(out, format="WEBP", quality=80)
    return base64.b64encode(out.getvalue()).decode()
