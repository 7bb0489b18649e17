"""`mme-vla gallery`: the 16 tasks at a glance, one demonstrated episode each, on one page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from omegaconf import DictConfig
from PIL.Image import Image

from mme_vla.config.composition import resolved
from mme_vla.config.sections import PathText, Range, read_section
from mme_vla.data.console import progress
from mme_vla.envs import metadata
from mme_vla.envs.episodes import choose_episodes, named_tasks
from mme_vla.envs.make import make_task, require_simulator
from mme_vla.envs.observations import RenderRequest
from mme_vla.errors import SceneError, UserError, counted, require
from mme_vla.utils import read_text, write_text
from mme_vla.utils.media import RED, Tile, contact_sheet, evenly_spaced
from mme_vla.utils.pages import render

if TYPE_CHECKING:  # it imports the simulator, which is asked for first
    from mme_vla.envs.task import Task

MADE = "Made by `mme-vla gallery`."  # stands on each page
COLUMNS = 4  # images a row
EVERY = 8  # steps between two images that are taken; which are shown is decided at the end


def demonstrate_with_images(task: "Task", every: int = EVERY) -> tuple[list[Tile], bool]:
    """Demonstrate a task, with a front view of every few steps, each with its step; views of the
    video have a red border. Also returns whether it succeeded.
    """
    from mme_vla.envs.robomme.recording.recorder import RecordedStep, Recorder

    views: list[Tile] = []

    def keep_view(step: RecordedStep) -> None:
        image = step.obs.get("front_rgb")
        if image is None:  # a step between
            return
        if step.info["is_video_demo"]:
            views.append(Tile(image, f"video, step {task.steps_done}", RED))
        else:
            views.append(Tile(image, f"step {task.steps_done}"))

    request = RenderRequest({"front": range(0, 2**31, every)})
    recording = Recorder(task, on_step=keep_view, render_request=request).record()
    return views, recording.success


def strip(views: Sequence[Tile], tiles: int) -> Image:
    """Some of the views side by side, spread evenly."""
    return contact_sheet([views[i] for i in evenly_spaced(len(views), tiles)], COLUMNS)


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
    with progress("show", len(specs), unit="episodes") as advance:
        for spec in specs:
            env, views = demonstrated(spec)
            several = sum(other.task == spec.task for other in specs) > 1
            image_name = f"{spec.task}-{spec.episode}.jpg" if several else f"{spec.task}.jpg"
            strip(views, gallery.tiles).save(folder / image_name, quality=82)
            entries.append((spec.task, env.goals()[0], image_name))
            env.close()
            advance(1)
    names = list(dict.fromkeys(task for task, _, _ in entries))
    title = counted(len(names), "task") if len(names) > 1 else names[0]
    write_text(page, render("gallery.md", title=title, entries=entries))
    print(f"{page}: {counted(len(entries), 'episode')}.")


def demonstrated(spec: metadata.EpisodeSpec) -> tuple["Task", list[Tile]]:
    """The first seed from the episode's on whose demonstration succeeds, as the official episodes
    were found.
    """
    # A row describes one scene: another seed would be another row.
    seeds = range(spec.seed, spec.seed + (100 if spec.row is None else 1))
    for seed in seeds:
        try:
            env = make_task(spec.task, render=True, **spec.options | {"seed": seed})
        except SceneError:
            continue
        views, success = demonstrate_with_images(env)
        if success:
            return env, views
        env.close()
    if spec.row is None:
        tried = f"seeds {seeds[0]} … {seeds[-1]}"
    else:
        tried = f"the values of its scene (seed {spec.seed})"
    raise UserError(f"{spec.task} episode {spec.episode}: no demonstration succeeded for {tried}.")
