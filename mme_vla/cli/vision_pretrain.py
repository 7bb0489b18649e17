"""`mme-vla vision-pretrain`: the vision tower of the nano backbone, from renders of the tasks."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from mme_vla.cli.command import cli, log_to_terminal
from mme_vla.config.composition import compose, resolved
from mme_vla.errors import UserError

logger = logging.getLogger("mme_vla.nano")
LEVELS = ("easy", "medium", "hard")


@cli("vision_pretrain")
def main(cfg: DictConfig) -> None:
    """Render the scenes that are missing, then train the tower."""
    from mme_vla.envs.make import require_simulator

    require_simulator()
    log_to_terminal(logger)
    print(run(resolved(cfg)))


def run(config: Mapping[str, Any]) -> Path:
    """Both stages; the path of the weights."""
    import torch

    from mme_vla.data.console import progress
    from mme_vla.envs.episodes import choose_tasks
    from mme_vla.envs.scene.placement import SceneError
    from mme_vla.nano.pretraining import PretrainSettings, fresh_tower, pretrain
    from mme_vla.nano.scenes import record_scenes

    sizes = compose("policy", ["backbone=nano"]).backbone.vision
    width = compose("policy", ["backbone=nano"]).backbone.vlm.width
    folder, tasks = Path(config["output"]), choose_tasks(config["tasks"])
    scenes = [(task, number) for number in range(config["scenes"]) for task in tasks]
    files = []
    with progress("scenes", len(scenes)) as advance:
        for task, number in scenes:
            scene = task, config["first_seed"] + number, LEVELS[number % len(LEVELS)]
            try:
                files.append(record_scenes(folder / "scenes", *scene, config["arrangements"], sizes.image_size))
            except SceneError as error:  # of the benchmark's own rule, which tries so many times
                logger.info("left out: %s", error)
            advance(1)
    if not files:
        raise UserError(f"None of the {len(scenes)} scenes can be built: change first_seed={config['first_seed']}.")
    settings = PretrainSettings(
        **{key: config[key] for key in ("steps", "batch_size", "lr", "held_out", "save_every", "seed")}
    )
    torch.manual_seed(settings.seed)
    tower, grid = fresh_tower({str(key): value for key, value in sizes.items()}, width)
    return pretrain(tower, grid, files, folder, settings)
