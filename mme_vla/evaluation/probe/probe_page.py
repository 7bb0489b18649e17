"""A probe's page, and its table in Markdown: what a checkpoint takes from its memory."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mme_vla.evaluation.probe import figures
from mme_vla.evaluation.probe.findings import Findings, arms_table, checkpoints_table, phases_table
from mme_vla.evaluation.probe.lines import EntryLine
from mme_vla.evaluation.probe.recordings import Recording
from mme_vla.evaluation.results.compare import Comparison
from mme_vla.evaluation.results.report import document, html_table, pair, section
from mme_vla.evaluation.results.tables import comparison_table, to_markdown
from mme_vla.files import write_atomically
from mme_vla.files.media import Tile, contact_sheet

if TYPE_CHECKING:
    from PIL.Image import Image

PAGE, TABLE, PICTURES = "page.html", "table.md", "remembered"
VIDEO, EXECUTION, NOW = (122, 162, 205), (233, 148, 62), (200, 40, 40)
UNITS = (
    "Change: root mean square distance of two chunks of the same noise, in normalised actions (1 is half of what the "
    "training data span). In brackets: how many times what chunks differ by that differ in noise alone."
)


def remembered_picture(lines: Sequence[EntryLine], recording: Recording) -> "Image":
    """The frames remembered at a moment, each with its age and how the chunk changes without it; the current one last.

    Args:
        lines: of one moment. recording: of which they are.
    """
    step, tiles = lines[0].step, []
    for line in sorted(lines, key=lambda line: line.time):
        label = f"{line.age} ago: {line.change:.2f}"
        tiles.append(Tile(recording.frame(line.time), label, VIDEO if line.video else EXECUTION))
    tiles.append(Tile(recording.frame(step), f"now: frame {step}", NOW))
    title = f"{lines[0].task or recording.name}: change of the chunk without each entry"
    return contact_sheet(tiles, min(len(tiles), 8), title, None)


def write_pictures(findings: Findings, recordings: Sequence[Recording], folder: Path) -> list[Path]:
    """Draw the moment of each task at which an entry mattered most; entries that are frames alone."""
    by_name = {recording.name: recording for recording in recordings}
    written = []
    for task, lines in findings.matters_most().items():
        recording = by_name.get(lines[0].recording)
        if recording is None or lines[0].store != "memory":
            continue
        needed = np.unique([*(line.time for line in lines), lines[0].step])
        if not recording.source.drawn(recording.episode)[needed].all():
            continue
        (folder / PICTURES).mkdir(parents=True, exist_ok=True)
        path = folder / PICTURES / f"{task or 'task'}.png"
        remembered_picture(lines, recording).save(path)
        written.append(path)
    return written


def write_page(
    folder: Path, name: str, findings: Findings, comparisons: Sequence[Comparison] = (), notes: Sequence[str] = ()
) -> Path:
    """Write `page.html` and `table.md` into the probe's folder."""
    parts = [f"<h1>What {escape(name)} takes from its memory</h1>"]
    texts = [f"# What {name} takes from its memory", ""]
    if notes:
        parts.append("<div class=note>" + "".join(f"<p>{escape(note)}</p>" for note in notes) + "</div>")
    if findings.moments:
        tables = [checkpoints_table({name: findings}), arms_table(findings), phases_table(findings)]
        parts.append(section("In short", html_table(tables[0]), UNITS))
        parts.append(section("Interventions", figures.effects(findings)))
        curves = [(f"Over the dial: {dial}", drawn, "Dashed: the policy's own spread.")
                  for dial, drawn in figures.dials(findings).items()]  # fmt: skip
        if findings.entries:
            curves.insert(0, ("Decay with distance", figures.decay(findings), "Each entry left out by itself."))
        parts += [pair(*curves[i : i + 2]) if i + 1 < len(curves) else section(*curves[i])
                  for i in range(0, len(curves), 2)]  # fmt: skip
        parts += [section(table.title, html_table(table)) for table in tables[1:]]
        texts += [to_markdown(table) for table in tables]
    drawn = sorted((folder / PICTURES).glob("*.png"))
    if drawn:
        parts.append(section("What was remembered", "".join(map(_embedded, drawn)),
                             "The moment of each task at which a single entry mattered most."))  # fmt: skip
    if comparisons:
        table = comparison_table(comparisons)
        parts.append(section("In closed loop", html_table(table), "; ".join(c.verdict for c in comparisons) + "."))
        texts += [to_markdown(table), *(f"- {comparison.verdict}" for comparison in comparisons)]
    texts += [f"- {note}" for note in notes]
    for file, text in ((PAGE, document(f"Probe of {name}", parts)), (TABLE, "\n".join(texts) + "\n")):
        with write_atomically(folder / file) as draft:
            draft.write_text(text, encoding="utf-8")
    return folder / PAGE


def table_of(findings: Mapping[str, Findings]) -> str:
    """Several checkpoints beside each other, in Markdown."""
    return to_markdown(checkpoints_table(dict(findings)))


def _embedded(path: Path) -> str:
    from PIL import Image

    out = BytesIO()
    with Image.open(path) as image:
        image.save(out, format="WEBP", quality=80)
    data = base64.b64encode(out.getvalue()).decode()
    return f'<img style="max-width:100%" alt="{escape(path.stem)}" src="data:image/webp;base64,{data}">'
