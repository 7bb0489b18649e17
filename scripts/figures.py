"""Draw the figures of docs/concepts from the embedded sample and the published numbers.

    # memory, history, budget, integration
    python scripts/figures.py
    python scripts/figures.py probe --probe outputs/probe      # from the folder of a finished probe
    python scripts/figures.py memory --output outputs/figures

Selections come from the memories themselves, at their full-size options, on episode 0 of
`dataset=sample` (VideoUnmask, 66 frames of video, 173 in all). No weights are needed, because these
selections read no tokens.
"""

import argparse
import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mme_vla.backbone.base import BackboneConfig, ExpertConfig, VisionConfig
from mme_vla.data.episodes import EpisodeSource
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

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "concepts" / "figures"
PUBLISHED = ROOT / "mme_vla" / "assets" / "paper"
VIDEO, EXECUTION, FAINT = "#7aa2cd", "#e9943e", "#8d99ae"
TILES = 7  # images a memory
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
    stored = history.to_encode(len(frames))
    history.append(frames, torch.zeros(len(stored), memory.storage.grid**2, 1))
    return history


def highlighted(frame: np.ndarray, patches: np.ndarray, grid: int) -> np.ndarray:
    """The frame [H, W, 3], in colour in the selected patches and pale elsewhere."""
    mask = np.isin(np.arange(grid**2), patches).reshape(grid, grid)
    large = np.kron(mask, np.ones((frame.shape[0] // grid, frame.shape[1] // grid), bool))[
        ..., None
    ]
    pale = 255 - (255 - frame.mean(2, keepdims=True)) * 0.35
    return np.where(large, frame, np.broadcast_to(pale, frame.shape)).astype(np.uint8)


def phases(axes: Axes, start: int, length: int) -> None:
    """Shade video and execution along the frames."""
    axes.axvspan(-0.5, start - 0.5, color=VIDEO, alpha=0.15, lw=0)
    axes.axvspan(start - 0.5, length - 0.5, color=EXECUTION, alpha=0.15, lw=0)
    axes.set_xlim(-1, length)


def memory(source: EpisodeSource) -> Figure:
    """What four memories read at the last step: a timeline each, and some of the frames with their
    patches.
    """
    start, length = int(source.exec_starts[EPISODE]), int(source.lengths[EPISODE])
    figure = plt.figure(figsize=(11, 10.5))
    parts = figure.subfigures(len(MEMORIES), 1)
    for part, (name, (kind, options, reads)) in zip(parts, MEMORIES.items(), strict=True):
        built = kind(WIDTH, WIDTH, **options)
        history = replay(built, source)
        selected = built.select(history, length - 1)
        counts = np.bincount(selected[:, 0], minlength=length)
        frames = np.flatnonzero(counts)
        place = {"left": 0.02, "right": 0.98, "bottom": 0.02, "top": 0.86, "hspace": 0.55}
        grid = part.add_gridspec(2, TILES, height_ratios=[0.35, 1], **place)
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
            [0, start, length - 1], ["0", f"{start}: execution", str(length - 1)], fontsize=8
        )
        part.suptitle(
            f"{name} at step {length - 1} reads {len(selected)} tokens in {len(frames)} frames:"
            f" {reads}",
            fontsize=11,
        )
        steps = frames[np.linspace(0, len(frames) - 1, min(TILES, len(frames))).round().astype(int)]
        images = source.frames(EPISODE, steps)
        for column, (frame, image) in enumerate(zip(steps.tolist(), images, strict=True)):
            axes = part.add_subplot(grid[1, column])
            axes.imshow(
                highlighted(image, selected[selected[:, 0] == frame, 1], built.storage.grid)
            )
            axes.set_title(f"frame {frame}, {counts[frame]} tokens", fontsize=8)
            axes.set_axis_off()
    return figure


def history(source: EpisodeSource) -> Figure:
    """Above, the frames that each step reads. Below, what is stored so far."""
    start, length = int(source.exec_starts[EPISODE]), int(source.lengths[EPISODE])
    figure, grid = plt.subplots(
        2, len(MEMORIES), figsize=(11, 5), height_ratios=[1.6, 1], layout="constrained"
    )
    for column, (name, (kind, options, _)) in enumerate(MEMORIES.items()):
        built, (raster, stored) = kind(WIDTH, WIDTH, **options), grid[:, column]
        past = replay(built, source)
        read = np.array(
            [np.bincount(built.select(past, t)[:, 0], minlength=length) for t in range(length)]
        )
        share = read / built.storage.grid**2
        raster.imshow(
            share.T**0.5,
            origin="lower",
            cmap="Blues",
            vmin=0,
            vmax=1,
            aspect="auto",
            interpolation="nearest",
        )
        raster.axhline(start, color=EXECUTION, lw=0.8)
        raster.axvline(start, color=EXECUTION, lw=0.8)
        raster.set(title=name, ylabel="frame that is read" if column == 0 else "")
        tokens = built.storage.grid**2
        kept = np.array([len(built.storage.stored_frames(t + 1)) for t in range(length)]) * tokens
        replans = [range(start, t + 1, REPLAN) for t in range(length)]
        needed = np.array([len(built.frames_read(steps, start)) for steps in replans]) * tokens
        stored.plot(kept * BYTES / 2**20, color=FAINT, label="every stored frame")
        stored.plot(
            needed * BYTES / 2**20, color="#1f6f8b", label=f"read by replans every {REPLAN} steps"
        )
        phases(stored, start, length)
        stored.set(xlabel="step", ylabel="MiB at full width" if column == 0 else "", ylim=(0, 46))
    grid[1, 0].legend(fontsize=7, frameon=False, loc="upper left")
    return figure


def budget(source: EpisodeSource) -> Figure:
    """Left, the frames that FrameSamp reads with each budget. Right, published success over the
    budget.
    """
    start, length = int(source.exec_starts[EPISODE]), int(source.lengths[EPISODE])
    with (PUBLISHED / "memory_budget.csv").open() as file:
        rows = list(csv.DictReader(file))
    budgets = [int(row["memory_tokens"]) for row in rows]
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(11, 3.4), width_ratios=[1.6, 1], layout="constrained"
    )
    for place, tokens in enumerate(budgets):
        built = FrameSamp(WIDTH, WIDTH, budget=tokens)
        frames = built.selected_frames(length - 1)
        left.plot(frames, np.full(len(frames), place), "|", ms=16, mew=1.6, color="#1f6f8b")
    phases(left, start, length)
    left.set_yticks(
        range(len(budgets)),
        [f"{tokens} tokens,\n{tokens // 16} frames" for tokens in budgets],
        fontsize=8,
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
        right.plot(
            budgets, [float(row[column]) for row in rows], "o-", label=f"{label} + modulator"
        )
    right.set_xscale("log", base=2)
    right.set_xticks(budgets, [str(tokens) for tokens in budgets])
    right.set(
        xlabel="memory tokens",
        ylabel="success (%)",
        title="published success on 16 tasks",
        ylim=(0, 50),
    )
    right.legend(frameon=False, fontsize=8)
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
    figure, panels = plt.subplots(1, len(kinds), figsize=(11, 3.2), layout="constrained")
    for axes, (name, built) in zip(panels, kinds.items(), strict=True):
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
                visible = key in built.visibility[query]
                colour = ("#1f6f8b" if key == "memory" else VIDEO) if visible else "#f1f3f6"
                axes.add_patch(Rectangle((column, row), 0.94, 0.94, color=colour, lw=0))
        axes.set(
            xlim=(-0.1, 4.1),
            ylim=(len(blocks) + 0.1, -0.1),
            aspect="equal",
            anchor="NW",
            title=name,
        )
        places = np.arange(len(blocks)) + 0.5
        axes.set_xticks(places, blocks, rotation=40, fontsize=8)
        axes.set_yticks(
            places,
            [f"{block}\n({experts.get(block, 'action')} expert)" for block in blocks],
            fontsize=7,
        )
        axes.tick_params(length=0)
        for side in axes.spines.values():
            side.set_visible(False)
    panels[0].set_ylabel("this block attends to …")
    panels[-1].text(
        1.5,
        5.0,
        "every layer of the action expert:\ncross-attention to memory,\nthen scale and shift",
        ha="center",
        va="center",
        fontsize=8,
        color="#1f6f8b",
    )
    return figure


def probe(folder: Path) -> Figure:
    """The change of the chunk under each intervention of a finished probe, beside the policy's own
    spread.
    """
    effects = probed_folder(folder).arms()
    names = sorted(effects, key=lambda arm: effects[arm].change)
    figure, axes = plt.subplots(figsize=(7, 0.4 * len(names) + 1.2), layout="constrained")
    bars = axes.barh(names, [effects[name].change for name in names], color="#1f6f8b")
    axes.bar_label(bars, fmt="%.2f", padding=3)
    axes.axvline(
        np.mean([each.spread for each in effects.values()]),
        color=EXECUTION,
        ls="--",
        label="own spread: noise alone",
    )
    axes.set_xlabel("change of the chunk, normalised actions")
    axes.legend(frameon=False)
    return figure


FIGURES: dict[str, Callable[[EpisodeSource], Figure]] = {
    "memory": memory, "history": history, "budget": budget, "integration": integration,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "figures",
        nargs="*",
        choices=[[], *FIGURES, "probe"],
        metavar="figure",
        help="by default all but probe",
    )
    parser.add_argument("--probe", type=Path, help="folder of a finished probe")
    parser.add_argument("--output", type=Path, default=FOLDER)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.figures or FIGURES:
        figure = probe(options.probe) if name == "probe" else FIGURES[name](EpisodeSource("sample"))
        path = options.output / f"{name}.webp"
        figure.savefig(path, dpi=110, pil_kwargs={"quality": 82, "method": 6})
        plt.close(figure)
        print(f"{path}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
