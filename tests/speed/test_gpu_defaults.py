"""What a GPU changes by default, and what the number of processes does not change."""

import importlib
from pathlib import Path

import pytest
import torch

from mme_vla import MMEPolicy
from mme_vla.extras.methods.diffusion_policy.policy import DiffusionPolicy
from mme_vla.speed.compiler import CACHE_VARIABLE
from mme_vla.testing.small import random_batch, small_policy


def test_images_are_changed_alike_however_an_update_is_divided() -> None:
    policy = small_policy("pi05").train()
    batch = random_batch(policy, 4)
    changes = policy.augmentation_params(4, torch.Generator().manual_seed(3))["changes"]
    together = policy.model.prepare_images(batch, changes).images
    pieces = [
        policy.model.prepare_images(batch.rows(torch.tensor(rows)), changes[rows]).images
        for rows in ([0], [1, 2], [3])
    ]
    assert torch.equal(torch.cat(pieces), together)
    assert not torch.equal(together, policy.model.prepare_images(batch).images)


def test_weights_for_acting_are_rounded_where_they_may_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_policy("pi05").save_pretrained(tmp_path)
    here = MMEPolicy.from_pretrained(tmp_path, dtype="auto")
    assert {p.dtype for p in here.parameters()} == {torch.float32}
    assert all(p.requires_grad for p in here.parameters())
    rounded = MMEPolicy.from_pretrained(tmp_path, dtype="bfloat16")
    assert (
        not any(p.requires_grad for p in rounded.parameters())
        and rounded.compute_dtype == torch.bfloat16
    )
    # there need be no GPU to see what would go there
    monkeypatch.setattr(MMEPolicy, "to", lambda self, device: self)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    there = MMEPolicy.from_pretrained(tmp_path, dtype="auto", device="cuda")
    assert {p.dtype for p in there.parameters()} == {torch.bfloat16}
    monkeypatch.setattr(MMEPolicy, "acts_in_bfloat16", DiffusionPolicy.acts_in_bfloat16)
    unlike = MMEPolicy.from_pretrained(tmp_path, dtype="auto", device="cuda")
    assert {p.dtype for p in unlike.parameters()} == {torch.float32}


def test_the_measurement_of_a_gpu_compares_chunks_that_every_layer_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    gpu = importlib.import_module("gpu")
    setup = gpu.Setup("tiny", 1, 1, torch.device("cpu"), False, "auto")
    policy, sample = gpu.sampler_of("framesamp_modul", setup)
    chunk = sample()
    parts = [*policy.backbone.transformer.layers, *policy.integration.layers]
    for part in (*parts, policy.backbone.vision):
        before = {name: weight.clone() for name, weight in part.named_parameters()}
        for name, weight in part.named_parameters():
            if weight.ndim > 1 and not name.endswith("norm.dense.weight"):
                weight.mul_(2)
        assert (sample() - chunk).abs().max() > 1e-4, type(part).__name__
        part.load_state_dict(before)


def test_a_rehearsal_leaves_no_code_in_the_users_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    gpu = importlib.import_module("gpu")
    monkeypatch.setattr(gpu.inductor_config.test_configs, "max_mm_configs", None)
    monkeypatch.setattr(torch.backends.cudnn, "enabled", True)
    monkeypatch.setenv("MME_VLA_CACHE", str(tmp_path))
    monkeypatch.setenv(CACHE_VARIABLE, "")
    monkeypatch.delenv(CACHE_VARIABLE)
    no_row = ("--device", "cpu", "--parts", "tuned", "--eager")
    assert gpu.main(["--rehearse", *no_row]) == 0
    assert not list(tmp_path.iterdir())
    monkeypatch.delenv(CACHE_VARIABLE)
    gpu.main(no_row)
    assert [folder.name for folder in tmp_path.iterdir()] == ["compiled"]
