"""Folders of safetensors: written sharded where large, read strictly."""

import shutil
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor, nn

from mme_vla.errors import UserError

WEIGHTS = "model.safetensors"
INDEX = "model.safetensors.index.json"


def save_tensors(tensors: Mapping[str, Tensor], folder: Path, max_shard_size: str = "5GB") -> None:
    """Write tensors to `folder` as safetensors, in shards with an index where they exceed `max_shard_size`."""
    from huggingface_hub import save_torch_state_dict

    folder.mkdir(parents=True, exist_ok=True)
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    save_torch_state_dict(on_cpu, folder, max_shard_size=max_shard_size)


def load_tensors(folder: Path) -> dict[str, Tensor]:
    """Read what `save_tensors` wrote (memory-mapped until used).

    Raises:
        UserError: no weights there, or a file that is not safetensors.
    """
    import json

    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if (folder / INDEX).is_file():
        files = sorted(set(json.loads((folder / INDEX).read_text())["weight_map"].values()))
    elif (folder / WEIGHTS).is_file():
        files = [WEIGHTS]
    else:
        raise UserError(f"No weights in {folder}: expected {WEIGHTS} or {INDEX}. Is this a checkpoint folder?")
    tensors: dict[str, Tensor] = {}
    for name in files:
        try:
            tensors |= load_file(folder / name)
        except (SafetensorError, OSError) as error:
            raise UserError(f"{folder / name} is damaged or not a safetensors file: {error}") from error
    return tensors


def assign_tensors(module: nn.Module, tensors: Mapping[str, Tensor], source: str) -> None:
    """Give a module (on meta or not) these tensors as its parameters; nothing may be missing, left over or misshapen.

    Raises:
        UserError: lists every tensor that does not fit, before anything is changed.
    """
    own = module.state_dict()
    missing = sorted(set(own) - set(tensors))
    unexpected = sorted(set(tensors) - set(own))
    misshapen = [
        f"{name}: {tuple(tensors[name].shape)} instead of {tuple(own[name].shape)}"
        for name in sorted(set(own) & set(tensors))
        if tensors[name].shape != own[name].shape
    ]
    problems = [
        f"{len(names)} {what}:\n  " + "\n  ".join(names)
        for what, names in (("missing", missing), ("unexpected", unexpected), ("misshapen", misshapen))
        if names
    ]
    if problems:
        raise UserError(f"The weights in {source} do not fit this policy.\n" + "\n".join(problems))
    trainable = {name: p.requires_grad for name, p in module.named_parameters()}
    module.load_state_dict(dict(tensors), strict=True, assign=True)
    for name, parameter in module.named_parameters():
        parameter.requires_grad_(trainable[name])


def replace_folder(built: Path, target: Path) -> None:
    """Put a finished folder in place of `target` in one rename, so that no reader sees half of it."""
    old = target.with_name(target.name + ".old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        target.rename(old)
    built.rename(target)
    shutil.rmtree(old, ignore_errors=True)
