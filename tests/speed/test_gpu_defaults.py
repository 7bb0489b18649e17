"""What a GPU changes by default, and what the number of processes does not change."""

from pathlib import Path

import pytest
import torch

from mme_vla import MMEPolicy
from mme_vla.extras.methods.diffusion_policy.policy import DiffusionPolicy
from mme_vla.testing.small import random_batch, small_policy


def test_images_are_changed_alike_however_an_update_is_divided() -> None:
    policy = small_policy("pi05").train()
    batch = random_batch(policy, 4)
    changes = policy.augmentation_params(4, torch.Generator().manual_seed(3))["changes"]
    together = policy.prepare_images(batch, changes).images
    pieces = [
        policy.prepare_images(batch.rows(torch.tensor(rows)), changes[rows]).images
        for rows in ([0], [1, 2], [3])
    ]
    assert torch.equal(torch.cat(pieces), together)
    assert not torch.equal(together, policy.prepare_images(batch).images)


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
    there = MMEPolicy.from_pretrained(tmp_path, dtype="auto", device="cuda")
    assert {p.dtype for p in there.parameters()} == {torch.bfloat16}
    monkeypatch.setattr(MMEPolicy, "acts_in_bfloat16", DiffusionPolicy.acts_in_bfloat16)
    unlike = MMEPolicy.from_pretrained(tmp_path, dtype="auto", device="cuda")
    assert {p.dtype for p in unlike.parameters()} == {torch.float32}
