"""Each model trains on the embedded sample as `python -m mme_vla.train` does."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from mme_vla.cli.train import train
from mme_vla.config.composition import compose
from mme_vla.testing.small import ALL_MODELS, BEYOND, NEURAL, RECURRENT
from mme_vla.training.logging import read_metrics
from mme_vla.training.settings import TrainRun

EACH_PART_ONCE = {
    "pi05",
    "framesamp_modul",
    "tokendrop_context",
    "ttt_expert",
    "rmt_modul",
    "hybrid",
    *BEYOND,
}
"""Each memory and each integration. The other compositions of the paper train nightly."""
STEPS, WINDOW = 30, 6
SMALL = [
    "backbone.depth=1",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=16",
    "backbone.vision.patch_size=2",
    "backbone.vision.width=16",
    "backbone.vision.mlp_dim=16",
    "policy.augment=false",
    "logger=none",
    "train.batch_size=2",
    "train.workers=0",
    "train.device=cpu",
    "train.log_every=1",
    "train.val_samples=0",
    "train.open_loop_chunks=0",
]
SHORT_MEMORY = {
    "framesamp": ["memory.budget=64"],
    "hybrid": ["memory.budget=64"],
    "tokendrop": ["memory.budget=128"],
    "ttt": ["memory.budget=128", "memory.max_steps=3", "memory.max_video=2", "memory.chunk=2"],
    "rmt": ["memory.budget=64", "memory.max_steps=3", "memory.max_video=2", "memory.chunk=2"],
    "retrieval": ["memory.budget=64"],
    "moment": ["memory.budget=16", "memory.grid=4"],
    "gist": ["memory.budget=48", "memory.anchors=1", "memory.recent=1"],
    "actions": ["memory.max_steps=8", "memory.max_video=4"],
    "learned_topk": ["memory.budget=48", "memory.pool=4"],
    "spacetime": ["memory.frames=3", "memory.stride=4", "memory.state_dim=8"],
    "anchors": ["memory.spacing=4"],
    "events": ["memory.budget=64"],
    "pyramid": ["memory.budget=80"],
    "keyframes": ["memory.budget=48", "memory.pool=8"],
}


@pytest.fixture(scope="module")
def caches(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Vision caches, shared by all models that store the same tokens."""
    return tmp_path_factory.mktemp("caches")


def run(model: str, folder: Path, caches: Path, *overrides: str) -> None:
    """Train in this process."""
    memory = SHORT_MEMORY[model.rsplit("_", 1)[0]] if model in [*NEURAL, *BEYOND, "hybrid"] else []
    cfg = compose(
        "train", [f"model={model}", *SMALL, *memory, f"data.cache.root={caches}", *overrides]
    )
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    train(TrainRun.from_config(config), folder, begun=time.perf_counter())


def marked(model: str) -> Any:
    mark = pytest.mark.slow if model in EACH_PART_ONCE else pytest.mark.nightly
    return pytest.param(model, marks=mark)


def test_each_part_is_among_the_models_of_the_slow_tier() -> None:
    assert EACH_PART_ONCE.issubset([*ALL_MODELS, *BEYOND])
    parts, expected = set(), set()
    for model in [*NEURAL, *BEYOND]:
        expected |= set(model.rsplit("_", 1))
        if model in EACH_PART_ONCE:
            parts |= set(model.rsplit("_", 1))
    assert parts == expected


@pytest.mark.parametrize("model", [marked(model) for model in [*ALL_MODELS, *BEYOND]])
def test_every_model_trains_on_the_sample(model: str, tmp_path: Path, caches: Path) -> None:
    run(model, tmp_path, caches, f"train.steps={STEPS}")
    lines = read_metrics(tmp_path)
    numbers = [value for line in lines for value in line.values()]
    assert np.isfinite(numbers).all()
    loss = [line["train/loss"] for line in lines if "train/loss" in line]
    assert len(loss) == STEPS
    assert np.mean(loss[-WINDOW:]) < 0.6 * np.mean(loss[:WINDOW])
    reported = {
        key
        for key in lines[-1]
        if key.startswith(("train/memory/", "memory/")) and key != "memory/gib"
    }
    assert bool(reported) == (model in RECURRENT), (
        "recurrent memories report what happens inside them"
    )
