"""`mme-vla vision-pretrain`: the vision tower of the nano backbone, from renders of the tasks."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from mme_vla.cli.command import log_to_terminal
from mme_vla.config.composition import compose, resolved
from mme_vla.config.sections import NonNegativeInt, PathText, Positive, PositiveInt, read_section
from mme_vla.data.console import progress
from mme_vla.envs.episodes import choose_tasks
from mme_vla.envs.make import require_simulator
from mme_vla.envs.robomme.recording.processes import carry_out
from mme_vla.envs.rows import DIFFICULTIES
from mme_vla.errors import SceneError, UserError, require
from mme_vla.evaluation.store import begin_run
from mme_vla.extras.nano.pretraining import (
    PretrainSettings,
    Scenes,
    evaluate_tower,
    fresh_tower,
    pretrain,
    report,
)
from mme_vla.extras.nano.tower import TowerConfig

logger = logging.getLogger("mme_vla.nano")


@dataclass(frozen=True)
class PretrainRun:
    """The keys of `configs/vision_pretrain.yaml`, where each is explained."""

    tasks: Any
    scenes: PositiveInt
    held_out: NonNegativeInt
    arrangements: NonNegativeInt
    first_seed: NonNegativeInt
    workers: PositiveInt
    steps: PositiveInt
    batch_size: PositiveInt
    lr: Positive
    save_every: PositiveInt
    seed: int
    output: PathText


def main(cfg: DictConfig) -> None:
    """Render the scenes that are missing, then train the tower."""
    require_simulator()
    log_to_terminal(logger)
    print(run(read_section(PretrainRun, resolved(cfg), others=True)))


def run(pretraining: PretrainRun) -> Path:
    """Both stages; the path of the weights. A folder with other settings is refused."""
    scenes = pretraining.scenes
    require(
        pretraining.held_out < scenes,
        f"held_out={pretraining.held_out}: must be less than scenes={scenes}, which it is a part"
        " of.",
    )
    vision = resolved(compose("policy", ["backbone=nano"]).backbone.vision)
    sizes = read_section(TowerConfig, vision, "backbone.vision")
    tasks = choose_tasks(pretraining.tasks)
    folder = Path(pretraining.output)
    identity = {
        "tasks": tasks,
        "scenes": scenes,
        "held_out": pretraining.held_out,
        "arrangements": pretraining.arrangements,
        "first_seed": pretraining.first_seed,
        "steps": pretraining.steps,
        "batch_size": pretraining.batch_size,
        "lr": pretraining.lr,
        "seed": pretraining.seed,
    }
    begin_run(folder, identity)
    files, held_out = _record(pretraining, tasks, sizes.image_size)
    settings = PretrainSettings(
        steps=pretraining.steps,
        batch_size=pretraining.batch_size,
        lr=pretraining.lr,
        seed=pretraining.seed,
        save_every=pretraining.save_every,
    )
    tower = fresh_tower(sizes, settings.seed)
    weights = pretrain(tower, Scenes.load(sorted(files)), folder, settings)
    if held_out:
        results = evaluate_tower(tower, Scenes.load(sorted(held_out)))
        logger.info("Held-out scenes:\n%s", report(results))
    return weights


def _record(
    pretraining: PretrainRun, tasks: Sequence[str], size: int
) -> tuple[list[Path], list[Path]]:
    """Render what is missing; the files of the scenes to learn from, and of those held out: the
    last of each task.
    """
    folder = Path(pretraining.output) / "scenes"
    first = pretraining.first_seed
    n_learned = pretraining.scenes - pretraining.held_out
    jobs = []
    for number in range(pretraining.scenes):
        arrangements = pretraining.arrangements if number < n_learned else 0
        level = DIFFICULTIES[number % len(DIFFICULTIES)]
        for task in tasks:
            jobs.append((folder, task, first + number, level, arrangements, size))
    learned: list[Path] = []
    held_out: list[Path] = []
    with progress("scenes", len(jobs)) as advance:
        for seed, file, error in carry_out(jobs, _recorded, pretraining.workers):
            if file is None:
                logger.info("left out: %s", error)
            elif seed < first + n_learned:
                learned.append(file)
            else:
                held_out.append(file)
            advance(1)
    if not learned:
        raise UserError(f"None of the {len(jobs)} scenes can be built: change first_seed={first}.")
    return learned, held_out


def _recorded(job: tuple[Path, str, int, str, int, int]) -> tuple[int, Path | None, str]:
    """The scene's seed, its file, and why there is none: the benchmark's own rule tries a layout so
    many times.
    """
    from mme_vla.extras.nano.scenes import record_scene  # with the simulator, asked for first

    try:
        return job[2], record_scene(*job), ""
    except SceneError as error:
        return job[2], None, str(error)
