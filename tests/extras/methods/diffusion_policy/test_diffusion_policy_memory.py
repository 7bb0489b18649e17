"""`diffusion_policy` with a memory: every memory joins the condition through `film`, and changes
actions.
"""

import time
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

pytest.importorskip("diffusers")

from mme_vla import Policy, UserError, build_policy
from mme_vla.cli.train import train
from mme_vla.config.composition import compose
from mme_vla.extras.methods.diffusion_policy.policy import DiffusionPolicy
from mme_vla.memory.base import full_history
from mme_vla.testing.small import unit_stats
from mme_vla.training.settings import TrainRun
from mme_vla.types import HistoryTokens

SMALL = {
    "memory_tower": {
        "image_size": 32,
        "patch_size": 2,
        "width": 16,
        "depth": 1,
        "mlp_dim": 16,
        "num_heads": 2,
    }
}


def with_memory(memory: str, **overrides: Any) -> DiffusionPolicy:
    options = {"backbone": SMALL, "memory": memory, "integration": "film", **overrides}
    policy = build_policy("diffusion_policy", **options)
    assert isinstance(policy, DiffusionPolicy)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    return policy


@pytest.fixture(scope="module")
def policy() -> DiffusionPolicy:
    return with_memory("framesamp")


def history(policy: DiffusionPolicy, seed: int) -> HistoryTokens:
    full = full_history(policy.require_memory(), policy.sizes.memory_width)
    generator = torch.Generator().manual_seed(seed)
    return HistoryTokens(
        torch.randn(full.features.shape, generator=generator), full.positions, full.mask
    )


@pytest.mark.parametrize("memory", ["tokendrop", "ttt"])
def test_any_memory_joins_the_condition(memory: str) -> None:
    policy = with_memory(memory)
    batch = policy.full_batch()
    baseline = build_policy("diffusion_policy", backbone=SMALL)
    with torch.no_grad():
        widths = [
            each.backbone.unet.mid_modules[0].cond_encoder[1].in_features
            for each in (policy, baseline)
        ]
        assert widths[0] == widths[1] + policy.integration.feature_width
        assert policy.condition(batch, policy.encode_memory(batch.history)).shape == (
            1,
            policy.backbone.condition_width,
        )
    assert policy.config["memory"]["name"] == memory


def test_what_is_stored_changes_the_reply_and_learns(policy: DiffusionPolicy) -> None:
    batch = policy.full_batch()
    draws = {
        name: value[None]
        for name, value in policy.sampling_noise(torch.Generator().manual_seed(0)).items()
    }
    chunks = []
    for seed in (0, 1, 1):
        batch.history = history(policy, seed)
        chunks.append(policy.sample_actions(batch, draws, steps=2))
    assert torch.equal(chunks[1], chunks[2])
    assert not torch.allclose(chunks[0], chunks[1])
    policy.zero_grad()
    policy(batch)[0].backward()
    learnt = [
        p
        for name, p in policy.named_parameters()
        if policy.finetune_spec.component_of(name) == "memory"
    ]
    assert learnt and all(p.grad is not None and p.grad.abs().sum() > 0 for p in learnt)
    policy.zero_grad()


def test_padding_of_a_short_memory_counts_for_nothing(policy: DiffusionPolicy) -> None:
    full = history(policy, 0)
    mask = torch.zeros_like(full.mask)
    mask[:, :32] = True
    outputs = []
    for filling in (0.0, 7.0, float("nan")):
        features = full.features.masked_fill(~mask[..., None], filling)
        tokens = policy.encode_memory(HistoryTokens(features, full.positions, mask))
        outputs.append(policy.integration.feature(tokens))
    assert torch.allclose(outputs[0], outputs[1], atol=1e-6)
    assert torch.allclose(outputs[0], outputs[2], atol=1e-6)


def test_it_trains_on_cached_tokens(tmp_path: Path) -> None:
    tower = [f"backbone.memory_tower.{key}={value}" for key, value in SMALL["memory_tower"].items()]
    cfg = compose(
        "train",
        [
            "model=diffusion_policy",
            "memory=framesamp",
            "integration=film",
            "memory.budget=64",
            "memory.every=8",
            *tower,
            "logger=none",
            "train.steps=2",
            "train.batch_size=2",
            "train.workers=0",
            "train.device=cpu",
            "train.val_samples=0",
            "train.open_loop_chunks=0",
            f"data.cache.root={tmp_path / 'caches'}",
        ],
    )
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    checkpoint = train(TrainRun.from_config(config), tmp_path / "run", begun=time.perf_counter())
    again = Policy.from_pretrained(checkpoint)
    assert again.config["name"] == "diffusion_policy"
    assert again.memory is not None and again.memory.budget == 64


def test_its_tower_stays_as_it_is_and_the_cameras_encoder_learns(policy: DiffusionPolicy) -> None:
    from mme_vla.policy.finetune import apply_finetuning

    counts = apply_finetuning(policy)
    assert counts["vision"] == 0 and counts["encoder"] > 10_000_000 and counts["memory"] > 0
    apply_finetuning(policy, freeze_vision=False)


def test_what_does_not_fit_is_reported() -> None:
    with pytest.raises(UserError, match=r"one vector\. Choose integration=film"):
        build_policy("diffusion_policy", memory="framesamp", integration="modulator")
    with pytest.raises(UserError, match="name both, or neither"):
        build_policy("diffusion_policy", integration="film")
    with pytest.raises(UserError, match="has no place for vector"):
        build_policy("pi05", memory="framesamp", integration="film")
