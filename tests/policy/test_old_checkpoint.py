"""A checkpoint written before the folders were rearranged loads, continues training and acts as it
did then.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from data.earlier_layout.make import actions
from helpers import REPOSITORY
from mme_vla import MMEPolicy
from mme_vla.cli.train import main
from mme_vla.config.composition import compose

FOLDER = REPOSITORY / "tests" / "data" / "earlier_layout"
STEP = Path("checkpoints") / "step_000002"
EXPECTED = json.loads((FOLDER / "expected.json").read_text())


def test_it_loads_and_chooses_the_same_actions() -> None:
    policy = MMEPolicy.from_pretrained(FOLDER / "run" / STEP)
    assert policy.embodiment.name == "robomme_joint", "what checkpoints that name no robot are for"
    np.testing.assert_allclose(actions(policy, ("front", "wrist")), EXPECTED["actions"], atol=2e-5)


def test_its_training_goes_on_with_the_losses_it_had(tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(FOLDER / "run", run)
    then = OmegaConf.load(run / "config.yaml")
    sizes = [
        f"backbone.{key}={value}"
        for key, value in flat(then.backbone)
        if key not in ("name", "horizon")
    ]
    recipe = [
        f"train.{key}={value}"
        for key, value in flat(then.train)
        if key in ("batch_size", "val_samples")
    ]
    words = [
        "model=framesamp_modul",
        "memory.budget=32",
        "memory.grid=2",
        "logger=none",
        "train.steps=4",
        *sizes,
        *recipe,
        "train.log_every=1",
        "train.save_every=4",
        "train.open_loop_chunks=0",
        "train.workers=0",
        "train.device=cpu",
        f"data.cache.root={tmp_path / 'cache'}",
        f"resume={run}",
    ]
    main(compose("train", words))
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    losses = {
        str(line["step"]): line["train/loss"]
        for line in lines
        if "train/loss" in line and line["step"] > 2
    }
    assert losses == pytest.approx(EXPECTED["losses"], rel=1e-5)
    assert [line["val/loss"] for line in lines if "val/loss" in line] == pytest.approx(
        [EXPECTED["validation"]], rel=1e-5
    )


def flat(section, prefix: str = ""):
    for key, value in section.items():
        yield from (
            flat(value, f"{prefix}{key}.")
            if OmegaConf.is_dict(value)
            else [(f"{prefix}{key}", value)]
        )
