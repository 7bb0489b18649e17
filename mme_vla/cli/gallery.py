"""`mme-vla gallery`: the 16 tasks at a glance, one demonstrated episode each, on one page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from omegaconf import DictConfig
from PIL.Image import Image

from mme_vla.config.composition import resolved
from mme_vla.config.sections import PathText, Range, read_section
from mme_vla.data.console import progress
from mme_vla.envs import metadata
from mme_vla.envs.episodes import choose_episodes, named_tasks
from mme_vla.envs.make import make_task, require_simulator
from mme_vla.envs.observations import Include, Observer
from mme_vla.envs.subtasks import NO_RECORD
from mme_vla.errors import UserError, counted, require
from mme_vla.utils import read_text
from mme_vla.utils.media import RED, Tile, contact_sheet, evenly_spaced
from mme_vla.utils.pages import render

if TYPE_CHECKING:  # it imports the simulator, which is asked for first
    from mme_vla.envs.task import Task

MADE = "Made by `mme-vla gallery`."  # stands on each page
COLUMNS = 4  # images a row
EVERY = 8  # Steps between two images that are taken; which of them are shown is decided at the end


@dataclass(frozen=True)
class Snapshot:
    """The front view at one step."""

    step: int
    image: np.ndarray
    subtask: str
    video: bool


def demonstrate_with_images(task: "Task", every: int = EVERY) -> tuple[list[Snapshot], bool]:
    """Demonstrate a task, with an image every few steps; also returns whether it succeeded."""
    from mme_vla.envs.robomme.recording.recorder import demonstrate
    from mme_vla.envs.robomme.robot.demonstrator import Demonstrator

    task.reset()
    observer = Observer(task, Include(), render=True)
    snapshots: list[Snapshot] = []

    def capture(evaluated: dict[str, Any]) -> None:
        observer.follow()
        subtask = task.progress.displayed
        if task.steps_done % every == 1 and subtask.text != NO_RECORD:
            image = observer.frame(evaluated)["front_rgb"]
            snapshots.append(Snapshot(task.steps_done, image, subtask.text, subtask.video))

    task.on_frame = capture
    try:
        success = demonstrate(
            task, Demonstrator(task, lambda action: task.step(np.asarray(action, np.float32)))
        )
    finally:
        task.on_frame = None
    return snapshots, success


def strip(snapshots: Sequence[Snapshot], tiles: int) -> Image:
    """Some of the snapshots side by side, spread evenly, each with its step; video frames have a
    red border.
    """
    images = []
    for i in evenly_spaced(len(snapshots), tiles):
        shot = snapshots[i]
        if shot.video:
            images.append(Tile(shot.image, f"video, step {shot.step}", RED))
        else:
            images.append(Tile(shot.image, f"step {shot.step}"))
    return contact_sheet(images, COLUMNS)


@dataclass(frozen=True)
class Gallery:
    """The keys of `configs/show.yaml`, where each is explained.

    tasks: what `tasks` or `task` name.
    """

    tasks: str | tuple[str, ...]
    split: str
    episodes: Any
    tiles: Annotated[int, Range(least=2)]
    output: PathText


def main(cfg: DictConfig) -> None:
    """Draw the gallery as configs/show.yaml and the command line say."""
    config = resolved(cfg)
    gallery = read_section(Gallery, config, others=True, tasks=named_tasks(config))
    specs = choose_episodes(gallery.tasks, gallery.episodes, gallery.split)
    folder = Path(gallery.output)
    page = folder / "README.md"
    require(
        not page.exists() or MADE in read_text(page),
        f"{page} exists, and is no gallery: it is not replaced. Choose another output, or remove it"
        " yourself.",
    )
    require_simulator()
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    with progress("show", len(specs), unit="tasks") as advance:
        for spec in specs:
            env, snapshots = demonstrated(spec)
            several = sum(other.task == spec.task for other in specs) > 1
            image_name = f"{spec.task}-{spec.episode}.jpg" if several else f"{spec.task}.jpg"
            strip(snapshots, gallery.tiles).save(folder / image_name, quality=82)
            entries.append((spec.task, env.goals()[0], image_name))
            env.close()
            advance(1)
    names = list(dict.fromkeys(task for task, _, _ in entries))
    title = counted(len(names), "task") if len(names) > 1 else names[0]
    page.write_text(render("gallery.md", title=title, entries=entries))
    print(f"{page}: {counted(len(entries), 'task')}.")


def demonstrated(spec: metadata.EpisodeSpec) -> tuple["Task", list[Snapshot]]:
    """The first seed from the episode's on whose demonstration succeeds, as the official episodes
    were found.
    """
    from mme_vla.envs.robomme.scene.placement import SceneError

    for seed in range(spec.seed, spec.seed + (1 if spec.row else 100)):
        try:
            env = make_task(spec.task, render=True, **spec.options | {"seed": seed})
        except SceneError:
            continue
        snapshots, success = demonstrate_with_images(env)
        if success:
            return env, snapshots
        env.close()
    raise UserError(
        f"{spec.task}: no demonstration succeeded for seeds {spec.seed} … {spec.seed + 99}."
    )
