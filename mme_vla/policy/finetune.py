"""Which parameters of a policy learn: all of them, the action side, or low-rank adapters
(configs/finetune).

`Policy.finetune_spec` maps parameters to components. Of π0.5, from the outside in: `vision` (tower
and projector), `vlm` (token embedding and VLM expert), `action` (action expert, its final norm,
action and time heads) and `memory` (memory, integration, and the memory's own expert).
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from mme_vla.errors import UserError, brief, check_choice, did_you_mean, missing_extra, require
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.tensor_files import dtype_of

if TYPE_CHECKING:
    from mme_vla.policy.base import Policy

MODES = ("full", "expert_only", "lora")
INITS: Mapping[str, Any] = {"uniform": True, "gaussian": "gaussian"}  # ours → peft's
ADAPTER = "default"  # peft's name of the one adapter a policy carries


def apply_finetuning(
    policy: "Policy",
    mode: str = "full",
    *,
    freeze_vision: bool = True,
    rank: int = 16,
    alpha: float = 16.0,
    dropout: float = 0.0,
    init: str = "uniform",
    targets: Sequence[str] | None = None,
    train: Sequence[str] | None = None,
    frozen_dtype: str | None = None,
    seed: int = 42,
) -> dict[str, int]:
    """Set which parameters of a policy receive gradients; in mode `lora`, add the adapters that do.

    Load weights to start from before this: adapters rename the matrices they wrap.

    Args:
        mode: `full`: everything. `expert_only`: the parts `action` and `memory`. `lora`: low-rank
            adapters on `targets`, and in full what `train` names.
        freeze_vision: leave the vision tower as it is in every mode; needed where a memory reads
            cached tokens.
        rank, alpha, dropout: of the adapters: W + (alpha / rank)·B·A.
        init: distribution of A: `uniform` (Kaiming), or `gaussian` of deviation 1 / rank; B begins
            at zero.
        targets: linear layers and convolutions, by the end of their name: `experts.vlm.qkv` is that
            matrix in every layer. By default those the policy names (`Policy.finetune_spec`).
        train: with `lora`, what learns in full beside them: parts, or ends of module names such as
            `action_out`. By default the memory and the policy's heads.
        frozen_dtype: `bfloat16` holds what is not trained at half the size, as the released
            training does; it rounds those weights, and requires compute in bfloat16.
        seed: of A, which the state of PyTorch's own generators does not change.

    Returns:
        Trained parameters per part, adapters counted in the part they wrap.
    """
    check_choice("finetune.mode", mode, MODES)
    if frozen_dtype is not None:
        rounds = dtype_of(frozen_dtype, "finetune.frozen_dtype") != torch.float32
        if rounds and policy.compute_dtype == torch.float32:
            raise UserError(
                f"finetune.frozen_dtype={frozen_dtype} rounds weights that"
                " policy.compute_dtype=float32 would not: set policy.compute_dtype=bfloat16 too, or"
                " leave frozen_dtype at null."
            )
    spec = policy.finetune_spec
    train = ("memory", *spec.full_train) if train is None else train
    if mode == "lora":
        in_full = _named(policy, train)  # before anything is changed
        add_adapters(
            policy, rank=rank, alpha=alpha, dropout=dropout, init=init, targets=targets, seed=seed
        )
    counts = dict.fromkeys(spec.components, 0)
    for name, parameter in policy.named_parameters():
        part = spec.component_of(name)
        if mode == "full":
            learns = True
        elif mode == "expert_only":
            learns = part in ("action", "memory")
        else:
            is_named = any(name.startswith(f"{module}.") for module in in_full)
            learns = ".lora_" in name or is_named or part in train
        if part == "vision" and freeze_vision:
            learns = False
        if spec.frozen is not None and re.match(spec.frozen, name):
            learns = False
        parameter.requires_grad_(learns)
        if learns:
            counts[part] += parameter.numel()
    cast_frozen(policy, frozen_dtype)
    if not any(counts.values()):
        raise UserError(
            f"finetune.mode={mode} with freeze_vision={freeze_vision} leaves no parameter of this"
            f" policy to train; choose another of {', '.join(MODES)}."
        )
    return counts


def warn_of_frozen_random_weights(mode: str) -> None:
    """Warn that a mode that freezes most weights begins with random ones.

    With `lora` nothing of the experts can learn then: the gates of fresh adaptive norms are zero
    and frozen, so that no adapter behind them gets a gradient.
    """
    if mode == "full":
        return
    effect = "it"
    if mode == "lora":
        effect = "its adapters get no gradient behind gates that are zero, and"
    warnings.warn(
        f"finetune={mode} without init_from: weights that stay as they are are random, so {effect}"
        " can learn next to nothing. Name weights to start from (init_from=…), or train everything"
        " (finetune=full).",
        stacklevel=2,
    )


def copy_tower(source: "Policy", policy: "Policy") -> None:
    """Give a policy the vision tower of another of the same composition."""
    component_of = source.finetune_spec.component_of
    targets = dict(policy.named_parameters())
    with torch.no_grad():
        for name, value in source.named_parameters():
            if component_of(name) == "vision" and name in targets:
                targets[name].copy_(value)


def cast_frozen(policy: "Policy", name: str | None) -> None:
    """Hold what is not trained in this dtype (None: as it is)."""
    if name is not None:
        for parameter in policy.parameters():
            if not parameter.requires_grad and parameter.is_floating_point():
                parameter.data = parameter.data.to(dtype_of(name))


def add_adapters(
    policy: "Policy",
    *,
    rank: int,
    alpha: float,
    dropout: float = 0.0,
    init: str = "uniform",
    targets: Sequence[str] | None = None,
    seed: int = 42,
) -> None:
    """Wrap layers with LoRA adapters, in place; `save_pretrained` keeps them apart, and they load
    again.
    """
    has_adapters = any(".lora_" in name for name, _ in policy.named_parameters())
    adapters = PolicySections.of(policy.config).adapters
    require(
        not (adapters and has_adapters), "This policy has adapters already: merge_adapters() first."
    )
    require(
        rank >= 1 and alpha > 0 and 0 <= dropout < 1,
        f"finetune: rank={rank}, alpha={alpha}, dropout={dropout}: need rank ≥ 1, alpha > 0,"
        " dropout in [0, 1).",
    )
    check_choice("finetune.init", init, INITS)
    targets = list(policy.finetune_spec.lora_targets if targets is None else targets)
    target_modules = _targets(policy, targets)
    try:
        from peft import LoraConfig, inject_adapter_in_model
    except ImportError:
        raise missing_extra("LoRA", "vlm") from None
    options: dict[str, Any] = {
        "lora_alpha": alpha,
        "target_modules": target_modules,
        "init_lora_weights": INITS[init],
    }
    config = LoraConfig(r=rank, lora_dropout=dropout, **options)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        inject_adapter_in_model(config, policy, ADAPTER)
    policy.config["adapters"] = {
        "rank": rank,
        "alpha": alpha,
        "dropout": dropout,
        "init": init,
        "targets": targets,
    }


def merge_adapters(policy: "Policy") -> None:
    """Fold the adapters into the matrices they wrap: a plain policy again, every parameter
    trainable.
    """
    from peft.tuners.tuners_utils import BaseTunerLayer

    for name, module in list(policy.named_modules()):
        if isinstance(module, BaseTunerLayer):
            module.merge()
            parent, _, leaf = name.rpartition(".")
            setattr(policy.get_submodule(parent), leaf, module.get_base_layer())
    policy.config.pop("adapters", None)
    for parameter in policy.parameters():
        parameter.requires_grad_(True)


def merge_state(tensors: Mapping[str, Tensor], adapters: Mapping[str, Any]) -> dict[str, Tensor]:
    """Fold the adapters of saved weights, as `merge_adapters` does of a policy; without adapters
    nothing changes.
    """
    merged = {
        name.replace(".base_layer.", "."): tensor
        for name, tensor in tensors.items()
        if ".lora_" not in name
    }
    if not adapters:
        return merged
    try:
        scale = adapters["alpha"] / adapters["rank"]
        for name, down in tensors.items():
            if f".lora_A.{ADAPTER}." in name:
                up = tensors[name.replace(".lora_A.", ".lora_B.")]
                target = name.replace(f".lora_A.{ADAPTER}.", ".")
                weight = merged[target]
                # A convolution's A is [r, in, k, k] and its B [out, r, 1, 1]: the product of their
                # rows and columns.
                product = (up.float().flatten(1) @ down.float().flatten(1)).view_as(weight)
                merged[target] = (weight.float() + scale * product).to(weight.dtype)
    except (KeyError, TypeError, ZeroDivisionError, RuntimeError) as error:
        reason = brief(str(error), 200, quote=False)
        raise UserError(
            f"A checkpoint's adapters {brief(adapters)} do not fit its weights ({reason})."
        ) from error
    return merged


def _targets(policy: "Policy", targets: Sequence[str]) -> list[str]:
    """Full names of the layers that the targets mean (what is the memory's learns in full)."""
    spec = policy.finetune_spec
    layers = []
    for name, module in policy.named_modules():
        if isinstance(module, nn.Linear | nn.Conv2d) and spec.component_of(f"{name}.") != "memory":
            layers.append(name)
    selected: list[str] = []
    for target in targets:
        matching = [name for name in layers if f".{name}".endswith(f".{target}")]
        if not matching:
            raise UserError(
                "finetune.targets: no linear layer of the policy's other parts ends in"
                f" {target!r}. " + _near(target, layers)
            )
        for name in matching:
            if spec.lora_exclude is not None and re.search(spec.lora_exclude, name):
                raise UserError(
                    f"finetune.targets: {target!r} means {name}, whose weight is used in float32"
                    " past any adapter: it would never act. Train it in full (finetune.train), or"
                    " leave it."
                )
        selected += matching
    if not selected:
        raise UserError(
            "finetune.targets is empty: LoRA needs layers to adapt, such as"
            f" {', '.join(spec.lora_targets[:2])}."
        )
    return sorted(set(selected))


def _named(policy: "Policy", train: Sequence[str]) -> list[str]:
    """Full names of the modules that `train` means; parts are left to the caller."""
    modules = [name for name, _ in policy.named_modules() if name]
    components = policy.finetune_spec.components
    selected: list[str] = []
    for entry in train:
        if entry in components:
            continue
        matching = [name for name in modules if f".{name}".endswith(f".{entry}")]
        if not matching:
            raise UserError(
                f"finetune.train: {entry!r} is no part and no module."
                f" {_near(entry, [*components, *modules])}"
            )
        selected += matching
    return selected


def _near(target: str, names: Sequence[str]) -> str:
    """The endings of names that look most like the target; numbered layers are named once."""
    endings = {re.sub(r"^.*\.\d+\.", "", name) for name in names}
    return did_you_mean(target, endings)
