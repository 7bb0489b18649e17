"""The worked example of docs/add-a-backbone.md: checked, trained with a memory by the command, asked for actions."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import REPOSITORY

from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.testing import check_backbone
from mme_vla.testing.small import random_batch

EXAMPLE = REPOSITORY / "examples" / "regression"
SMALL = {
    "vision": {"image_size": 32, "patch_size": 2}, "vlm": {"width": 32, "mlp_dim": 64}, "depth": 2, "num_heads": 4,
    "vocab_size": 128, "horizon": 5, "action_dim": 8,
}  # fmt: skip


def own(integration: str = "context", memory: str = "framesamp") -> MMEPolicy:
    words = {"backbone": "regression", "processor": "tiny", "memory": memory, "integration": integration}
    return build_policy("pi05", config_dir=EXAMPLE / "configs", **words)


@pytest.fixture(autouse=True)
def findable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)


def test_the_page_shows_the_files_that_are_tested() -> None:
    page = (REPOSITORY / "docs" / "add-a-backbone.md").read_text()
    for file in ("regression.py", "configs/backbone/regression.yaml"):
        assert (EXAMPLE / file).read_text().strip() in page, file


def test_it_keeps_a_backbones_promises() -> None:
    own()
    check_backbone("regression", **SMALL)


@pytest.mark.parametrize("integration", ["modulator", "expert"])
def test_an_integration_it_cannot_host_is_refused_in_words(integration: str) -> None:
    with pytest.raises(UserError, match=r"'regression' has no place for .*hosts blocks"):
        own(integration)


@pytest.mark.parametrize("memory", ["framesamp", "ttt"])
def test_memory_reaches_its_actions_and_it_learns(memory: str) -> None:
    policy = own(memory=memory)
    batch = random_batch(policy, valid=64)
    before, _ = policy(batch)
    before.backward()
    assert policy.memory is not None
    assert policy.memory.get_parameter("encoder.project.weight").grad.abs().sum() > 0  # type: ignore[union-attr]
    torch.optim.SGD(policy.parameters(), 1e-3).step()
    assert policy(batch)[0] < before
    kept, _ = policy(batch)
    policy.recompute(True)
    again, _ = policy(batch)
    again.backward()
    assert torch.equal(kept, again)


def test_it_trains_through_the_same_command_and_acts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = ["backbone.vision.image_size=16", "backbone.vision.patch_size=1", "backbone.depth=1"]
    brief = ["train.steps=2", "train.val_samples=2", "train.open_loop_chunks=1", "train.workers=0", "logger=none"]
    choices = ["backbone=regression", "processor=tiny", "model=framesamp_context"]
    words = [*choices, *small, *brief, f"hydra.run.dir={tmp_path / 'run'}"]
    monkeypatch.setattr(sys, "argv", ["mme_vla.train", "--config-dir", str(EXAMPLE / "configs"), *words])
    monkeypatch.chdir(EXAMPLE)
    monkeypatch.delitem(sys.modules, "mme_vla.train", raising=False)
    runpy.run_module("mme_vla.train", run_name="__main__", alter_sys=True)
    (weights,) = (tmp_path / "run").rglob("step_*/model.safetensors")
    policy = MMEPolicy.from_pretrained(weights.parent, trust_plugins=True)
    episode = policy.start_episode("press the button")
    frames = np.zeros((2, 64, 64, 3), np.uint8)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((2, 8), np.float32))
    assert policy.act(episode).shape == (20, 8)
