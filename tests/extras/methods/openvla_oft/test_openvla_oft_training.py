"""OpenVLA-OFT in training: it learns through a memory, and the data are those of its recipe."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.sources import open_sources
from mme_vla.data.statistics import compute_norm_stats
from mme_vla.extras.methods.openvla_oft.policy import OpenVlaPolicy
from mme_vla.policy.build import build_policy
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.testing.small import random_batch

TOWER = {"width": 8, "depth": 2, "mlp_dim": 16, "num_heads": 1}


def test_with_a_memory_it_answers_by_what_it_remembers() -> None:
    small = {"image_size": 32, "patch_size": 4} | dict.fromkeys(("dino", "siglip"), TOWER)
    memory = {"budget": 16, "grid": 4}
    policy = build_policy(
        "openvla_oft_framesamp_context", backbone={"vision": small}, memory=memory
    ).train()
    assert isinstance(policy, OpenVlaPolicy)
    policy.augment = False
    batch = random_batch(policy, 2, valid=16)
    assert batch.actions is not None
    # Two samples that differ in nothing but what is remembered, and in the answer.
    alike = {
        name: getattr(batch, name)[:1].expand_as(getattr(batch, name))
        for name in ("images", "prompt", "prompt_mask")
    }
    answers = torch.tensor([1.0, -1.0])[:, None, None].expand_as(batch.actions)
    batch = replace(
        batch, **alike, actions=answers, proprio=torch.zeros(2, policy.embodiment.state.width)
    )
    optimizer = torch.optim.AdamW(policy.parameters(), lr=8e-3, fused=True)
    for _ in range(80):
        optimizer.zero_grad()
        loss, _ = policy(batch)
        loss.backward()
        optimizer.step()
        if loss.item() < 0.3:
            return
    pytest.fail(f"the loss is {loss.item():.2f} after 80 updates; 1 without a look at the memory")


def test_only_steps_with_a_full_chunk_are_learned_from_and_quantiles_are_exact() -> None:
    policy = build_policy("openvla_oft")
    processor, robot = policy.require_processor(), policy.embodiment
    sources = open_sources(["sample"], robot)
    processor.stats = compute_norm_stats(
        sources,
        horizon=1,
        robot=robot,
        every=processor.stats_spec.every,
        extremes=processor.stats_spec.extremes,
        exact=processor.stats_spec.exact,
    )
    dataset = TrainingDataset(sources, processor)
    left_out = sum(
        min(len(sources[0].decisions(e)), robot.action.horizon - 1) for e in range(len(sources[0]))
    )
    assert (
        len(dataset) == sum(len(sources[0].decisions(e)) for e in range(len(sources[0]))) - left_out
    )
    assert all(dataset.step(i).recorded.all() for i in (0, len(dataset) // 2, len(dataset) - 1))
    actions = np.concatenate(
        [sources[0].actions(e, int(sources[0].exec_starts[e])) for e in range(len(sources[0]))]
    )
    np.testing.assert_allclose(
        processor.stats.actions.q99, np.quantile(actions.astype(np.float64), 0.99, axis=0)
    )
    np.testing.assert_allclose(processor.stats.actions.max, actions.max(0))
    item = dataset[0]
    assert item["proprio"].abs().max() <= 1 and item["actions"].abs().max() <= 1


def test_the_frozen_base_is_grasped_in_bfloat16_and_what_learns_in_float32() -> None:
    policy = build_policy(
        "openvla_oft",
        policy={"compute_dtype": "bfloat16"},
        backbone={"vision": {"image_size": 32, "patch_size": 2}},
    )
    assert isinstance(policy, OpenVlaPolicy)
    batch = replace(random_batch(policy), proprio=torch.zeros(2, policy.embodiment.state.width))
    before = policy.eval()(batch)[0].item()
    apply_finetuning(
        policy,
        "lora",
        freeze_vision=False,
        rank=2,
        train=["state_token", "head"],
        frozen_dtype="bfloat16",
    )
    dtypes = {
        learns: {p.dtype for p in policy.parameters() if p.requires_grad is learns}
        for learns in (True, False)
    }
    assert dtypes == {True: {torch.float32}, False: {torch.bfloat16}}
    loss, _ = policy(batch)
    assert loss.item() == pytest.approx(before, rel=0.03), (
        "adapters begin at nothing, and the base is what it was"
    )
    loss.backward()
    learned = [p.grad for p in policy.parameters() if p.grad is not None]
    assert all(grad.dtype == torch.float32 and torch.isfinite(grad).all() for grad in learned)
    assert any(grad.abs().sum() > 0 for grad in learned)
