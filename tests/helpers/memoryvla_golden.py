"""Golden cases of MemoryVLA: its small network built here with its parameters."""

from typing import Any

import torch
from torch import Tensor

from mme_vla import build_policy
from mme_vla.extras.methods.memoryvla.action_head import DitConfig
from mme_vla.extras.methods.memoryvla.bank import EpisodeBank
from mme_vla.extras.methods.memoryvla.model import MemoryVlaConfig, MemoryVlaCore
from mme_vla.extras.methods.memoryvla.policy import MemoryVlaPolicy
from mme_vla.extras.methods.memoryvla.weights import memoryvla_piece, memoryvla_table
from mme_vla.extras.methods.openvla_oft.config import FusedVisionConfig, LlamaConfig, TowerConfig
from mme_vla.testing.small import unit_stats
from mme_vla.weights.tables import read

OPTIONS = {
    "consolidate_type": "consolidation",
    "fusion_type": "fusion",
    "update_fused": "store_fused",
}
RENAMED = OPTIONS | {"use_timestep_pe": "time_code", "retrieval_layers": "retrieval_layers"}


def bank(
    sizes: dict[str, Any], role: str, weights: dict[str, Tensor], case: dict[str, Any] | None = None
) -> EpisodeBank:
    """A bank of one role with its parameters; a case's options replace those of the sizes."""
    options: dict[str, Any] = {
        "length": sizes["mem_length"],
        "retrieval_layers": sizes["retrieval_layers"],
    }
    options |= {RENAMED[name]: value for name, value in (case or {}).items()}
    built = EpisodeBank(sizes[role], **options)
    word = {"cog": "cognition_bank", "per": "perceptual_bank"}[role]
    table = memoryvla_table(f"{word}.{name}" for name in built.state_dict())
    state = {name.removeprefix(f"{word}."): value for name, value in read(table, weights).items()}
    built.load_state_dict(state)
    return built


def core(sizes: dict[str, Any], weights: dict[str, Tensor]) -> MemoryVlaCore:
    """The whole network behind the VLM, every parameter of the case in its place."""
    tower = [
        TowerConfig(width=sizes[name], depth=2, mlp_dim=1, num_heads=1)
        for name in ("dino", "siglip")
    ]
    side = round(sizes["patches"] ** 0.5)
    config = MemoryVlaConfig(
        vision=FusedVisionConfig(side, 1, *tower),
        vlm=LlamaConfig(sizes["cog"], 1, 1, 1),
        head=DitConfig(sizes["hidden"], sizes["depth"], sizes["heads"]),
        perceptual_width=sizes["per"],
        compression_width=sizes["se_mid"],
        action_dim=sizes["action"],
        horizon=sizes["chunk"],
    )
    banks = (bank(sizes, role, weights) for role in ("cog", "per"))
    built = MemoryVlaCore(config, *banks)
    table = memoryvla_table(built.state_dict())
    used = {piece.path for pieces in table.values() for piece in pieces}
    assert used == set(weights), "every golden parameter has its place"
    built.load_state_dict(read(table, weights))
    return built


def golden_name(name: str) -> str:
    piece = memoryvla_piece(name)
    assert piece is not None, name
    return piece.path


def reached(**options: Any) -> MemoryVlaPolicy:
    """A small policy in which everything that is read reaches the chunk."""
    policy = build_policy("memoryvla", **options)
    assert isinstance(policy, MemoryVlaPolicy)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    generator = torch.Generator().manual_seed(0)
    for (
        name,
        parameter,
    ) in policy.core.named_parameters():  # what begins at zero would hide what does not arrive
        if name.endswith(("head.output.weight", "in_proj_weight")):
            torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    return policy
