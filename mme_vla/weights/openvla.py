"""Checkpoints of OpenVLA and of OpenVLA-OFT's runs, whose adapters are merged: safetensors, with head and state token
in `.pt` files beside them, and statistics in `dataset_statistics.json`.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mme_vla.errors import UserError, listed
from mme_vla.files import inside, read_json
from mme_vla.policy.base import Policy
from mme_vla.policy.memoryvla.policy import MemoryVlaPolicy
from mme_vla.policy.openvla import OpenVlaPolicy
from mme_vla.policy.tensor_files import WEIGHTS, cast
from mme_vla.processing.normalisers import NormStats, QuantileStats
from mme_vla.weights.adapter import Adapter
from mme_vla.weights.names.openvla import HEAD, STATE, VLA, openvla_table
from mme_vla.weights.torch_files import read_torch_file

STATISTICS = "dataset_statistics.json"
DATASET = "robomme"
_FEATURES = {"state": "proprio", "actions": "action"}
_WRAPPED = "module."  # what data parallelism puts before the names of head and state token


def is_openvla(names: Iterable[str]) -> bool:
    """Whether tensors are named as in OpenVLA's own files."""
    found = set(names)
    return "vision_backbone.featurizer.cls_token" in found and "projector.fc1.weight" in found


def openvla_adapter(policy: Policy) -> Adapter:
    """OpenVLA's names of this policy's tensors; a memory has none, and OpenVLA itself no head and no state token.

    Of MemoryVLA the VLM alone has names: banks and head are new where it starts from OpenVLA.

    Raises:
        UserError: it is another kind of policy.
    """
    if not isinstance(policy, OpenVlaPolicy | MemoryVlaPolicy):
        raise UserError(
            f"This format holds OpenVLA and OpenVLA-OFT; {policy.config.get('name', 'this')} is a "
            f"{type(policy).__name__}. Set model=openvla_oft, or "
            "start model=memoryvla from it (init_from=…)."
        )
    names = [name for name in policy.state_dict() if ".lora_" not in name and ".base_layer." not in name]
    return Adapter(openvla_table(names), fresh=frozenset(name for name in names if policy.part_of(name) == "action"))


def with_heads(tensors: Mapping[str, Tensor], folder: Path) -> dict[str, Tensor]:
    """The model's tensors, and those of the newest head and state token beside it, each behind its module's name.

    Raises:
        UserError: a file beside it is damaged, or holds a module that these policies do not have: a vision backbone
            with FiLM, the projector of a diffusion head.
    """
    known = tuple(f"{module.rstrip('/')}--" for module in (HEAD, STATE))
    unknown = sorted(file.name for file in folder.glob("*?--*_checkpoint.pt") if not file.name.startswith(known))
    if unknown:
        raise UserError(
            f"{folder} holds {listed(unknown)}: model=openvla_oft has no place for these weights, and would act "
            f"differently without them. Read are {', '.join(f'{name}*_checkpoint.pt' for name in known)}. A "
            "vision_backbone is of a run with FiLM (use_film), a noisy_action_projector of one with a diffusion head "
            "(use_diffusion): use a run without them."
        )
    found = {f"{VLA}{name}": tensor for name, tensor in tensors.items()}
    for module in (HEAD, STATE):
        files = sorted(folder.glob(f"{module.rstrip('/')}--*_checkpoint.pt"), key=_step)
        if files:
            own = read_torch_file(files[-1])
            found |= {f"{module}{name.removeprefix(_WRAPPED)}": tensor for name, tensor in own.items()}
    return found


def _step(file: Path) -> tuple[int, str]:
    number = file.name.split("--")[1].split("_")[0]
    return (int(number) if number.isdigit() else -1, file.name)


def read_dataset_statistics(folder: Path) -> NormStats | None:
    """The statistics of `dataset_statistics.json`, where it is of one dataset that has states.

    Raises:
        UserError: the file is damaged.
    """
    if not (folder / STATISTICS).is_file():
        return None
    data = read_json(inside(folder, STATISTICS, "statistics"), "normalisation statistics", limit=2**24)
    of = next(iter(data.values())) if len(data) == 1 else None
    if not isinstance(of, dict) or not all(isinstance(of.get(theirs), dict) for theirs in _FEATURES.values()):
        return None
    return NormStats(**{ours: QuantileStats.from_dict(_known(of[name]), name) for ours, name in _FEATURES.items()})


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: values[key] for key in ("mean", "std", "q01", "q99", "min", "max") if key in values}


def write_openvla(policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None) -> None:
    """A merged run as OpenVLA-OFT's evaluation reads it: one safetensors file, head, state token, statistics.

    Raises:
        UserError: another kind of policy, or one with a memory or adapters, for which the format has no names.
    """
    from safetensors.torch import save_file

    theirs = openvla_adapter(policy).export(policy.state_dict())
    ready = {name: cast(tensor.detach(), dtype).cpu().contiguous() for name, tensor in theirs.items()}

    def of(module: str, before: str = "") -> dict[str, Tensor]:
        return {before + name.removeprefix(module): x for name, x in ready.items() if name.startswith(module)}

    save_file(of(VLA), folder / WEIGHTS, metadata={"format": "pt"})
    for module in (HEAD, STATE):
        if own := of(module, _WRAPPED):
            torch.save(own, folder / f"{module.rstrip('/')}--0_checkpoint.pt")
    if stats is not None:
        written = {theirs: getattr(stats, ours).to_dict() for ours, theirs in _FEATURES.items()}
        (folder / STATISTICS).write_text(json.dumps({DATASET: written}, indent=2) + "\n")
