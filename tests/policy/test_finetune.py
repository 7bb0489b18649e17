"""Which parameters learn, and adapters from birth to merge."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mme_vla import MMEPolicy, UserError
from mme_vla.cli.weights import convert
from mme_vla.config.composition import compose
from mme_vla.config.trees import library_files
from mme_vla.policy.finetune import apply_finetuning, merge_adapters, warn_of_frozen_random_weights
from mme_vla.testing.small import SMALL_VISION, random_batch, small_policy
from mme_vla.weights import load_weights

TOLERANCE = 1e-4  # ten steps with the sum of two products in place of the product of a sum
FEW_TOKENS = {"vision": {**SMALL_VISION, "patch_size": 8}}
VARIANTS = ["pi05", "tokendrop_modul", "framesamp_expert"]


def learning(policy: MMEPolicy) -> set[str]:
    return {name for name, p in policy.named_parameters() if p.requires_grad}


@torch.no_grad()
def chunk(policy: MMEPolicy) -> torch.Tensor:
    batch = random_batch(policy)
    return policy.eval().sample_actions(batch, torch.zeros_like(batch.actions))


def stir(policy: MMEPolicy) -> None:
    """Give the adapters, which begin at zero, something to say."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            if ".lora_B." in name:
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.1)


@pytest.mark.parametrize("variant", VARIANTS)
def test_full_learns_all_but_the_vision_tower(variant: str) -> None:
    policy = small_policy(variant, backbone=FEW_TOKENS)
    counts = apply_finetuning(policy)
    assert {name for name, _ in policy.named_parameters()} - learning(policy) == {
        name for name, _ in policy.named_parameters() if name.startswith("backbone.vision.")
    }
    assert counts["vision"] == 0
    assert sum(counts.values()) == sum(p.numel() for p in policy.parameters() if p.requires_grad)
    assert apply_finetuning(policy, freeze_vision=False)["vision"] > 0


@pytest.mark.parametrize("variant", VARIANTS)
def test_expert_only_learns_the_action_side_and_the_memory(variant: str) -> None:
    policy = small_policy(variant, backbone=FEW_TOKENS)
    counts = apply_finetuning(policy, "expert_only")
    assert {policy.finetune_spec.component_of(name) for name in learning(policy)} == {
        "action",
        "memory",
    } - ({"memory"} if variant == "pi05" else set())
    assert counts["vlm"] == counts["vision"] == 0
    loss, _ = policy.train()(random_batch(policy))
    loss.backward()
    assert [name for name in learning(policy) if policy.get_parameter(name).grad is None] == []


def test_adapters_follow_from_their_seed_alone() -> None:
    pytest.importorskip("peft", reason="LoRA needs the extra 'vlm'")

    def adapters(before: int, seed: int) -> torch.Tensor:
        policy = small_policy("pi05", backbone=FEW_TOKENS)
        torch.manual_seed(before)
        apply_finetuning(policy, "lora", seed=seed)
        return torch.cat(
            [p.flatten() for name, p in policy.named_parameters() if ".lora_A." in name]
        )

    assert torch.equal(adapters(1, seed=7), adapters(2, seed=7))
    assert not torch.equal(adapters(1, seed=7), adapters(1, seed=8))


@pytest.mark.parametrize("variant", VARIANTS)
def test_adapters_begin_silent_learn_and_merge(variant: str, tmp_path: Path) -> None:
    pytest.importorskip("peft", reason="LoRA needs the extra 'vlm'")
    policy = small_policy(variant, backbone=FEW_TOKENS)
    baseline = chunk(policy)
    names = set(policy.state_dict())
    counts = apply_finetuning(policy, "lora", rank=4, alpha=8)
    assert torch.equal(chunk(policy), baseline)
    assert counts["vision"] == 0
    spec = policy.finetune_spec
    assert all(
        ".lora_" in n or spec.component_of(n) == "memory" or n.split(".")[1] in spec.full_train
        for n in learning(policy)
    )
    frozen = {n: p.clone() for n, p in policy.named_parameters() if not p.requires_grad}
    stir(policy)
    optimizer = torch.optim.SGD([p for p in policy.parameters() if p.requires_grad], lr=0.1)
    loss, _ = policy.train()(random_batch(policy))
    loss.backward()
    assert [name for name in learning(policy) if policy.get_parameter(name).grad is None] == []
    optimizer.step()
    assert all(torch.equal(policy.get_parameter(name), tensor) for name, tensor in frozen.items())
    taught = chunk(policy)
    assert (taught - baseline).abs().max() > 1e-3

    policy.save_pretrained(tmp_path / "apart")
    loaded = MMEPolicy.from_pretrained(tmp_path / "apart")
    assert torch.equal(chunk(loaded), taught)
    merge_adapters(loaded)
    assert set(loaded.state_dict()) == names
    assert "adapters" not in loaded.config
    assert (chunk(loaded) - taught).abs().max() < TOLERANCE
    # Elsewhere, adapters are folded in as they are read.
    assert (
        chunk(load_weights(small_policy(variant, backbone=FEW_TOKENS), tmp_path / "apart")) - taught
    ).abs().max() < TOLERANCE
    convert(tmp_path / "apart", tmp_path / "plain")
    assert (chunk(MMEPolicy.from_pretrained(tmp_path / "plain")) - taught).abs().max() < TOLERANCE


def test_names_that_match_nothing_are_errors_with_near_ones() -> None:
    policy = small_policy("framesamp_modul")
    before = set(policy.state_dict())
    with pytest.raises(UserError, match=r"Did you mean 'experts\.vlm\.qkv'"):
        apply_finetuning(policy, "lora", targets=["experts.vlm.q_proj", "experts.action.out"])
    with pytest.raises(UserError, match=r"past any adapter"):
        apply_finetuning(policy, "lora", targets=["action_in"])
    with pytest.raises(UserError, match=r"past any adapter"):
        apply_finetuning(policy, "lora", targets=["mlp_norm.dense"])
    with pytest.raises(UserError, match="empty"):
        apply_finetuning(policy, "lora", targets=[])
    with pytest.raises(UserError, match=r"Did you mean.*action_out"):
        apply_finetuning(policy, "lora", train=["action_ou"])
    with pytest.raises(UserError, match="rank=0"):
        apply_finetuning(policy, "lora", rank=0)
    with pytest.raises(UserError, match="Did you mean 'lora'"):
        apply_finetuning(policy, "lorra")
    assert set(policy.state_dict()) == before


def test_adapters_are_not_put_on_twice() -> None:
    pytest.importorskip("peft", reason="LoRA needs the extra 'vlm'")
    policy = small_policy("pi05")
    apply_finetuning(policy, "lora")
    with pytest.raises(UserError, match="already"):
        apply_finetuning(policy, "lora")


@pytest.mark.parametrize("name", ["full", "expert_only", "lora"])
def test_each_config_file_is_what_the_function_takes(name: str) -> None:
    if name == "lora":
        pytest.importorskip("peft", reason="LoRA needs the extra 'vlm'")
    assert name in library_files("finetune")
    settings = compose("policy", [f"+finetune={name}"]).finetune
    assert settings.mode == name
    apply_finetuning(small_policy("framesamp_modul"), **settings)


@pytest.mark.parametrize("mode", ["lora", "expert_only"])
def test_freezing_random_weights_is_warned_of(mode: str) -> None:
    with pytest.warns(UserWarning, match=f"finetune={mode} without init_from"):
        warn_of_frozen_random_weights(mode)


def test_training_everything_from_random_weights_is_not_warned_of(
    recwarn: pytest.WarningsRecorder,
) -> None:
    warn_of_frozen_random_weights("full")
    assert not recwarn.list


def test_a_mode_that_leaves_nothing_to_train_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = small_policy("pi05", backbone=FEW_TOKENS)
    frozen = replace(policy.finetune_spec, frozen=".*")
    monkeypatch.setattr(MMEPolicy, "finetune_spec", property(lambda self: frozen))
    with pytest.raises(UserError, match="leaves no parameter"):
        apply_finetuning(policy, "expert_only")
