"""Short runs of the training command in this process, at sizes below the tiny ones."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from mme_vla.cli.train import train
from mme_vla.config.composition import compose
from mme_vla.training.logging import read_metrics
from mme_vla.training.settings import TrainRun

TOWERS = [f"backbone.vision.{tower}.{size}" for tower in ("dino", "siglip") for size in (
    "width=8", "depth=2", "mlp_dim=16", "num_heads=1")]  # fmt: skip
QUICK = [
    "logger=none",
    "train.workers=0",
    "train.device=cpu",
    "train.log_every=1",
    "train.open_loop_chunks=0",
]
UNTESTED = [*QUICK, "train.val_samples=0", "data.val_episodes=[]"]
"""Without validation."""
SHORT = [
    *TOWERS,
    "backbone.vlm.depth=1",
    "backbone.vlm.width=32",
    "backbone.vlm.mlp_dim=32",
    *QUICK,
    "train.val_samples=2",
    "train.ema=0.5",
]


def run(model: str, folder: Path, *overrides: str, short: Sequence[str] = SHORT) -> Path:
    """Train a model, by default on the sample; the last checkpoint."""
    cfg = compose(
        "train",
        [f"model={model}", *short, f"data.cache.root={folder.parent / 'caches'}", *overrides],
    )
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    return train(TrainRun.from_config(config), folder, begun=time.perf_counter())


def losses(folder: Path) -> list[float]:
    return [line["train/loss"] for line in read_metrics(folder) if "train/loss" in line]
