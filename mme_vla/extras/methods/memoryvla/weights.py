"""What MemoryVLA calls its tensors, and how they lie: 1×1 convolutions are linear layers here."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from mme_vla.extras.methods.memoryvla.policy import MemoryVlaPolicy
from mme_vla.policy.base import Policy
from mme_vla.policy.tensor_files import cast
from mme_vla.processing.normalise import NormStats
from mme_vla.weights.tables import Adapter, NameTable, Piece, wrong_policy

_CONVOLUTION = "o i 1 1 -> o i"
_BANK = r"(cognition|perceptual)_bank"

_RULES = tuple(
    (re.compile(rf"^(?:core\.)?{target}$"), source, pattern)
    for target, source, pattern in (
        (r"vlm\.vision\.dino\.(.*)", r"vision_backbone.dino_featurizer.\1", ""),
        (r"vlm\.vision\.siglip\.(.*)", r"vision_backbone.siglip_featurizer.\1", ""),
        (r"vlm\.projector\.fc1\.(.*)", r"projector.projector.0.\1", ""),
        (r"vlm\.projector\.fc2\.(.*)", r"projector.projector.2.\1", ""),
        (r"vlm\.projector\.fc3\.(.*)", r"projector.projector.4.\1", ""),
        (r"vlm\.language\.(.*)", r"llm_backbone.llm.\1", ""),
        (r"compression\.(reduce|expand)\.weight", r"per_compr.\1.weight", _CONVOLUTION),
        (r"compression\.squeeze\.weight", r"per_compr.excite.1.weight", _CONVOLUTION),
        (r"compression\.squeeze\.bias", r"per_compr.excite.1.bias", ""),
        (r"compression\.excite\.weight", r"per_compr.excite.3.weight", _CONVOLUTION),
        (r"compression\.excite\.bias", r"per_compr.excite.3.bias", ""),
        (
            rf"{_BANK}\.blocks\.(\d+)\.(query|key|value)\.(.*)",
            r"\1_bank.retrieval_blocks.\2.\3.\4",
            "",
        ),
        (
            rf"{_BANK}\.blocks\.(\d+)\.attention_norm\.(.*)",
            r"\1_bank.retrieval_blocks.\2.attn_norm.\3",
            "",
        ),
        (rf"{_BANK}\.blocks\.(\d+)\.mlp_in\.(.*)", r"\1_bank.retrieval_blocks.\2.ffn.0.\3", ""),
        (rf"{_BANK}\.blocks\.(\d+)\.mlp_out\.(.*)", r"\1_bank.retrieval_blocks.\2.ffn.2.\3", ""),
        (
            rf"{_BANK}\.blocks\.(\d+)\.mlp_norm\.(.*)",
            r"\1_bank.retrieval_blocks.\2.ffn_norm.\3",
            "",
        ),
        (rf"{_BANK}\.gate\.(.*)", r"\1_bank.gate_fusion_blocks.proj.\2", ""),
        (rf"{_BANK}\.time\.input\.(.*)", r"\1_bank.timestep_encoder.mlp.0.\2", ""),
        (rf"{_BANK}\.time\.output\.(.*)", r"\1_bank.timestep_encoder.mlp.2.\2", ""),
        (r"head\.positions", r"action_model.net.positional_embedding", ""),
        (r"head\.action\.(.*)", r"action_model.net.x_embedder.linear.\1", ""),
        (r"head\.time_in\.(.*)", r"action_model.net.t_embedder.mlp.0.\1", ""),
        (r"head\.time_out\.(.*)", r"action_model.net.t_embedder.mlp.2.\1", ""),
        (r"head\.nothing", r"action_model.net.z_embedder.uncondition", ""),
        (r"head\.cognition\.(.*)", r"action_model.net.z_embedder.linear.\1", ""),
        (r"head\.perceptual\.(.*)", r"action_model.net.per_token_embedder.linear.\1", ""),
        (r"head\.blocks\.(\d+)\.attention\.(.*)", r"action_model.net.blocks.\1.attn.\2", ""),
        (r"head\.blocks\.(\d+)\.mlp\.(.*)", r"action_model.net.blocks.\1.mlp.\2", ""),
        (r"head\.blocks\.(\d+)\.cross\.(.*)", r"action_model.net.blocks.\1.per_attn.\2", ""),
        (r"head\.blocks\.(\d+)\.cross_norm\.(.*)", r"action_model.net.blocks.\1.norm3.\2", ""),
        (r"head\.output\.(.*)", r"action_model.net.final_layer.linear.\1", ""),
    )
)
_WORDS = {"cognition_bank": "cog_mem_bank", "perceptual_bank": "per_mem_bank"}
_PROJECTIONS = {".query.": ".q_proj.", ".key.": ".k_proj.", ".value.": ".v_proj."}


def memoryvla_piece(target: str) -> Piece | None:
    """Where one of our tensors lies there; None where it has no name."""
    for pattern, replacement, layout in _RULES:
        if pattern.match(target):
            source = pattern.sub(replacement, target)
            for words in (_WORDS, _PROJECTIONS) if "_bank." in target else ():
                for word, their in words.items():
                    source = source.replace(word, their)
            return Piece(source, layout)
    return None


def memoryvla_table(names: Iterable[str]) -> NameTable:
    """The table of those of our tensors that have a name there."""
    table: NameTable = {}
    for name in names:
        piece = memoryvla_piece(name)
        if piece is not None:
            table[name] = [piece]
    return table


WEIGHTS = "model.pt"
_COMPONENTS = ("memory", "action")
"""Parts that Prismatic's checkpoints have nothing of."""
_DROPPED = "action_model.net.history_embedder."  # CogACT's, which nothing reads


def is_memoryvla(names: Iterable[str]) -> bool:
    """Whether tensors are named as in the authors' checkpoints, or in those of Prismatic that they
    start from.
    """
    present = set(names)
    return (
        "vision_backbone.dino_featurizer.cls_token" in present
        and "llm_backbone.llm.model.norm.weight" in present
    )


def read_names(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Tensors without those that only CogACT's checkpoints hold."""
    return {name: tensor for name, tensor in tensors.items() if not name.startswith(_DROPPED)}


def memoryvla_adapter(policy: Policy) -> Adapter:
    """The authors' names of this policy's tensors; what they start from lacks banks and head."""
    if not isinstance(policy, MemoryVlaPolicy):
        raise wrong_policy(policy, "MemoryVLA", "model=memoryvla")
    names = policy.state_dict()
    return Adapter(
        memoryvla_table(names),
        fresh=frozenset(n for n in names if policy.finetune_spec.component_of(n) in _COMPONENTS),
        of_memory=r"_mem_bank\.",
    )


def write_memoryvla(
    policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None
) -> None:
    """`model.pt` as the authors' training writes it; their statistics are of other actions, and
    none are written.
    """
    model: dict[str, dict[str, Tensor]] = {}
    for name, tensor in memoryvla_adapter(policy).export(policy.state_dict()).items():
        part, _, suffix = name.partition(".")
        model.setdefault(part, {})[suffix] = cast(tensor.detach(), dtype).cpu().contiguous()
    torch.save({"model": model}, folder / WEIGHTS)
