"""What OpenVLA and OpenVLA-OFT call their tensors: the model's own files, the action head's and the state projector's.

OpenVLA-OFT writes three files. Here each tensor has the name in its file behind the name of that file's module:
`vla/`, `action_head/`, `proprio_projector/`. Matrices lie as ours do.
"""

import re
from collections.abc import Iterable

from mme_vla.weights.name_tables import NameTable, Piece

VLA, HEAD, STATE = "vla/", "action_head/", "proprio_projector/"

_RULES = tuple(
    (re.compile(ours), theirs)
    for ours, theirs in (
        (r"^backbone\.vlm\.vision\.dino\.(.*)\.gamma$", rf"{VLA}vision_backbone.featurizer.\1.scale_factor"),
        (r"^backbone\.vlm\.vision\.dino\.(.*)$", rf"{VLA}vision_backbone.featurizer.\1"),
        (r"^backbone\.vlm\.vision\.siglip\.(.*)$", rf"{VLA}vision_backbone.fused_featurizer.\1"),
        (r"^backbone\.vlm\.projector\.(.*)$", rf"{VLA}projector.\1"),
        (r"^backbone\.vlm\.language\.(.*)$", rf"{VLA}language_model.\1"),
        (r"^backbone\.head\.input_norm\.(.*)$", rf"{HEAD}model.layer_norm1.\1"),
        (r"^backbone\.head\.input\.(.*)$", rf"{HEAD}model.fc1.\1"),
        (r"^backbone\.head\.blocks\.(\d+)\.norm\.(.*)$", rf"{HEAD}model.mlp_resnet_blocks.\1.ffn.0.\2"),
        (r"^backbone\.head\.blocks\.(\d+)\.linear\.(.*)$", rf"{HEAD}model.mlp_resnet_blocks.\1.ffn.1.\2"),
        (r"^backbone\.head\.output_norm\.(.*)$", rf"{HEAD}model.layer_norm2.\1"),
        (r"^backbone\.head\.output\.(.*)$", rf"{HEAD}model.fc2.\1"),
        (r"^backbone\.state_token\.(.*)$", rf"{STATE}\1"),
    )
)


def openvla_name(ours: str) -> str | None:
    """What a tensor of ours is called there, adapters included; None where it has no name.

    The same model under another policy of ours (MemoryVLA's `vlm.…`) has the same names.
    """
    ours = f"backbone.{ours}" if ours.startswith("vlm.") else ours
    for pattern, theirs in _RULES:
        if pattern.match(ours):
            return pattern.sub(theirs, ours)
    return None


def openvla_table(names: Iterable[str]) -> NameTable:
    """The table of those of our tensors that have a name there."""
    pairs = ((name, openvla_name(name)) for name in names)
    return {ours: [Piece(theirs)] for ours, theirs in pairs if theirs is not None}
