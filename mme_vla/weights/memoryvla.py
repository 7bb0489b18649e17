"""MemoryVLA's own checkpoints: `.pt` files {model: {part: {name: tensor}}}."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.policy.base import Policy
from mme_vla.policy.memoryvla.policy import MemoryVlaPolicy
from mme_vla.policy.tensor_files import cast
from mme_vla.processing.normalisers import NormStats
from mme_vla.weights.adapter import Adapter
from mme_vla.weights.names.memoryvla import memoryvla_table

WEIGHTS = "model.pt"
_OWN = ("memory", "action")
"""Parts that Prismatic's checkpoints have nothing of."""
_DROPPED = "action_model.net.history_embedder."  # CogACT's, which nothing reads


def is_memoryvla(names: Iterable[str]) -> bool:
    """Whether tensors are named as in the authors' checkpoints, or in those of Prismatic that they start from."""
    found = set(names)
    return "vision_backbone.dino_featurizer.cls_token" in found and "llm_backbone.llm.model.norm.weight" in found


def read_names(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Tensors without those that only CogACT's checkpoints hold."""
    return {name: tensor for name, tensor in tensors.items() if not name.startswith(_DROPPED)}


def memoryvla_adapter(policy: Policy) -> Adapter:
    """The authors' names of this policy's tensors; what they start from lacks banks and head.

    Raises:
        UserError: it is another kind of policy.
    """
    if not isinstance(policy, MemoryVlaPolicy):
        raise UserError(
            f"This format holds MemoryVLA; {policy.config.get('name', 'this')} is a {type(policy).__name__}. "
            "Set model=memoryvla."
        )
    names = policy.state_dict()
    return Adapter(memoryvla_table(names), fresh=frozenset(n for n in names if policy.part_of(n) in _OWN))


def write_memoryvla(policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None) -> None:
    """`model.pt` as the authors' training writes it; their statistics are of other actions, and none are written.

    Raises:
        UserError: another kind of policy.
    """
    model: dict[str, dict[str, Tensor]] = {}
    for name, tensor in memoryvla_adapter(policy).export(policy.state_dict()).items():
        part, _, own = name.partition(".")
        model.setdefault(part, {})[own] = cast(tensor.detach(), dtype).cpu().contiguous()
    torch.save({"model": model}, folder / WEIGHTS)
