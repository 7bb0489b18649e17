"""Which parameters of a policy learn: all of them, the action side, or low-rank adapters (configs/finetune).

Parts of a policy, from the outside in: `vision` (tower and projector), `vlm` (token embedding and VLM expert), `action`
(action expert, its final norm, action and time heads) and `memory` (memory, integration, and the memory's own expert).
"""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor, nn

from mme_vla.errors import UserError, did_you_mean, missing_extra

if TYPE_CHECKING:
    from mme_vla.policy.saving import Saved

PARTS = ("vision", "vlm", "action", "memory")
MODES = ("full", "expert_only", "lora")
ADAPTER = "default"  # peft's name of the one adapter a policy carries

TARGETS = tuple(
    f"experts.{expert}.{layer}"
    for expert in ("vlm", "action")
    for layer in ("qkv", *(("kv",) if expert == "vlm" else ()), "out", "mlp.gate_up", "mlp.down")
)
"""Attention and MLP matrices of both experts; `kv` is what the VLM's last layer has in place of `qkv`."""

HEADS = ("action_in", "action_out", "time_in", "time_out")

# These are computed in float32 from their weight alone, past any adapter that wraps them.
_FLOAT32 = re.compile(rf"\.({'|'.join(HEADS)}|\w*norm\.dense)$")


def apply_finetuning(
    policy: "Saved",
    mode: str = "full",
    *,
    freeze_vision: bool = True,
    rank: int = 16,
    alpha: float = 16.0,
    dropout: float = 0.0,
    targets: Sequence[str] = TARGETS,
    train: Sequence[str] = ("memory", *HEADS),
) -> dict[str, int]:
    """Set which parameters of a policy receive gradients; in mode `lora`, add the adapters that do.

    Load weights to start from before this: adapters rename the matrices they wrap.

    Args:
        mode: `full`: everything. `expert_only`: the parts `action` and `memory`. `lora`: low-rank adapters on
            `targets`, and in full what `train` names.
        freeze_vision: leave the vision tower as it is in every mode; needed where a memory reads cached tokens.
        rank, alpha, dropout: of the adapters: W + (alpha / rank)·B·A.
        targets: linear layers, by the end of their name: `experts.vlm.qkv` is that matrix in every layer.
        train: with `lora`, what learns in full beside them: parts, or ends of module names such as `action_out`.

    Returns:
        Trained parameters per part, adapters counted in the part they wrap.

    Raises:
        UserError: an unknown mode, or a name that matches nothing.
    """
    if mode not in MODES:
        raise UserError(f"finetune.mode={mode!r}. {did_you_mean(str(mode), MODES)}")
    if mode == "lora":
        in_full = _named(policy, train)  # before anything is changed
        add_adapters(policy, rank=rank, alpha=alpha, dropout=dropout, targets=targets)
    for name, parameter in policy.named_parameters():
        part = part_of(name)
        if mode == "full":
            learns = True
        elif mode == "expert_only":
            learns = part in ("action", "memory")
        else:
            learns = ".lora_" in name or any(name.startswith(f"{module}.") for module in in_full) or part in train
        parameter.requires_grad_(learns and not (part == "vision" and freeze_vision))
    counts = dict.fromkeys(PARTS, 0)
    for name, parameter in policy.named_parameters():
        counts[part_of(name)] += parameter.numel() if parameter.requires_grad else 0
    return counts


def part_of(name: str) -> str:
    """The part of a policy that a parameter belongs to."""
    if name.startswith("backbone.vision."):
        return "vision"
    if name.startswith("backbone.embedding.") or ".experts.vlm." in name:
        return "vlm"
    if not name.startswith("backbone.") or re.search(r"\.experts\.(?!action\.)", name):
        return "memory"
    return "action"


def add_adapters(
    policy: "Saved", *, rank: int, alpha: float, dropout: float = 0.0, targets: Sequence[str] = TARGETS
) -> None:
    """Wrap linear layers with LoRA adapters, in place; `save_pretrained` keeps them apart, and they load again.

    Raises:
        UserError: peft is not installed, the policy has adapters already, a size that is not positive, or a target that
            matches no linear layer or one an adapter cannot reach.
    """
    if policy.config.get("adapters") and _has_adapters(policy):
        raise UserError("This policy has adapters already: merge_adapters() first.")
    if rank < 1 or alpha <= 0 or not 0 <= dropout < 1:
        raise UserError(
            f"finetune: rank={rank}, alpha={alpha}, dropout={dropout}: need rank ≥ 1, alpha > 0, dropout in [0, 1)."
        )
    chosen = _targets(policy, targets)
    try:
        from peft import LoraConfig, inject_adapter_in_model
    except ImportError:
        raise missing_extra("LoRA", "vlm") from None
    config = LoraConfig(r=rank, lora_alpha=alpha, lora_dropout=dropout, target_modules=chosen)  # type: ignore[arg-type]
    inject_adapter_in_model(config, policy, ADAPTER)
    policy.config["adapters"] = {"rank": rank, "alpha": alpha, "dropout": dropout, "targets": list(targets)}


def merge_adapters(policy: "Saved") -> None:
    """Fold the adapters into the matrices they wrap: a plain policy again, every parameter trainable."""
    from peft.tuners.tuners_utils import BaseTunerLayer

    for name, module in list(policy.named_modules()):
        if isinstance(module, BaseTunerLayer):
            module.merge()
            parent, _, leaf = name.rpartition(".")
            setattr(policy.get_submodule(parent), leaf, module.get_base_layer())
    policy.config.pop("adapters", None)
    policy.requires_grad_(True)


def merge_state(tensors: Mapping[str, Tensor], adapters: Mapping[str, Any] | None) -> dict[str, Tensor]:
    """Fold the adapters of saved weights, as `merge_adapters` does of a policy; without adapters nothing changes."""
    merged = {name.replace(".base_layer.", "."): tensor for name, tensor in tensors.items() if ".lora_" not in name}
    if adapters:
        scale = adapters["alpha"] / adapters["rank"]
        for name, down in tensors.items():
            if f".lora_A.{ADAPTER}." in name:
                up, target = tensors[name.replace(".lora_A.", ".lora_B.")], name.replace(f".lora_A.{ADAPTER}.", ".")
                weight = merged[target]
                merged[target] = (weight.float() + scale * (up.float() @ down.float())).to(weight.dtype)
    return merged


def _has_adapters(policy: nn.Module) -> bool:
    return any(".lora_" in name for name, _ in policy.named_parameters())


def _targets(policy: nn.Module, targets: Sequence[str]) -> list[str]:
    """Full names of the backbone's linear layers that the targets mean (what is the memory's learns in full)."""
    linear = [name for name, module in policy.named_modules() if isinstance(module, nn.Linear)]
    layers = [name for name in linear if name.startswith("backbone.") and part_of(f"{name}.") != "memory"]
    chosen: list[str] = []
    for target in targets:
        matching = [name for name in layers if f".{name}".endswith(f".{target}")]
        if not matching:
            raise UserError(
                f"finetune.targets: no linear layer of vision, vlm or action ends in {target!r}. "
                + _near(target, layers)
            )
        unreachable = [name for name in matching if _FLOAT32.search(name)]
        if unreachable:
            raise UserError(
                f"finetune.targets: {target!r} means {unreachable[0]}, whose weight is used in float32 past any "
                "adapter: it would never act. Train it in full (finetune.train), or leave it."
            )
        chosen += matching
    if not chosen:
        raise UserError(f"finetune.targets is empty: LoRA needs layers to adapt, such as {', '.join(TARGETS[:2])}.")
    return sorted(set(chosen))


def _named(policy: nn.Module, train: Sequence[str]) -> list[str]:
    """Full names of the modules that `train` means; parts are left to the caller."""
    modules = [name for name, _ in policy.named_modules() if name]
    chosen: list[str] = []
    for entry in train:
        matching = [name for name in modules if f".{name}".endswith(f".{entry}")]
        if not matching and entry not in PARTS:
            raise UserError(f"finetune.train: {entry!r} is no part and no module. {_near(entry, [*PARTS, *modules])}")
        chosen += [] if entry in PARTS else matching
    return chosen


def _near(target: str, names: Sequence[str]) -> str:
    """The endings of names that look most like the target; numbered layers are named once."""
    endings = {re.sub(r"^.*\.\d+\.", "", name) for name in names}
    return did_you_mean(target, endings)
