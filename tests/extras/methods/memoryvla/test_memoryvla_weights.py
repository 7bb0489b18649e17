"""MemoryVLA's own files: written, and read again."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from helpers.memory_fakes import same
from mme_vla import UserError, build_policy
from mme_vla.extras.methods.memoryvla.weights import memoryvla_adapter
from mme_vla.extras.methods.openvla_oft.weights import VLA, openvla_adapter
from mme_vla.policy.base import Policy
from mme_vla.weights.load import load_weights, transfer
from mme_vla.weights.source import open_source
from mme_vla.weights.writers import check_target, write_policy


def test_a_checkpoint_is_saved_by_components_and_read_again(tmp_path: Path) -> None:
    policy, other = (build_policy("memoryvla", seed=seed) for seed in (1, 2))
    write_policy(policy, tmp_path, "memoryvla", torch.float32, None)
    file = tmp_path / "model.pt"
    model = torch.load(file, weights_only=True)["model"]
    assert model["per_compr"]["reduce.weight"].ndim == 4
    assert "retrieval_blocks.0.q_proj.weight" in model["cog_mem_bank"]
    # as CogACT's hold
    model["action_model"]["net.history_embedder.linear.weight"] = torch.zeros(2, 2)
    torch.save({"model": model}, file)
    assert open_source(file).format == "memoryvla"
    load_weights(other, file)
    assert same(policy, other)


def of_vlm(policy: Policy) -> dict[str, torch.Tensor]:
    return {name: tensor for name, tensor in policy.state_dict().items() if name.startswith("vlm.")}


def test_openvla_is_a_start_that_has_nothing_of_banks_and_head(tmp_path: Path) -> None:
    """Small files in the layout of `openvla/openvla-7b`, and in that of its Prismatic original."""
    # as large as memoryvla_tiny
    openvla = build_policy("openvla_oft", seed=1, backbone={"vision": {"image_size": 56}})
    source_names = openvla_adapter(openvla).export(openvla.state_dict())
    base = {
        name.removeprefix(VLA): tensor.contiguous()
        for name, tensor in source_names.items()
        if name.startswith(VLA)
    }
    save_file(base, tmp_path / "model.safetensors")
    expected = {
        n.removeprefix("backbone."): t
        for n, t in openvla.state_dict().items()
        if n.startswith("backbone.vlm.")
    }
    policy = build_policy("memoryvla", seed=2)
    fresh = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    took = transfer(policy, tmp_path)
    assert set(took.taken) == set(expected) and not took.left
    assert all(torch.equal(tensor, expected[name]) for name, tensor in of_vlm(policy).items())
    assert all(torch.equal(policy.state_dict()[name], fresh[name]) for name in took.new)
    with pytest.raises(UserError, match="missing"):
        load_weights(policy, tmp_path)

    names_ = memoryvla_adapter(policy).export(policy.state_dict())
    model: dict[str, dict[str, torch.Tensor]] = {}
    for name, tensor in names_.items():
        part, _, stem = name.partition(".")
        if part in ("vision_backbone", "projector", "llm_backbone"):
            model.setdefault(part, {})[stem] = tensor
    torch.save({"model": model}, tmp_path / "prismatic.pt")
    other = build_policy("memoryvla", seed=3)
    took = transfer(other, tmp_path / "prismatic.pt")
    assert set(took.taken) == set(expected) and of_vlm(other).keys() == of_vlm(policy).keys()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in of_vlm(other).items())


def test_another_policy_has_no_place_in_it() -> None:
    with pytest.raises(UserError, match="holds MemoryVLA"):
        check_target(build_policy("pi05"), "memoryvla")
