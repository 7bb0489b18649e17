"""Checkpoints of OpenVLA and of OpenVLA-OFT's runs, whose adapters are merged: safetensors, with
head and state token in `.pt` files beside them, and statistics in `dataset_statistics.json`.
"""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mme_vla.config.sections import PositiveInt, read_section
from mme_vla.errors import UserError, listed, require
from mme_vla.extras.methods.memoryvla.policy import MemoryVlaPolicy
from mme_vla.extras.methods.openvla_oft.policy import OpenVlaPolicy
from mme_vla.policy.base import Policy
from mme_vla.policy.tensor_files import WEIGHTS, cast, read_files
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.utils import check_sums, checked_file, inside, read_json
from mme_vla.weights.tables import Adapter, Piece, wrong_policy
from mme_vla.weights.torch_files import read_torch_file

VLA, HEAD, STATE = "vla/", "action_head/", "proprio_projector/"

_RULES = tuple(
    (re.compile(target), source)
    for target, source in (
        (
            r"^backbone\.vlm\.vision\.dino\.(.*)\.gamma$",
            rf"{VLA}vision_backbone.featurizer.\1.scale_factor",
        ),
        (r"^backbone\.vlm\.vision\.dino\.(.*)$", rf"{VLA}vision_backbone.featurizer.\1"),
        (r"^backbone\.vlm\.vision\.siglip\.(.*)$", rf"{VLA}vision_backbone.fused_featurizer.\1"),
        (r"^backbone\.vlm\.projector\.(.*)$", rf"{VLA}projector.\1"),
        (r"^backbone\.vlm\.language\.(.*)$", rf"{VLA}language_model.\1"),
        (r"^backbone\.head\.input_norm\.(.*)$", rf"{HEAD}model.layer_norm1.\1"),
        (r"^backbone\.head\.input\.(.*)$", rf"{HEAD}model.fc1.\1"),
        (
            r"^backbone\.head\.blocks\.(\d+)\.norm\.(.*)$",
            rf"{HEAD}model.mlp_resnet_blocks.\1.ffn.0.\2",
        ),
        (
            r"^backbone\.head\.blocks\.(\d+)\.linear\.(.*)$",
            rf"{HEAD}model.mlp_resnet_blocks.\1.ffn.1.\2",
        ),
        (r"^backbone\.head\.output_norm\.(.*)$", rf"{HEAD}model.layer_norm2.\1"),
        (r"^backbone\.head\.output\.(.*)$", rf"{HEAD}model.fc2.\1"),
        (r"^backbone\.state_token\.(.*)$", rf"{STATE}\1"),
    )
)


def openvla_name(target: str) -> str | None:
    """What a tensor of ours is called there, adapters included; None where it has no name.

    The same model under another policy of ours (MemoryVLA's `vlm.…`) has the same names.
    """
    target = f"backbone.{target}" if target.startswith("vlm.") else target
    for pattern, replacement in _RULES:
        if pattern.match(target):
            return pattern.sub(replacement, target)
    return None


FOLDER, FILE, SETTINGS = "lora_adapter", "adapter_model.safetensors", "adapter_config.json"
_BEFORE, _DOWN, _UP = "base_model.model.", ".lora_A.weight", ".lora_B.weight"


def named_base(folder: Path) -> str | None:
    """The base model that a run's adapters name, for messages only; None where a folder holds no
    such adapters.
    """
    if not (folder / FOLDER / FILE).is_file():
        return None
    return _settings(folder).base_model_name_or_path or "its base model"


def merge_run(base: Mapping[str, Tensor], folder: Path) -> dict[str, Tensor]:
    """All tensors of a run: the base's with the run's adapters merged in, its head and its state
    token.
    """
    heads = with_heads({}, folder)
    return merged(base, folder) | heads


def merged(base: Mapping[str, Tensor], folder: Path) -> dict[str, Tensor]:
    """The base's tensors (behind `vla/`) with a run's adapters folded in: W + (alpha /
    rank)·B·A.
    """
    settings, file = _settings(folder), folder / FOLDER / FILE
    rank, alpha = settings.r, settings.lora_alpha
    unread = ("use_dora", "use_rslora", "rank_pattern", "alpha_pattern")
    if other := [name for name in unread if getattr(settings, name)]:
        raise UserError(
            f"{folder / FOLDER / SETTINGS} sets {listed(other)}, which are not read: merge it with"
            " peft."
        )
    check_sums(folder, [f"{FOLDER}/{FILE}"])
    adapters = read_files(folder / FOLDER, (file,))
    downs = [name for name in adapters if name.startswith(_BEFORE) and name.endswith(_DOWN)]
    odd = sorted(set(adapters) - set(downs) - {name.removesuffix(_DOWN) + _UP for name in downs})
    require(
        not odd and downs,
        f"{file} holds {listed(odd or list(adapters))}, no adapters of OpenVLA-OFT.",
    )
    out = dict(base)
    for name in downs:
        target = VLA + name.removeprefix(_BEFORE).removesuffix(_DOWN) + ".weight"
        up = adapters.get(name.removesuffix(_DOWN) + _UP)
        down = adapters[name].float().flatten(1)
        if target not in out or up is None or up.shape[1:2] != down.shape[:1] or len(down) != rank:
            raise UserError(
                f"{file}: {name} fits no matrix of the base model: it was trained on another base."
            )
        # A convolution's A is [r, in, k, k] and its B [out, r, 1, 1]: the product of their rows and
        # columns.
        product = up.float().flatten(1) @ down
        weight = out[target]
        require(
            product.shape == weight.flatten(1).shape,
            f"{file}: {name} makes {list(product.shape)} of {list(weight.shape)}: another base's.",
        )
        out[target] = (weight.float() + alpha / rank * product.view_as(weight)).to(weight.dtype)
    return out


@dataclass(frozen=True)
class _AdapterSettings:
    """Keys of `adapter_config.json`, as peft writes it."""

    r: PositiveInt
    lora_alpha: float
    base_model_name_or_path: str | None = None
    use_dora: Any = None
    use_rslora: Any = None
    rank_pattern: Any = None
    alpha_pattern: Any = None


def _settings(folder: Path) -> _AdapterSettings:
    place = checked_file(folder, f"{FOLDER}/{SETTINGS}", "adapters")
    section = read_json(place, "a LoRA's settings", limit=2**20)
    return read_section(_AdapterSettings, section, str(place), others=True)


STATISTICS = "dataset_statistics.json"
DATASET = "robomme"
_FEATURES = {"state": "proprio", "actions": "action"}
_WRAPPED = "module."  # what data parallelism puts before the names of head and state token


def is_openvla(names: Iterable[str]) -> bool:
    """Whether tensors are named as in OpenVLA's own files."""
    present = set(names)
    return "vision_backbone.featurizer.cls_token" in present and "projector.fc1.weight" in present


def openvla_adapter(policy: Policy) -> Adapter:
    """OpenVLA's names of this policy's tensors; a memory has none, and OpenVLA itself no head and
    no state token.

    Of MemoryVLA the VLM alone has names: banks and head are new where it starts from OpenVLA.
    """
    if not isinstance(policy, OpenVlaPolicy | MemoryVlaPolicy):
        change = "model=openvla_oft, or start model=memoryvla from it (init_from=…)"
        raise wrong_policy(policy, "OpenVLA and OpenVLA-OFT", change)
    table = {}
    fresh = set()
    for name in policy.state_dict():
        if ".lora_" in name or ".base_layer." in name:
            continue
        source = openvla_name(name)
        if source is not None:
            table[name] = [Piece(source)]
        if policy.finetune_spec.component_of(name) == "action":
            fresh.add(name)
    return Adapter(table, fresh=frozenset(fresh))


def with_heads(tensors: Mapping[str, Tensor], folder: Path) -> dict[str, Tensor]:
    """The model's tensors, and those of the newest head and state token beside it, each behind its
    module's name.
    """
    known = {module: f"{module.rstrip('/')}--" for module in (HEAD, STATE)}
    unknown = []
    for file in sorted(folder.glob("*?--*_checkpoint.pt")):
        if not file.name.startswith(tuple(known.values())):
            unknown.append(file.name)
    if unknown:
        readable = ", ".join(f"{start}*_checkpoint.pt" for start in known.values())
        raise UserError(
            f"{folder} holds {listed(unknown)}: model=openvla_oft has no place for these weights,"
            f" and would act differently without them. Read are {readable}. A vision_backbone is of"
            " a run with FiLM (use_film), a noisy_action_projector of one with a diffusion head"
            " (use_diffusion): use a run without them."
        )
    merged = {f"{VLA}{name}": tensor for name, tensor in tensors.items()}
    for module, start in known.items():
        files = sorted(folder.glob(f"{start}*_checkpoint.pt"), key=_step)
        if files:
            heads = read_torch_file(inside(folder, files[-1].name, "weights"))
            for name, tensor in heads.items():
                merged[f"{module}{name.removeprefix(_WRAPPED)}"] = tensor
    return merged


def _step(file: Path) -> tuple[int, str]:
    number = file.name.split("--")[1].split("_")[0]
    step = int(number) if number.isdigit() else -1
    return step, file.name


def read_dataset_statistics(folder: Path) -> NormStats | None:
    """The statistics of `dataset_statistics.json`, where it is of one dataset that has states."""
    if not (folder / STATISTICS).is_file():
        return None
    file = checked_file(folder, STATISTICS, "statistics")
    data = read_json(file, "normalisation statistics", limit=2**24)
    if len(data) != 1:
        return None
    (dataset,) = data.values()
    stats: dict[str, QuantileStats] = {}
    for part, name in _FEATURES.items():
        values = dataset.get(name) if isinstance(dataset, dict) else None
        if not isinstance(values, dict):
            return None
        keys = ("mean", "std", "q01", "q99", "min", "max")
        known = {key: values[key] for key in keys if key in values}
        stats[part] = QuantileStats.from_dict(known, name)
    return NormStats(**stats)


def write_openvla(
    policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None
) -> None:
    """A merged run as OpenVLA-OFT's evaluation reads it: one safetensors file, head, state token,
    statistics.
    """
    from safetensors.torch import save_file

    released = openvla_adapter(policy).export(policy.state_dict())
    modules: dict[str, dict[str, Tensor]] = {VLA: {}, HEAD: {}, STATE: {}}
    for source, tensor in released.items():
        module, slash, name = source.partition("/")
        modules[module + slash][name] = cast(tensor.detach(), dtype).cpu().contiguous()
    save_file(modules[VLA], folder / WEIGHTS, metadata={"format": "pt"})
    for module in (HEAD, STATE):
        wrapped = {f"{_WRAPPED}{name}": tensor for name, tensor in modules[module].items()}
        if wrapped:
            torch.save(wrapped, folder / f"{module.rstrip('/')}--0_checkpoint.pt")
    if stats is not None:
        statistics = {}
        for name, feature in _FEATURES.items():
            statistics[feature] = getattr(stats, name).to_dict()
        (folder / STATISTICS).write_text(
            json.dumps({DATASET: statistics}, indent=2) + "\n", encoding="utf-8"
        )
