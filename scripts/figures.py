"""Draw the figures of docs/concepts from the embedded sample and the published numbers.

    # memory, history, budget, integration
    python scripts/figures.py
    # from the folder of a finished probe
    python scripts/figures.py probe --probe outputs/probe
    python scripts/figures.py probe ages entries --probe P --recordings R --output docs/images
    python scripts/figures.py memory --output outputs/figures

Selections come from the memories themselves, at their full-size options, on episode 0 of
`dataset=sample` (VideoUnmask, 66 frames of video, 173 in all). No weights are needed, because these
selections read no tokens.
"""

import argparse
import base64
import csv
import re
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from PIL import Image
from PIL.Image import Image as Picture

from mme_vla.backbone.base import BackboneConfig, ExpertConfig, VisionConfig
from mme_vla.data.episodes import EpisodeSource
from mme_vla.extras.probing.findings import Findings
from mme_vla.extras.probing.recordings import all_recordings
from mme_vla.extras.probing.report import decay, effects, remembered_image
from mme_vla.extras.probing.run import probed_folder
from mme_vla.integration.base import Integration
from mme_vla.integration.context import Context, MemoryExpert
from mme_vla.integration.modulator import Modulator
from mme_vla.memory.base import MemoryModule
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.memory.history import OnlineHistory
from mme_vla.memory.rmt import RMT
from mme_vla.memory.tokendrop import TokenDrop
from mme_vla.memory.ttt import TTT
from mme_vla.types import FrameBatch
from mme_vla.utils.style import COLOURS, EXECUTION, FAINT, LINE, VIDEO, log_scale, look, rgb, svg

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "concepts" / "figures"
PUBLISHED = ROOT / "mme_vla" / "assets" / "paper"
WIDTH_IN = 7.6  # inches: the column of the site, so that letters keep their size
TILES = 6  # images a memory
REPLAN = 16  # steps of a chunk that are executed
EPISODE, WIDTH = 0, 8
"""The sample's episode, and a token width: selections do not depend on it."""
BYTES = 2 * 2048
"""Of a stored token at full size, in bfloat16."""
MEMORIES: dict[str, tuple[type[MemoryModule], dict[str, Any], str]] = {
    "FrameSamp": (FrameSamp, {}, "16 tokens of each"),
    "TokenDrop": (TokenDrop, {}, "its changed patches"),
    "TTT": (TTT, {"hidden": 64}, "64 tokens of each, into fast weights"),
    "RMT": (RMT, {"hidden": 64, "heads": 2}, "64 tokens of each, into slots"),
}


def replay(memory: MemoryModule, source: EpisodeSource) -> OnlineHistory:
    """The history of the whole episode, as an episode in closed loop builds it."""
    frames = source.frames(EPISODE, np.arange(int(source.lengths[EPISODE])))
    history = OnlineHistory(memory.storage, memory.make_scorer(), int(source.exec_starts[EPISODE]))
    patches = memory.storage.grid**2
    history.take(FrameBatch.of(frames), lambda images: torch.zeros(len(images), patches, 1))
    return history


def highlighted(frame: np.ndarray, patches: np.ndarray, grid: int) -> np.ndarray:
    """The frame [H, W, 4], in colour in the selected patches, grey and faint elsewhere."""
    mask = np.isin(np.arange(grid**2), patches).reshape(grid, grid)
    large = np.kron(mask, np.ones((frame.shape[0] // grid, frame.shape[1] // grid), bool))
    grey = np.broadcast_to(frame.mean(2, keepdims=True), frame.shape)
    image = np.where(large[..., None], frame, grey)
    alpha = np.where(large, 255, 90)[..., None]
    return np.concatenate([image, alpha], 2).astype(np.uint8)


def phases(axes: Axes, start: int, length: int) -> None:
    """Shade video and execution along the frames."""
    axes.axvspan(-0.5, start - 0.5, color=VIDEO, alpha=0.15, lw=0)
    axes.axvspan(start - 0.5, length - 0.5, color=EXECUTION, alpha=0.15, lw=0)
    axes.set_xlim(-1, length)
    axes.grid(False)


def memory(source: EpisodeSource) -> Figure:
    """What four memories read at the last step: a timeline each, and some of the frames with their
    patches.
    """
    start, length = int(source.exec_starts[EPISODE]), int(source.lengths[EPISODE])
    figure = Figure((WIDTH_IN, 10.4))
    parts = figure.subfigures(len(MEMORIES), 1)
    for part, (name, (kind, options, reads)) in zip(parts, MEMORIES.items(), strict=True):
        built = kind(WIDTH, WIDTH, **options)
        history = replay(built, source)
        selected = built.select(history, length - 1)
        counts = np.bincount(selected[:, 0], minlength=length)
        frames = np.flatnonzero(counts)
        place = {"left": 0.01, "right": 0.99, "bottom": 0.01, "top": 0.87, "hspace": 0.75}
        grid = part.add_gridspec(2, TILES, height_ratios=[0.3, 1], wspace=0.06, **place)
        line = part.add_subplot(grid[0, :])
        line.bar(
            frames,
            counts[frames],
            width=0.9,
            color=[VIDEO if f < start else EXECUTION for f in frames],
        )
        phases(line, start, length)
        line.set_yticks([])
        line.set_xticks(
            [0, start, length - 1], ["0", f"{start}: execution begins", str(length - 1)], fontsize=9
        )
        line.spines["left"].set_visible(False)
        line.get_xticklabels()[-1].set_ha("right")
        part.suptitle(
            f"{name} at step {length - 1} reads {len(selected)} tokens in {len(frames)} frames:"
            f" {reads}",
            x=0.01,
            ha="left",
            fontsize=11,
        )
        steps = frames[np.linspace(0, len(frames) - 1, min(TILES, len(frames))).round().astype(int)]
        images = source.frames(EPISODE, steps)
        for column, (frame, image) in enumerate(zip(steps.tolist(), images, strict=True)):
            axes = part.add_subplot(grid[1, column])
            axes.imshow(
                highlighted(image, selected[selected[:, 0] == frame, 1], built.storage.grid)
            )
            axes.set_title(f"frame {frame}\n{counts[frame]} tokens", fontsize=9)
            axes.set_axis_off()
    return figure


def history(source: EpisodeSource) -> Figure:
    """Above, the frames that each step reads. Below, what is stored so far."""
    start, length = int(source.exec_starts[EPISODE]), int(source.lengths[EPISODE])
    figure = Figure((WIDTH_IN, 4.6), layout="constrained")
    grid = figure.subplots(2, len(MEMORIES), height_ratios=[1.6, 1], sharex=True, sharey="row")
    for column, (name, (kind, options, _)) in enumerate(MEMORIES.items()):
        built, (raster, stored) = kind(WIDTH, WIDTH, **options), grid[:, column]
        past = replay(built, source)
        read = np.array(
            [np.bincount(built.select(past, t)[:, 0], minlength=length) for t in range(length)]
        )
        share = read / built.storage.grid**2
        # One colour, as strong as the share of the frame: the ground is the page's own.
        image = np.zeros((length, length, 4), np.uint8)
        image[..., :3] = rgb("raster")
        image[..., 3] = 255 * share.T**0.5
        raster.imshow(image, origin="lower", aspect="auto", interpolation="nearest")
        raster.grid(False)
        raster.axhline(start, color=EXECUTION, lw=0.8)
        raster.axvline(start, color=EXECUTION, lw=0.8)
        raster.set(title=name, ylabel="frame that is read" if column == 0 else "")
        tokens = built.storage.grid**2
        kept = np.array([len(built.storage.stored_frames(t + 1)) for t in range(length)]) * tokens
        replans = [range(start, t + 1, REPLAN) for t in range(length)]
        needed = np.array([len(built.frames_read(steps, start)) for steps in replans]) * tokens
        stored.plot(kept * BYTES / 2**20, color=FAINT, label="every stored frame")
        stored.plot(
            needed * BYTES / 2**20, color=COLOURS[0], label=f"read by replans every {REPLAN} steps"
        )
        phases(stored, start, length)
        stored.set(xlabel="step", ylabel="MiB at full width" if column == 0 else "", ylim=(0, 46))
        stored.set_xticks([0, start, length - 1])
    labels = grid[1, 0].get_legend_handles_labels()
    figure.legend(*labels, loc="outside lower center", ncols=2)
    return figure


def budget(source: EpisodeSource) -> Figure:
    """Left, the frames that FrameSamp reads with each budget. Right, published success over the
    budget.
    """
    start, length = int(source.exec_starts[EPISODE]), int(source.lengths[EPISODE])
    with (PUBLISHED / "memory_budget.csv").open() as file:
        rows = list(csv.DictReader(file))
    budgets = [int(row["memory_tokens"]) for row in rows]
    figure = Figure((WIDTH_IN, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    for place, tokens in enumerate(budgets):
        built = FrameSamp(WIDTH, WIDTH, budget=tokens)
        frames = built.selected_frames(length - 1)
        left.plot(frames, np.full(len(frames), place), "|", ms=16, mew=1.4, color=COLOURS[0])
    phases(left, start, length)
    left.set_yticks(
        range(len(budgets)),
        [f"{tokens:,} tokens\n{tokens // 16} frames" for tokens in budgets],
        fontsize=9,
    )
    left.set(
        xlabel="frame",
        title=f"frames that FrameSamp reads at step {length - 1}",
        ylim=(-0.6, len(budgets) - 0.4),
    )
    for column, label in (
        ("framesamp_modul_success", "FrameSamp"),
        ("tokendrop_modul_success", "TokenDrop"),
    ):
        right.plot(budgets, [float(row[column]) for row in rows], "o-", ms=5, label=label)
    log_scale(right.xaxis, budgets)
    right.set(
        xlabel="memory tokens",
        ylabel="success (%)",
        title="published success, modulator",
        ylim=(0, 50),
    )
    right.legend(loc="lower right")
    return figure


def integration(source: EpisodeSource) -> Figure:
    """The visibility table of each integration: which block attends to which, and the expert that
    processes it.
    """
    small = VisionConfig(image_size=32, patch_size=2, width=8, depth=1, mlp_dim=8, num_heads=1)
    sizes = BackboneConfig(
        small, vlm=ExpertConfig(8, 8), action=ExpertConfig(8, 8), depth=1, head_dim=8, vocab_size=8
    )
    kinds: dict[str, Integration] = {
        "no memory": Integration(sizes),
        "context": Context(sizes),
        "expert": MemoryExpert(sizes),
        "modulator": Modulator(sizes),
    }
    figure = Figure((WIDTH_IN, 4.6), layout=ConstrainedLayoutEngine(rect=(0, 0, 0.97, 1)))
    panels = figure.subplots(2, 2)  # left of an edge that letters of a browser would cross
    for axes, (name, built) in zip(panels.flat, kinds.items(), strict=True):
        experts = {
            "memory": "VLM" if name == "context" else "memory",
            "images": "VLM",
            "prompt": "VLM",
        }
        blocks = [
            block for block in ("memory", "images", "prompt", "action") if block in built.visibility
        ]
        for row, query in enumerate(blocks):
            for column, key in enumerate(blocks):
                colour = LINE
                if key in built.visibility[query]:
                    colour = COLOURS[1] if key == "memory" else COLOURS[0]
                axes.add_patch(Rectangle((column, row), 0.94, 0.94, color=colour, lw=0))
        axes.set(
            xlim=(-0.1, 4.1), ylim=(len(blocks) + 0.1, -0.1), aspect="equal", anchor="NW",
        )  # fmt: skip
        axes.set_title(name, loc="left")
        axes.grid(False)
        places = np.arange(len(blocks)) + 0.47
        axes.set_xticks(places, blocks, rotation=35, ha="right", rotation_mode="anchor")
        axes.set_yticks(
            places, [f"{block} ({experts.get(block, 'action')} expert)" for block in blocks]
        )
        axes.tick_params(length=0, labelsize=9)
        for side in axes.spines.values():
            side.set_visible(False)
    for axes in panels[:, 0]:
        axes.set_ylabel("this block attends to …", fontsize=9)
    note = (
        "and every layer\nof the action expert:\ncross-attention to\nmemory, then scale\nand shift"
    )
    panels[1, 1].text(3.15, 1.5, note, va="center", fontsize=9, color=COLOURS[1])
    return figure


def entries(findings: Findings, recordings: Path) -> Picture:
    """The step of a probe at which an entry mattered most: its entries and the current frame."""
    (lines,) = findings.matters_most().values()  # of the one task
    by_name = {each.name: each for each in all_recordings([EpisodeSource(str(recordings))])}
    return remembered_image(lines, by_name[lines[0].recording], columns=3)


def with_webp(text: str) -> str:
    """The SVG with its photographs as WebP, a tenth of the bytes."""

    def smaller(match: re.Match[str]) -> str:
        out = BytesIO()
        image = Image.open(BytesIO(base64.b64decode(match[1])))
        image.save(out, "WEBP", quality=80, method=6)
        return f"data:image/webp;base64,{base64.b64encode(out.getvalue()).decode()}"

    return re.sub(r"data:image/png;base64,\s*([^\"]+)", smaller, text)


FIGURES: dict[str, Callable[[EpisodeSource], Figure]] = {
    "memory": memory, "history": history, "budget": budget, "integration": integration,
}  # fmt: skip
PROBED: dict[str, Callable[[Findings], str]] = {"probe": effects, "ages": decay}
"""Figures of a finished probe, as on its page."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "figures",
        nargs="*",
        choices=[[], *FIGURES, *PROBED, "entries"],
        metavar="figure",
        help="by default all but those of a probe: probe, ages and entries",
    )
    parser.add_argument("--probe", type=Path, help="folder of a finished probe")
    parser.add_argument(
        "--recordings", type=Path, help="recorded episodes of the probe, for entries"
    )
    parser.add_argument("--output", type=Path, default=FOLDER)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.figures or FIGURES:
        path = options.output / f"{name}.svg"
        if name == "entries":
            path = path.with_suffix(".webp")
            image = entries(probed_folder(options.probe), options.recordings)
            image.save(path, "WEBP", quality=85, method=6)
        elif name in PROBED:
            path.write_text(PROBED[name](probed_folder(options.probe)), encoding="utf-8")
        else:
            with look():
                figure = FIGURES[name](EpisodeSource("sample"))
                path.write_text(with_webp(svg(figure)), encoding="utf-8")
        print(f"{path}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
