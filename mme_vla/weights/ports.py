"""The PyTorch ports of π0.5: LeRobot's `pi05` and openpi's `PI0Pytorch`. One grammar of names in many spellings.

Spellings that occur: with a leading `model.` (LeRobot) or without; `vision_tower` with an inner `vision_model` or
without (transformers 5.23); modules without the inner `model.` (before transformers 4.52); the embedding stored only as
`lm_head`, which it is tied to (`safetensors.torch.save_model` keeps one name of a tied pair).
"""

import re
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from mme_vla.errors import UserError, brief
from mme_vla.policy.mme import MMEPolicy
from mme_vla.weights.adapter import Adapter, pi05_of
from mme_vla.weights.name_tables import prefixed
from mme_vla.weights.names import torch_backbone as names

LEROBOT_PREFIX = "model."
_VLM = rf"^{names.ROOT}\.paligemma\."
_SPELLINGS = [
    (r"^model\.", ""),
    (rf"{_VLM}language_model\.lm_head\.", f"{names.ROOT}.paligemma.lm_head."),
    (rf"{_VLM}language_model\.model\.", f"{names.EXPERTS['vlm']}."),
    (rf"{_VLM}(vision_tower|multi_modal_projector)\.", rf"{names.ROOT}.paligemma.model.\1."),
    (rf"{_VLM}model\.vision_tower\.(?!vision_model\.)", f"{names.VISION}."),
]
WINDOW_MEMORY = {"use_visual_memory": "past pictures in its vision tower", "use_proprioceptive_memory": "past states"}
"""LeRobot's short-window memory of π0.5, by the settings that turn it on; the first adds no tensors."""
HISTORY = "proprio_history_proj"
"""The tensors that the second adds."""
_PI0 = re.compile(r"^(state_proj|action_time_mlp_(in|out))\.")


def port_adapter(policy: MMEPolicy) -> Adapter:
    """The tensors of a memoryless policy, or the memoryless part of another, in the ports' names (without `model.`)."""
    table = prefixed("backbone", names.torch_names(pi05_of(policy)))
    return Adapter(table, names.torch_unread(pi05_of(policy)), names.TIED)


def is_port(tensor_names: list[str]) -> bool:
    """Whether tensors are named as in a port of π0 or π0.5, in whatever spelling."""
    return any(_respell(name).startswith(f"{names.ROOT}.") for name in tensor_names)


def from_port(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Bring a port's tensors to the one spelling of the name table, the embedding under its own name.

    Raises:
        UserError: two tensors that mean the same one, or a checkpoint of π0, whose network is another.
    """
    spelled: dict[str, str] = {}
    for name in tensors:
        taken = spelled.setdefault(_respell(name), name)
        if taken != name:
            raise UserError(f"{source} holds the same tensor twice, as {taken} and as {name}.")
    found = {name: tensors[theirs] for name, theirs in spelled.items()}
    adaptive = any(name.startswith(names.EXPERTS["action"]) and ".dense." in name for name in found)
    if not adaptive or any(_PI0.match(name) for name in found):
        raise UserError(
            f"{source} is not π0.5: its action expert has "
            + ("a state projection" if adaptive else "no time-conditioned norms")
            + ", as π0 has. Only π0.5 checkpoints fit."
        )
    if names.EMBEDDING not in found and names.HEAD in found:
        found[names.EMBEDDING] = found[names.HEAD]
    return found


def check_window(config: Mapping[str, Any], source: str) -> None:
    """Refuse a checkpoint of LeRobot's π0.5 that was trained to look at several frames, which this network cannot.

    Raises:
        UserError: its `config.json` turns a short-window memory on.
    """
    seen = [what for setting, what in WINDOW_MEMORY.items() if config.get(setting)]
    if seen:
        frames, stride = (brief(config.get(key)) for key in ("memory_frames", "memory_stride"))
        raise UserError(
            f"{source} reads {' and '.join(seen)} (LeRobot's short-window memory: memory_frames={frames}, "
            f"memory_stride={stride}), which this library's π0.5 does not: whole, it would act on less than it was "
            "trained with. To begin training from its weights use start_from() (on the command line: init_from=…)."
        )


def to_lerobot(policy: MMEPolicy, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """LeRobot's state dict: all names with `model.`, embedding and language head both."""
    return {LEROBOT_PREFIX + name: tensor for name, tensor in port_adapter(policy).export(tensors).items()}


def to_openpi(policy: MMEPolicy, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Openpi's state dict, embedding and language head both."""
    return port_adapter(policy).export(tensors)


def _respell(name: str) -> str:
    for pattern, canonical in _SPELLINGS:
        name = re.sub(pattern, canonical, name)
    return name
