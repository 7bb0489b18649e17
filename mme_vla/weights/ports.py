"""The PyTorch ports of π0.5: LeRobot's `pi05` and openpi's `PI0Pytorch`. One grammar of names in
many spellings.

Spellings that occur: with a leading `model.` (LeRobot) or without; `vision_tower` with an inner
`vision_model` or without (transformers 5.23); modules without the inner `model.` (before
transformers 4.52); the embedding stored only as `lm_head`, which it is tied to
(`safetensors.torch.save_model` keeps one name of a tied pair).
"""

import re
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from mme_vla.errors import UserError, brief, require
from mme_vla.memory.extensions.spacetime import SpaceTime
from mme_vla.policy.base import Policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.weights.names import torch_backbone as names
from mme_vla.weights.tables import Adapter, Piece, pi05_of, prefixed

LEROBOT_PREFIX = "model."
_VLM = rf"^{names.ROOT}\.paligemma\."
_SPELLINGS = [
    (r"^model\.", ""),
    (rf"{_VLM}language_model\.lm_head\.", f"{names.ROOT}.paligemma.lm_head."),
    (rf"{_VLM}language_model\.model\.", f"{names.EXPERTS['vlm']}."),
    (rf"{_VLM}(vision_tower|multi_modal_projector)\.", rf"{names.ROOT}.paligemma.model.\1."),
    (rf"{_VLM}model\.vision_tower\.(?!vision_model\.)", f"{names.VISION}."),
]
WINDOW_MEMORY = {
    "use_visual_memory": "past images in its vision tower",
    "use_proprioceptive_memory": "past states",
}
"""LeRobot's short-window memory of π0.5, by the settings that turn it on; the first adds no
tensors.
"""
HISTORY = "proprio_history_proj"
"""The tensors that the second adds."""
WINDOW = {
    "memory_frames": ("frames", 6),
    "memory_stride": ("stride", 30),
    "memory_temporal_attention_every": ("every", 4),
}
"""Its other settings: how the memory `spacetime` calls them, and what LeRobot takes where they are
not written.
"""
_PI0 = re.compile(r"^(state_proj|action_time_mlp_(in|out))\.")


def port_adapter(policy: MMEPolicy) -> Adapter:
    """The tensors of a memoryless policy, or the memoryless part of another, in the ports' names
    (without `model.`).

    Of the memory `spacetime` the layer of past states has a name too, where its tokens are as wide
    as the prefix.
    """
    backbone = pi05_of(policy)
    table = prefixed("backbone", names.torch_names(backbone))
    memory = policy.memory
    if (
        isinstance(memory, SpaceTime)
        and memory.states is not None
        and memory.width == backbone.config.vlm.width
    ):
        for part in ("weight", "bias"):
            table[f"memory.states.{part}"] = [Piece(f"{HISTORY}.{part}")]
    unread = names.torch_unread(backbone)
    return Adapter(table, unread, names.TIED, of_memory=rf"^{HISTORY}\.")


def is_port(tensor_names: list[str]) -> bool:
    """Whether tensors are named as in a port of π0 or π0.5, in whatever spelling."""
    return any(_respell(name).startswith(f"{names.ROOT}.") for name in tensor_names)


def from_port(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Bring a port's tensors to the one spelling of the name table, the embedding under its own
    name.
    """
    spelled: dict[str, str] = {}
    for name in tensors:
        taken = spelled.setdefault(_respell(name), name)
        require(taken == name, f"{source} holds the same tensor twice, as {taken} and as {name}.")
    renamed = {name: tensors[source_name] for name, source_name in spelled.items()}
    action_expert = [name for name in renamed if name.startswith(names.EXPERTS["action"])]
    difference = None
    if not any(".dense." in name for name in action_expert):
        difference = "no time-conditioned norms"
    elif any(_PI0.match(name) for name in renamed):
        difference = "a state projection"
    if difference is not None:
        raise UserError(
            f"{source} is not π0.5: its action expert has {difference}, as π0 has. Only π0.5"
            " checkpoints fit."
        )
    if names.EMBEDDING not in renamed and names.HEAD in renamed:
        renamed[names.EMBEDDING] = renamed[names.HEAD]
    return renamed


def check_window(policy: Policy, config: Mapping[str, Any], source: str) -> None:
    """Refuse a port of π0.5 whose memory is not this policy's: none, or LeRobot's short window."""
    has: dict[str, Any] = {setting: bool(config.get(setting)) for setting in WINDOW_MEMORY}
    if any(has.values()):
        for source_name, (_, default) in WINDOW.items():
            has[source_name] = config.get(source_name, default)
    elif policy.memory is not None:
        raise UserError(
            f"{source} is memoryless π0.5 and this policy has a memory, whose weights would stay"
            " unset. To begin training from it use start_from() (on the command line:"
            " init_from=…)."
        )
    # What LeRobot's settings would be for this policy; all off where it has no such memory.
    memory = policy.memory
    expected: dict[str, Any] = dict.fromkeys(WINDOW_MEMORY, False)
    if isinstance(memory, SpaceTime):
        expected["use_visual_memory"] = memory.past_view_spec is not None
        expected["use_proprioceptive_memory"] = memory.states is not None
        for source_name, (target_name, _) in WINDOW.items():
            expected[source_name] = getattr(memory, target_name)
    is_equal = all(expected.get(setting) == value for setting, value in has.items())
    is_mutual = getattr(getattr(policy, "integration", None), "mutual", False)
    if not is_equal or (has["use_proprioceptive_memory"] and not is_mutual):
        raise UserError(_other_window(has, source))


def _other_window(has: Mapping[str, Any], source: str) -> str:
    """What a policy has to be to load a checkpoint with these settings."""
    kinds = [what for setting, what in WINDOW_MEMORY.items() if has[setting]]
    views, states = (str(has[setting]).lower() for setting in WINDOW_MEMORY)
    integration = "integration=none"
    if has["use_proprioceptive_memory"]:
        integration = "integration=context integration.mutual=true"
    options = []
    for source_name, (target_name, _) in WINDOW.items():
        options.append(f"memory.{target_name}={brief(has[source_name])}")
    window = " ".join(options)
    frames = brief(has["memory_frames"])
    stride = brief(has["memory_stride"])
    return (
        f"{source} reads {' and '.join(kinds)} (LeRobot's short-window memory:"
        f" memory_frames={frames}, memory_stride={stride}), which this policy does not, or not so:"
        " whole, it would act on other things than it was trained with. Build the one that does:"
        f" memory=spacetime {integration} {window} memory.views={views} memory.states={states}. To"
        " begin training another from its weights use start_from() (on the command line:"
        " init_from=…)."
    )


def to_lerobot(policy: MMEPolicy, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """LeRobot's state dict: all names with `model.`, embedding and language head both."""
    named = to_openpi(policy, tensors)
    return {LEROBOT_PREFIX + name: tensor for name, tensor in named.items()}


def to_openpi(policy: MMEPolicy, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Openpi's state dict, embedding and language head both."""
    return port_adapter(policy).export(tensors)


def _respell(name: str) -> str:
    for pattern, canonical in _SPELLINGS:
        name = re.sub(pattern, canonical, name)
    return name
