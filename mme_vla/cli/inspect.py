"""`mme-vla inspect`: what is in a checkpoint, a dataset or an episode, what a memory
remembers of it, and what a policy predicts along it.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from omegaconf import DictConfig
from rich.console import Console

from mme_vla.backbone.building import shape_of
from mme_vla.cli.inspect_checkpoint import (
    print_table,
    show_checkpoint,
    titled_table,
)
from mme_vla.cli.loading import words_of
from mme_vla.config.devices import find_device
from mme_vla.config.sections import PathText, PositiveInt, read_section, without
from mme_vla.config.trees import library_trees, yaml_files
from mme_vla.data.console import progress
from mme_vla.data.episodes import EpisodeSource, check_episode
from mme_vla.data.lerobot_files import SAMPLE, find_columns, read_info, resolve_root
from mme_vla.data.memory_image import memory_sheet
from mme_vla.data.recording import Recording, action_offset_of
from mme_vla.data.robot_draft import CHECK, draft_robot, save_draft
from mme_vla.data.sources import (
    compare_episodes,
    default_val_episodes,
    held_out_in,
    listed_sources,
)
from mme_vla.data.statistics import normalised_states
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.errors import UserError, counted, printable, require
from mme_vla.evaluation.records import display_name
from mme_vla.memory.base import Memory
from mme_vla.memory.history import History, OnlineHistory, TokenlessHistory
from mme_vla.policy import mme
from mme_vla.policy.base import Policy
from mme_vla.policy.build import policy_config
from mme_vla.policy.run_folders import STATE, resolve_checkpoint, shipped_name
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.self_check import NO_CHECK, compare
from mme_vla.training.checkpoint import read_state
from mme_vla.training.open_loop import (
    LEGEND,
    OpenLoop,
    decisions_of,
    error_lines,
    open_loop,
    plot_open_loop,
)
from mme_vla.training.settings import DataSettings
from mme_vla.types import FrameBatch


@dataclass(frozen=True)
class Inspection:
    """The keys of `configs/inspect.yaml`, where each is explained.

    embodiment, backbone, memory: sections that the parts' own classes read.
    """

    checkpoint: PathText | None
    dataset: PathText | None
    exec_starts: PathText | None
    episode: int | None
    step: int | None
    chunks: PositiveInt | None
    seed: int
    device: str
    output: PathText
    all: bool
    check: bool
    trust_plugins: bool
    embodiment: Mapping[str, Any]
    backbone: Mapping[str, Any]
    memory: Mapping[str, Any] | None

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration, plain and resolved."""
        return read_section(cls, config, others=True)


def main(cfg: DictConfig) -> None:
    """Print what `checkpoint`, `dataset` or `episode` holds, and for an episode draw its memory.

    With `checkpoint` and `dataset` the policy is checked open loop on an episode; with `step` too,
    its memory at that step is drawn.
    """
    inspection = Inspection.from_config(policy_config(cfg))
    console = Console(markup=False)
    if inspection.check:
        show_self_check(inspection, console)
        return
    if inspection.checkpoint is not None and inspection.dataset is not None:
        if inspection.step is None:
            check_open_loop(inspection, console)
        else:
            draw_policy_memory(inspection, console)
        return
    if inspection.checkpoint is not None:
        show_checkpoint(
            Path(inspection.checkpoint), console, inspection.trust_plugins, inspection.all
        )
        return
    require(
        inspection.dataset is not None,
        "Name one thing to inspect: checkpoint=<folder>, or dataset=<folder> (`sample` is built"
        " in). Both together compare predicted with recorded actions.",
    )
    assert inspection.dataset is not None
    robot = Embodiment.from_dict(inspection.embodiment)
    if show_unknown_robot(inspection.dataset, robot, Path(inspection.output), console):
        return
    source = EpisodeSource(inspection.dataset, inspection.exec_starts, robot=robot)
    if inspection.episode is None:
        require(
            inspection.step is None,
            f"step={inspection.step} is a frame of an episode: add episode=…, or leave step out to"
            " list the dataset's episodes.",
        )
        show_dataset(source, console)
        return
    episode, step = check_place(source, inspection.episode, inspection.step)
    show_episode(source, episode, step, console)
    if inspection.memory is None:
        return
    memory = build_memory(inspection)
    name = str(inspection.memory["name"])
    try:
        image = draw_memory(source, episode, step, memory, name, Path(inspection.output), console)
        text = str(image)
    except UserError as error:
        if words_of("memory"):
            raise
        text = f"none of memory={name}, the default. {error}"
    console.print(f"image: {text}", highlight=False, soft_wrap=True)


def show_self_check(inspection: Inspection, console: Console) -> None:
    """Print whether `checkpoint` predicts what it predicted where it was trained.

    Raises:
        UserError: it does not, or its self-check is damaged.
    """
    require(
        inspection.checkpoint is not None and inspection.dataset is None,
        "check=true compares a checkpoint with its own self-check: name checkpoint=<folder>, and"
        " no dataset.",
    )
    assert inspection.checkpoint is not None
    folder = resolve_checkpoint(Path(inspection.checkpoint))
    device = find_device(inspection.device)
    policy = Policy.from_pretrained(folder, device=device, trust_plugins=inspection.trust_plugins)
    result = compare(policy, folder)
    if result is None:
        console.print(NO_CHECK, highlight=False, soft_wrap=True)
        return
    require(result.passed, result.line)
    console.print(result.line, highlight=False, soft_wrap=True)


def open_both(inspection: Inspection) -> tuple[Policy, str, EpisodeSource, Path]:
    """The policy of `checkpoint`, its name, `dataset` of its robot, and the checkpoint's folder."""
    assert inspection.checkpoint is not None and inspection.dataset is not None
    named = words_of("embodiment", "env", "backbone", "memory")
    require(
        not named, f"A checkpoint brings its own robot and memory: leave out {' '.join(named)}."
    )
    folder = resolve_checkpoint(Path(inspection.checkpoint))
    device = find_device(inspection.device)
    policy = Policy.from_pretrained(folder, device=device, trust_plugins=inspection.trust_plugins)
    name = str(PolicySections.of(policy.config).name or "policy")
    name = display_name(name, shipped_name(folder) or str(folder))
    source = EpisodeSource(inspection.dataset, inspection.exec_starts, robot=policy.embodiment)
    return policy, name, source, folder


@torch.no_grad()
def draw_policy_memory(inspection: Inspection, console: Console) -> None:
    """Draw what the memory of `checkpoint` selects at `step` of an episode of `dataset`."""
    episode = inspection.episode
    if episode is None:
        raise UserError(
            f"step={inspection.step} draws the memory of a checkpoint at that frame of an episode:"
            " add episode=…, or leave step out to compare actions."
        )
    policy, name, source, _ = open_both(inspection)
    memory = policy.require_memory()
    episode, step = check_place(source, episode, inspection.step)
    recording = Recording(source, episode, action_offset_of(policy))
    running = policy.start_episode(source.goal(episode, step))
    required = policy.frames_read(np.array([step]), recording.exec_start)
    recording.show(running, 0, step + 1, required)
    history = running.required_history()
    image = draw_memory(
        source, episode, step, memory, name, Path(inspection.output), console, history
    )
    console.print(f"image: {image}", highlight=False, soft_wrap=True)


def check_open_loop(inspection: Inspection, console: Console) -> OpenLoop:
    """Print and draw predicted against recorded actions along an episode of `dataset`, with the
    robot and the memory of `checkpoint`.
    """
    policy, name, source, folder = open_both(inspection)
    data = data_of(folder)
    held_out = None if data is None else held_out_episodes(source, *data)
    episode = inspection.episode
    if episode is None:
        episode = 0
        if held_out is not None and held_out.any():
            episode = int(np.flatnonzero(held_out)[0])
    check_episode(source, episode)
    kind = "new"
    if data is None:
        kind = ""
    elif held_out is not None:
        kind = "held-out" if held_out[episode] else "training"
    # The training state tells it of checkpoints of versions whose configuration did not.
    offset = action_offset_of(policy) if data is None else data[0].action_offset
    recording = Recording(source, episode, offset)
    title = f"{kind} {recording.described}".strip()
    total = len(decisions_of(recording, policy.embodiment.action.execute, inspection.chunks))
    with progress("chunks", total) as advance:
        result = open_loop(policy, recording, title, inspection.chunks, inspection.seed, advance)
    summary = result.summary()
    console.print(f"{name}, open loop on {title}", style="bold", soft_wrap=True, highlight=False)
    for line in (*error_lines(summary), LEGEND, result.verdict()):
        console.print(printable(line), highlight=False, soft_wrap=True)
    if kind == "training":
        console.print(
            "The policy was trained on this episode: a held-out one says more.", highlight=False
        )
    output = Path(inspection.output)
    output.mkdir(parents=True, exist_ok=True)
    path = output / f"{name}_{source.name}_episode{episode}_open_loop.png"
    plot_open_loop(result, path, name)
    console.print(f"plot: {path}", highlight=False, soft_wrap=True)
    return result


def data_of(checkpoint: Path) -> tuple[DataSettings, list[str]] | None:
    """The data that a checkpoint was trained on, with the fingerprint of each source; None where it
    does not tell, as weights without their training do not.
    """
    if not (checkpoint / STATE).is_file():
        return None
    section = read_state(checkpoint)["config"].get("data")
    if not isinstance(section, Mapping):
        return None
    content = section.get("content") or []
    settings = DataSettings.from_dict(without(section, "content", "side_files"))
    return settings, [str(text) for text in content]


def held_out_episodes(
    source: EpisodeSource, data: DataSettings, content: Sequence[str]
) -> np.ndarray | None:
    """Which episodes of a dataset a training held out, bool [e]; None where it is not among the
    training's data.
    """
    if source.fingerprint not in content:
        return None
    entries = listed_sources(data.sources)
    entry = entries[content.index(source.fingerprint)]
    # The split goes by the name that the dataset had then.
    source.name = entry.short_name
    texts: Sequence[int | str] | None = data.val_episodes
    if texts is None:
        texts = default_val_episodes([source])
    named = []
    for text in texts:
        name, _, number = str(text).rpartition("/")
        if name in ("", source.name):
            named.append(int(number))
    return held_out_in(source, named or None, data.val_fraction)


def show_unknown_robot(dataset: str, robot: Embodiment, output: Path, console: Console) -> bool:
    """Draft the YAML file of the robot that a dataset is of, where it does not fit the default one;
    whether it was so.
    """
    root = resolve_root(dataset)
    if robot.name != ROBOMME_JOINT.name:
        return False
    info = read_info(root)
    try:
        find_columns(root, info.features, robot)
    except UserError:
        draft = draft_robot(root, info, list(yaml_files(library_trees(), "embodiment")))
    else:
        return False
    path, is_new = save_draft(draft, output)
    console.print(
        f"{printable(str(root))} is of another robot than {robot.name}. A draft of its file:",
        highlight=False,
        soft_wrap=True,
    )
    console.print(f"\n{draft.text}", highlight=False, soft_wrap=True)
    if is_new:
        console.print(f"written to {path}", highlight=False, soft_wrap=True)
    else:
        console.print(f"not written: {path} exists and stays", highlight=False, soft_wrap=True)
    common = ["--config-dir", str(output), f"embodiment={draft.name}"]
    inspecting = shlex.join(["mme-vla", "inspect", *common, f"dataset={dataset}"])
    training = ["mme-vla", "train", *common, "model=framesamp_modul", "data=lerobot"]
    console.print(
        f"Check the {len(draft.open_lines)} lines marked “{CHECK}” (docs/extend/your-robot.md"
        f" explains them), then:\n  {inspecting}\n"
        f"  {shlex.join(training)} {shlex.quote(f'data.sources=[{dataset}]')}",
        highlight=False,
        soft_wrap=True,
    )
    return True


MOST_EPISODES = 40  # in the table of a dataset


def show_dataset(source: EpisodeSource, console: Console) -> None:
    """Print a dataset's episodes, at most `MOST_EPISODES` of them, and its totals."""
    compare_episodes([source])
    compared = source.verify()
    table = titled_table(
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
    print_table(table, console)
    subgoals = printable(", ".join(source.subgoal_names)) or "none"
    console.print(
        f"{frames - video} execution steps to train on · {source.fps:g} frames per second · images"
        f" as {'video' if source.video_cameras else 'images'} · subgoals: {subgoals}",
        highlight=False,
    )
    for what, names in (("state", source.state_names), ("action", source.robot.action.names)):
        if names:
            console.print(
                f"{what}: {counted(len(names), 'number')}: {printable(', '.join(names))}",
                highlight=False,
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
    start = int(source.exec_starts[episode])
    length = int(source.lengths[episode])
    table = titled_table(f"{source.name}, episode {episode}, step {step} of {length}", "", "")
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
    print_table(table, console)


def check_place(source: EpisodeSource, episode: int, step: int | None) -> tuple[int, int]:
    """The episode and step asked for; the last step by default."""
    check_episode(source, episode)
    length = int(source.lengths[episode])
    step = length - 1 if step is None else step
    require(
        0 <= step < length,
        f"step={step}: episode {episode} of {source.name} has frames 0 … {length - 1}.",
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
    history: History | None = None,
) -> Path:
    """Draw what `memory` remembers at `step` into a PNG in `folder`, and print it in numbers.

    history: the episode so far, of a policy; None for a memory alone, without tokens.
    """
    frames = source.frames(episode, np.arange(step + 1))
    start = int(source.exec_starts[episode])
    stored = memory.storage.stored_frames(len(frames))
    if history is None:
        filled = OnlineHistory(memory.storage, memory.make_scorer(), start)
        patches = memory.storage.grid**2
        filled.take(FrameBatch.of(frames), lambda images: torch.zeros(len(images), patches, 1))
        motion = normalised_states(source.states(episode, 0, step + 1))
        filled.motion = motion.__getitem__
        filled.state_width = motion.shape[1]
        history = TokenlessHistory(filled)
    selected = memory.select(history, step)
    remembered = np.unique(selected[:, 0])
    table = titled_table(f"{name} at step {step}", "", "")
    table.add_row(
        "remembers",
        f"{len(selected)} of {counted(memory.capacity, 'token')}, in {len(remembered)} of"
        f" {counted(step + 1, 'frame')}",
    )
    table.add_row("frames", ", ".join(map(str, remembered)))
    table.add_row(
        "stored",
        f"{counted(len(stored), 'frame')} of {memory.storage.grid}×{memory.storage.grid} tokens",
    )
    print_table(table, console)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{source.name}_episode{episode}_step{step}_{name}.png"
    title = (
        f"{name} at step {step}: {len(selected)} of {memory.capacity} tokens ·"
        f" {source.goal(episode, step)}"
    )
    memory_sheet(frames, selected, memory.storage.grid, start, step, title).save(path)
    return path


def _numbers(values: np.ndarray, names: Sequence[str]) -> str:
    """Numbers behind their names, where they have names."""
    if not names:
        return ", ".join(f"{x:.3f}" for x in values)
    return ", ".join(f"{name}: {x:.3f}" for name, x in zip(names, values, strict=True))
