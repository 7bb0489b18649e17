"""`mme-vla vision-pretrain`: the vision tower of the nano backbone, from renders of the tasks."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from mme_vla.cli.command import cli, log_to_terminal
from mme_vla.config.composition import compose, resolved
from mme_vla.envs.rows import DIFFICULTIES
from mme_vla.errors import UserError, require

logger = logging.getLogger("mme_vla.nano")


@cli("vision_pretrain")
def main(cfg: DictConfig) -> None:
    """Render the scenes that are missing, then train the tower."""
    from mme_vla.envs.make import require_simulator

    require_simulator()
    log_to_terminal(logger)
    print(run(resolved(cfg)))


def run(config: Mapping[str, Any]) -> Path:
    """Both stages; the path of the weights. A folder with other settings is refused."""
    from mme_vla.config.sections import read_section
    from mme_vla.envs.episodes import choose_tasks
    from mme_vla.evaluation.store import claim_run
    from mme_vla.extras.nano.pretraining import PretrainSettings, fresh_tower, pretrain
    from mme_vla.extras.nano.tower import TowerConfig

    require(
        0 <= config["held_out"] < config["scenes"],
        f"held_out={config['held_out']}: must be less than scenes={config['scenes']}, which it is a"
        " part of.",
    )
    sizes = read_section(
        TowerConfig,
        resolved(compose("policy", ["backbone=nano"]).backbone.vision),
        "backbone.vision",
    )
    tasks, folder = choose_tasks(config["tasks"]), Path(config["output"])
    of_tower = {name: config[name] for name in ("steps", "batch_size", "lr", "seed")}
    of_scenes = {
        name: config[name] for name in ("scenes", "held_out", "arrangements", "first_seed")
    }
    claim_run(folder, {"tasks": tasks, **of_scenes, **of_tower})
    files, held_out = _record(config, tasks, sizes.image_size)
    settings = PretrainSettings(**of_tower, save_every=config["save_every"])
    return pretrain(fresh_tower(sizes, settings.seed), files, held_out, folder, settings)


def _record(
    config: Mapping[str, Any], tasks: Sequence[str], size: int
) -> tuple[list[Path], list[Path]]:
    """Render what is missing; the files of the scenes to learn from, and of those held out: the
    last of each task.
    """
    from mme_vla.data.console import progress
    from mme_vla.envs.robomme.recording.processes import carry_out

    folder = Path(config["output"]) / "scenes"
    first = config["first_seed"]
    n_learned = config["scenes"] - config["held_out"]
    learned: list[Path] = []
    held_out: list[Path] = []
    jobs = []
    for number in range(config["scenes"]):
        arrangements = config["arrangements"] if number < n_learned else 0
        level = DIFFICULTIES[number % len(DIFFICULTIES)]
        jobs += [(folder, task, first + number, level, arrangements, size) for task in tasks]
    with progress("scenes", len(jobs)) as advance:
        for seed, file, error in carry_out(jobs, _recorded, config["workers"]):
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
    from mme_vla.envs.robomme.scene.placement import SceneError
    from mme_vla.extras.nano.scenes import record_scene

    try:
        return job[2], record_scene(*job), ""
    except SceneError as error:
        return job[2], None, str(error)
