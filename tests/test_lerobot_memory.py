"""Checkpoints of LeRobot's π0.5 with its own memory: refused as a whole, since they would run without it."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from mme_vla import UserError, load_weights
from mme_vla.testing.small import small_policy
from mme_vla.weights.load import transfer
from mme_vla.weights.writers import write_lerobot


def checkpoint(folder: Path, **switches: bool) -> Path:
    """A tiny checkpoint in LeRobot's layout, with the tensors that its memory of past states brings."""
    folder.mkdir()
    policy = small_policy("pi05", seed=1)
    write_lerobot(policy, folder, torch.float32, None)
    about = folder / "config.json"
    about.write_text(json.dumps(json.loads(about.read_text()) | switches))
    if switches.get("use_proprioceptive_memory"):
        (file,) = folder.glob("*.safetensors")
        width = policy.backbone.config.vlm.width
        own = {"weight": torch.ones(width, 32), "bias": torch.ones(width)}
        save_file(load_file(file) | {f"model.proprio_history_proj.{k}": v for k, v in own.items()}, file)
    return folder


@pytest.mark.parametrize("switch", ["use_visual_memory", "use_proprioceptive_memory"])
def test_a_checkpoint_with_lerobots_memory_is_refused_by_name_and_taken_as_a_start(switch: str, tmp_path: Path) -> None:
    folder, policy = checkpoint(tmp_path / "theirs", **{switch: True}), small_policy("pi05")
    before = policy.backbone.action_in.weight.clone()
    with pytest.raises(UserError, match=rf"own memory \({switch} in its config.json\)"):
        load_weights(policy, folder)
    assert torch.equal(policy.backbone.action_in.weight, before)
    report = transfer(policy, folder)
    assert not torch.equal(policy.backbone.action_in.weight, before) and not report.new
    assert bool(report.left) == (switch == "use_proprioceptive_memory")


def test_the_same_checkpoint_without_it_is_read_as_before(tmp_path: Path) -> None:
    policy = small_policy("pi05")
    load_weights(policy, checkpoint(tmp_path / "plain", use_visual_memory=False))
    assert torch.equal(policy.backbone.action_in.weight, small_policy("pi05", seed=1).backbone.action_in.weight)
