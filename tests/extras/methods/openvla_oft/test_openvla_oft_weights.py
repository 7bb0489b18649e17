"""OpenVLA's and OpenVLA-OFT's files: written, read, and started from."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from helpers.memory_fakes import same
from mme_vla import UserError, build_policy
from mme_vla.extras.methods.openvla_oft.weights import VLA, openvla_name
from mme_vla.policy.base import Policy
from mme_vla.policy.finetune import apply_finetuning, merge_adapters
from mme_vla.testing.small import unit_stats
from mme_vla.weights.load import load_weights, transfer
from mme_vla.weights.source import open_source
from mme_vla.weights.writers import check_target, write_policy


def built(name: str = "openvla_oft", seed: int = 1) -> Policy:
    policy = build_policy(name, seed=seed)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    return policy


def saved(policy: Policy, folder: Path, fmt: str = "openvla") -> Path:
    folder.mkdir()
    write_policy(policy, folder, fmt, torch.float32, policy.require_processor().stats)
    return folder


def test_a_run_is_saved_in_the_published_names_and_read_again(tmp_path: Path) -> None:
    policy = built()
    folder = saved(policy, tmp_path / "run")
    assert open_source(folder).format == "openvla"
    names = set(load_file(folder / "model.safetensors"))
    assert {
        "vision_backbone.featurizer.blocks.0.ls1.scale_factor",
        "language_model.lm_head.weight",
    } <= names
    head = torch.load(folder / "action_head--0_checkpoint.pt", weights_only=True)
    assert "module.model.mlp_resnet_blocks.1.ffn.1.weight" in head
    other = built(seed=2)
    other.require_processor().stats = None
    assert not same(policy, other)
    load_weights(other, folder)
    assert same(policy, other) and other.require_processor().stats is not None


@pytest.mark.parametrize("module", ["vision_backbone", "noisy_action_projector"])
def test_a_run_with_modules_that_no_policy_has_is_refused(module: str, tmp_path: Path) -> None:
    folder = saved(built(), tmp_path / "run")
    torch.save(
        {"module.featurizer.scale": torch.ones(2)}, folder / f"{module}--150000_checkpoint.pt"
    )
    with pytest.raises(UserError, match=f"{module}--150000_checkpoint.pt"):
        load_weights(built(seed=2), folder)


def test_openvla_itself_is_a_start_that_lacks_head_state_token_and_memory(tmp_path: Path) -> None:
    folder = saved(built(), tmp_path / "base")
    for file in folder.glob("*.pt"):
        file.unlink()
    for name in ("openvla_oft", "openvla_oft_framesamp_context"):
        policy = built(name, seed=2)
        took = transfer(policy, folder)
        assert took.new and all(
            policy.finetune_spec.component_of(new) in ("action", "memory") for new in took.new
        )
        assert not took.left
    with pytest.raises(UserError, match="action_head/model"):
        load_weights(built(seed=2), folder)


def test_a_run_that_holds_its_adapters_alone_is_read_beside_its_base(tmp_path: Path) -> None:
    policy, run = built(), tmp_path / "run"
    base = saved(policy, tmp_path / "base")
    (run / "lora_adapter").mkdir(parents=True)
    for file in base.glob("*.pt"):
        file.rename(run / file.name)
    apply_finetuning(policy, "lora", freeze_vision=False, rank=2, alpha=3.0)
    generator = torch.Generator().manual_seed(0)
    adapters = {}
    for name, parameter in policy.named_parameters():
        if ".lora_" in name:
            torch.nn.init.normal_(parameter, generator=generator)
            source = str(openvla_name(name)).removeprefix(VLA).replace(".default.", ".")
            adapters[f"base_model.model.{source}"] = parameter.detach().clone()
    save_file(adapters, run / "lora_adapter" / "adapter_model.safetensors")
    config = {"r": 2, "lora_alpha": 3.0, "base_model_name_or_path": "openvla/openvla-7b"}
    (run / "lora_adapter" / "adapter_config.json").write_text(json.dumps(config))
    merge_adapters(policy)
    read = load_weights(built(seed=2), run, base=base)
    merged, loaded, fresh = policy.state_dict(), read.state_dict(), built().state_dict()
    for name, tensor in merged.items():
        torch.testing.assert_close(loaded[name], tensor, msg=name)
    assert (
        sum(not torch.equal(tensor, fresh[name]) for name, tensor in loaded.items())
        == len(adapters) // 2
    )
    with pytest.raises(UserError, match=r"adapters apart .*openvla/openvla-7b.*base="):
        load_weights(built(seed=2), run)
    with pytest.raises(UserError, match="leave it out"):
        load_weights(built(seed=2), base, base=base)
    adapters.pop(next(name for name in adapters if name.endswith("lora_B.weight")))
    save_file(adapters, run / "lora_adapter" / "adapter_model.safetensors")
    with pytest.raises(UserError, match="fits no matrix of the base model"):
        load_weights(built(seed=2), run, base=base)


def test_what_the_format_has_no_name_for_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds OpenVLA and OpenVLA-OFT"):
        check_target(build_policy("pi05"), "openvla")
    lora_targets = built()
    apply_finetuning(lora_targets, "lora", freeze_vision=False, rank=2)
    for policy in (built("openvla_oft_framesamp_context"), lora_targets):
        (folder := tmp_path / policy.config["name"]).mkdir(exist_ok=True)
        with pytest.raises(UserError, match="This format has no name"):
            write_policy(policy, folder, "openvla", torch.float32, None)
