"""The worked example of docs/extend/add-a-backbone.md: checked, trained with a memory by the
command, acts.
"""

import runpy
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers import REPOSITORY
from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.evaluation.store import read_records
from mme_vla.testing import check_backbone
from mme_vla.testing.small import random_batch

EXAMPLE = REPOSITORY / "examples" / "regression"
SMALL = {
    "vision": {"image_size": 32, "patch_size": 2},
    "vlm": {"width": 32, "mlp_dim": 64},
    "depth": 2,
    "num_heads": 4,
    "vocab_size": 128,
    "horizon": 5,
    "action_dim": 8,
}


def custom(integration: str = "context", memory: str = "framesamp") -> MMEPolicy:
    words = {"backbone": "regression", "memory": memory, "integration": integration}
    return build_policy("pi05", config_dir=EXAMPLE / "configs", **words)


@pytest.fixture(autouse=True)
def findable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)


def test_the_page_shows_the_files_that_are_tested() -> None:
    page = (REPOSITORY / "docs" / "extend" / "add-a-backbone.md").read_text()
    for file in ("regression.py", "configs/backbone/regression.yaml"):
        assert (EXAMPLE / file).read_text().strip() in page, file


def test_it_keeps_a_backbones_contract() -> None:
    custom()
    check_backbone("regression", **SMALL)


@pytest.mark.parametrize("integration", ["modulator", "expert"])
def test_an_integration_it_cannot_host_is_refused_in_words(integration: str) -> None:
    with pytest.raises(UserError, match=r"'regression' has no place for .*hosts blocks"):
        custom(integration)


@pytest.mark.parametrize("memory", ["framesamp", "ttt"])
def test_memory_reaches_its_actions_and_it_learns(memory: str) -> None:
    policy = custom(memory=memory)
    batch = random_batch(policy, valid=64)
    before, _ = policy(batch)
    before.backward()
    assert policy.memory is not None
    assert policy.memory.get_parameter("encoder.project.weight").grad.abs().sum() > 0  # type: ignore[union-attr]
    torch.optim.SGD(policy.parameters(), 1e-3).step()
    assert policy(batch)[0] < before
    loss, _ = policy(batch)
    policy.recompute(True)
    again, _ = policy(batch)
    again.backward()
    assert torch.equal(loss, again)


def run(name: str, *words: str) -> None:
    """A documented command, in the example's folder."""
    sys.modules.pop(f"mme_vla.{name}", None)
    sys.argv[:] = [f"mme_vla.{name}", *words]
    runpy.run_module(f"mme_vla.{name}", run_name="__main__", alter_sys=True)


@pytest.fixture
def trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> Path:
    """A checkpoint that the command trained, the backbone's file alone naming all that goes with
    it.
    """
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.chdir(EXAMPLE)
    small = [
        "backbone.vision.image_size=16",
        "backbone.vision.patch_size=1",
        "backbone.depth=1",
        "memory.every=8",
    ]
    brief = [
        "train.steps=2",
        "train.val_samples=2",
        "train.open_loop_chunks=1",
        "train.workers=0",
        "logger=none",
    ]
    choices = ["--config-dir", "configs", "backbone=regression", "model=framesamp_context"]
    run("train", *choices, *small, *brief, f"hydra.run.dir={tmp_path / 'run'}")
    capsys.readouterr()
    (weights,) = (tmp_path / "run").rglob("step_*/model.safetensors")
    return weights.parent


@pytest.mark.slow
def test_a_checkpoint_of_it_works_in_every_command(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    policy = MMEPolicy.from_pretrained(trained, trust_plugins=True)
    episode = policy.start_episode("press the button")
    frames = np.zeros((2, 64, 64, 3), np.uint8)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((2, 8), np.float32))
    assert policy.act(episode).shape == (20, 8)
    run("inspect", f"checkpoint={trained}", "--trust-plugins")
    assert "regression" in capsys.readouterr().out
    if find_spec("mani_skill") is None:
        pytest.skip("the simulator (extra `sim`) is not installed")
    words = [
        "tasks=StopCube",
        "episodes=1",
        "max_steps=1",
        "workers=1",
        "render=false",
        "execute=1",
    ]
    run(
        "evaluate",
        f"checkpoint={trained}",
        *words,
        f"output={tmp_path / 'records'}",
        "--trust-plugins",
    )
    assert [record.outcome for record in read_records(tmp_path / "records" / "episodes.jsonl")] == [
        "timeout"
    ]


def test_what_a_memory_stores_is_rendered_for_its_grid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.chdir(EXAMPLE)
    words = [
        "--config-dir",
        "configs",
        "backbone=regression",
        "dataset=sample",
        "episode=0",
        "step=20",
    ]
    run("inspect", *words, "memory=framesamp", f"output={tmp_path}")
    assert [path.suffix for path in tmp_path.iterdir()] == [".png"]
    with pytest.raises(SystemExit):  # 64 / 8 = 8 tokens a side
        run("inspect", *words, "memory=framesamp", "memory.grid=16", "backbone.vision.patch_size=8")
    assert "8×8 tokens a view pool to 1, 2, 4, 8 a side" in capsys.readouterr().err.replace(
        "\n", " "
    )


def test_a_backbone_whose_file_names_no_processor_is_reported_how(tmp_path: Path) -> None:
    lines = (EXAMPLE / "configs" / "backbone" / "regression.yaml").read_text()
    (tmp_path / "backbone").mkdir()
    remaining = [line for line in lines.splitlines() if "processor" not in line]
    (tmp_path / "backbone" / "bare.yaml").write_text("\n".join(remaining))
    with pytest.raises(
        UserError, match="No processor goes with the backbone 'regression': under `defaults`"
    ):
        build_policy("pi05", config_dir=tmp_path, backbone="bare")
