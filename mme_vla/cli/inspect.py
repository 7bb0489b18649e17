"""`python -m mme_vla.inspect`: what is in a checkpoint, a dataset or an episode, and what a memory
remembers of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from mme_vla.backbone.building import shape_of
from mme_vla.config.composition import resolved
from mme_vla.config.sections import PathText, read_section
from mme_vla.data.episodes import EpisodeSource, check_episode
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.data.memory_image import memory_sheet
from mme_vla.data.statistics import normalised_states
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.action_space import numbered
from mme_vla.errors import UserError, printable
from mme_vla.memory.base import Memory
from mme_vla.memory.history import OnlineHistory
from mme_vla.policy import mme
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import STATE, resolve_checkpoint
from mme_vla.training.checkpoint import read_state


@dataclass(frozen=True)
class Inspection:
    """The keys of `configs/inspect.yaml`, where each is explained.

    embodiment, backbone, memory: sections that the parts' own classes read.
    """

    checkpoint: str | None
    dataset: str | None
    exec_starts: str | None
    episode: int | None
    step: int | None
    output: PathText
    trust_plugins: bool
    embodiment: Mapping[str, Any]
    backbone: Mapping[str, Any]
    memory: Mapping[str, Any] | None

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration, plain and resolved."""
        return read_section(cls, config, others=True)


def main(cfg: DictConfig) -> None:
    """Print what `checkpoint`, `dataset` or `episode` holds; for an episode, also draw its
    memory.
    """
    inspection = Inspection.from_config(resolved(cfg))
    console = Console(markup=False)
    if (inspection.checkpoint is None) == (inspection.dataset is None):
        raise UserError(
            "Name one thing to inspect: checkpoint=<folder>, or dataset=<folder> (`sample` is built"
            " in)."
        )
    if inspection.checkpoint is not None:
        show_checkpoint(Path(inspection.checkpoint), console, inspection.trust_plugins)
        return
    assert inspection.dataset is not None
    robot = Embodiment.from_dict(inspection.embodiment)
    source = EpisodeSource(inspection.dataset, inspection.exec_starts, robot=robot)
    if inspection.episode is None:
        show_dataset(source, console)
        return
    episode, step = check_place(source, inspection.episode, inspection.step)
    show_episode(source, episode, step, console)
    if inspection.memory is None:
        return
    memory = build_memory(inspection)
    name = str(inspection.memory["name"])
    image = draw_memory(source, episode, step, memory, name, Path(inspection.output), console)
    console.print(f"image: {image}", highlight=False, soft_wrap=True)


def show_checkpoint(folder: Path, console: Console, trust_plugins: bool = False) -> None:
    """Print a checkpoint's parts, training state and normalisation statistics.

    With `trust_plugins` the modules that the checkpoint names are imported.
    """
    folder = resolve_checkpoint(folder)
    policy = Policy.from_pretrained(folder, trust_plugins=trust_plugins)
    table = _table(str(folder), "part", "tensors", "parameters", "dtype")
    parts: dict[str, list[Any]] = {}
    for name, parameter in policy.named_parameters():
        parts.setdefault(policy.finetune_spec.component_of(name), []).append(parameter)
    for part, tensors in parts.items():
        dtypes = sorted({str(t.dtype).removeprefix("torch.") for t in tensors})
        count = sum(t.numel() for t in tensors)
        table.add_row(part, str(len(tensors)), f"{count:,}", ", ".join(dtypes))
    total = list(policy.parameters())
    count = sum(t.numel() for t in total)
    table.add_row("all", str(len(total)), f"{count:,}", "", style="bold")
    _show(table, console)
    settings = _table("configuration", "section", "values")
    for name, section in policy.config.items():
        settings.add_row(name, _summary(section))
    settings.add_row("words", printable(policy.require_processor().prompt_spec.encoder))
    if (folder / STATE).is_file():
        state = read_state(folder)
        settings.add_row(
            "trained for", f"{state['step']} steps; weights here are averages, raw ones beside them"
        )
        settings.add_row("recipe", _summary(state["config"].get("train", {})))
        settings.add_row("data", _summary(state["config"].get("data", {})))
        settings.add_row("versions", _summary(state["versions"]))
    _show(settings, console)
    stats = policy.require_processor().stats
    if stats is not None:
        space = policy.embodiment.action
        action = "action delta" if space.relative or space.of_pose else "action"
        for title, of, names in (
            ("state", stats.state, numbered(len(stats.state))),
            (action, stats.actions, space.names),
        ):
            # Extremes are kept where a policy normalises by them.
            bounds = {}
            for bound in ("min", "q01", "q99", "max"):
                if getattr(of, bound) is not None:
                    bounds[bound] = getattr(of, bound)
            numbers = _table(f"normalisation of the {title}", "number", *bounds)
            for i, name in enumerate(names):
                numbers.add_row(name, *(f"{values[i]:.3f}" for values in bounds.values()))
            _show(numbers, console)


MOST_EPISODES = 40  # in the table of a dataset


def show_dataset(source: EpisodeSource, console: Console) -> None:
    """Print a dataset's episodes, at most `MOST_EPISODES` of them, and its totals."""
    compared = source.verify()
    table = _table(
        f"{source.name} ({source.root})",
        "episode",
        "task",
        "frames",
        "of them video",
        "seconds",
        "goal",
    )
    for episode in range(min(len(source), MOST_EPISODES)):
        frames = int(source.lengths[episode])
        table.add_row(
            str(episode),
            printable(source.task(episode)),
            str(frames),
            str(source.exec_starts[episode]),
            f"{frames / source.fps:.1f}",
            printable(" → ".join(source.goals(episode))),
        )
    if len(source) > MOST_EPISODES:
        table.add_row("…", f"{len(source) - MOST_EPISODES} more")
    frames = int(source.lengths.sum())
    video = int(source.exec_starts.sum())
    table.add_row(
        "all", "", str(frames), str(video), f"{frames / source.fps:.1f}", "", style="bold"
    )
    _show(table, console)
    subgoals = printable(", ".join(source.subgoal_names)) or "none"
    console.print(
        f"{frames - video} execution steps to train on · {source.fps:g} frames per second · images"
        f" as {'video' if source.video_cameras else 'images'} · subgoals: {subgoals}",
        highlight=False,
    )
    for what, names in (("state", source.state_names), ("action", source.robot.action.names)):
        if names:
            console.print(
                f"{what}: {len(names)} numbers: {printable(', '.join(names))}", highlight=False
            )
    if compared:
        checksums = f"all {compared} files are as they were written"
    elif source.root == SAMPLE:
        checksums = "none, this dataset ships with the library"
    else:
        checksums = "none, so damage to images or numbers cannot be noticed"
    console.print(f"checksums: {checksums}", highlight=False)


def show_episode(source: EpisodeSource, episode: int, step: int, console: Console) -> None:
    """Print an episode's phases, and what is recorded at one step."""
    start, length = int(source.exec_starts[episode]), int(source.lengths[episode])
    table = _table(f"{source.name}, episode {episode}, step {step} of {length}", "", "")
    table.add_row("task", printable(source.task(episode)))
    table.add_row("goal", printable(source.goal(episode, step)))
    table.add_row("video", f"frames 0 … {start - 1}" if start else "none")
    table.add_row("execution", f"frames {start} … {length - 1}")
    for name, text in source.subgoals(episode, step).items():
        table.add_row(name, printable(text))
    table.add_row("state", _numbers(source.states(episode, step, step + 1)[0], source.state_names))
    table.add_row(
        "action", _numbers(source.actions(episode, step, step + 1)[0], source.robot.action.names)
    )
    _show(table, console)


def check_place(source: EpisodeSource, episode: int, step: int | None) -> tuple[int, int]:
    """The episode and step asked for; the last step by default."""
    check_episode(source, episode)
    length = int(source.lengths[episode])
    step = length - 1 if step is None else step
    if not 0 <= step < length:
        raise UserError(
            f"step={step}: episode {episode} of {source.name} has frames 0 … {length - 1}."
        )
    return episode, step


def build_memory(inspection: Inspection) -> Memory:
    """The memory that is named, of any width: it is only asked to select."""
    if inspection.memory is None:
        raise UserError("memory=none: name a memory, such as memory=tokendrop.")
    shape = shape_of(inspection.backbone)
    return mme.build_memory(inspection.memory, shape.vision_width, shape.grid, shape.vision_width)


def draw_memory(
    source: EpisodeSource,
    episode: int,
    step: int,
    memory: Memory,
    name: str,
    folder: Path,
    console: Console,
) -> Path:
    """Draw what `memory` remembers at `step` into a PNG in `folder`, and print it in numbers."""
    frames = source.frames(episode, np.arange(step + 1))
    history = OnlineHistory(memory.storage, memory.make_scorer(), int(source.exec_starts[episode]))
    stored, patches = history.to_encode(len(frames)), memory.storage.grid**2
    history.append(frames, torch.zeros(len(stored), patches, 1))  # selections do not read tokens
    motion = normalised_states(source.states(episode, 0, step + 1))
    history.motion, history.state_width = motion.__getitem__, motion.shape[1]
    selected = memory.select(history, step)
    remembered = np.unique(selected[:, 0])
    table = _table(f"{name} at step {step}", "", "")
    table.add_row(
        "remembers",
        f"{len(selected)} of {memory.budget} tokens, in {len(remembered)} of {step + 1} frames",
    )
    table.add_row("frames", ", ".join(map(str, remembered)))
    table.add_row(
        "stored", f"{len(stored)} frames of {memory.storage.grid}×{memory.storage.grid} tokens"
    )
    _show(table, console)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{source.name}_episode{episode}_step{step}_{name}.png"
    title = (
        f"{name} at step {step}: {len(selected)} of {memory.budget} tokens ·"
        f" {source.goal(episode, step)}"
    )
    start = int(source.exec_starts[episode])
    memory_sheet(frames, selected, memory.storage.grid, start, step, title).save(path)
    return path


def _table(title: str, *columns: str) -> Table:
    table = Table(title=printable(title), show_header=any(columns))
    for i, column in enumerate(columns):
        table.add_column(
            column,
            justify="left" if i == 0 or column in ("goal", "values", "task", "") else "right",
        )
    return table


def _show(table: Table, console: Console) -> None:
    """Print a table under its title, which may be wider: a path is not broken."""
    console.print(table.title, style="bold", markup=False, highlight=False, soft_wrap=True)
    table.title = None
    console.print(table)


def _summary(value: Any) -> str:
    if isinstance(value, dict):
        parts = []
        for key, inner in value.items():
            text = _summary(inner)
            parts.append(f"{key}={{{text}}}" if isinstance(inner, dict) else f"{key}={text}")
        return ", ".join(parts)
    return printable(str(value))


def _numbers(values: np.ndarray, names: Sequence[str]) -> str:
    """Numbers behind their names, where they have names."""
    if not names:
        return ", ".join(f"{x:.3f}" for x in values)
    return ", ".join(f"{name}: {x:.3f}" for name, x in zip(names, values, strict=True))
