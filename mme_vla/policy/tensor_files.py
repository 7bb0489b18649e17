"""Folders of safetensors: written sharded where large, read strictly."""

import json
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from mme_vla.errors import UserError

WEIGHTS = "model.safetensors"
INDEX = "model.safetensors.index.json"
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def save_tensors(
    tensors: Mapping[str, Tensor], folder: Path, max_shard_size: str = "5GB", dtype: torch.dtype | None = None
) -> None:
    """Write tensors to `folder` as safetensors, in shards with an index where they exceed `max_shard_size`.

    `dtype` is what floating-point tensors are stored in; by default each keeps its own.
    """
    from huggingface_hub import save_torch_state_dict

    folder.mkdir(parents=True, exist_ok=True)
    on_cpu = {name: cast(tensor.detach(), dtype).cpu().contiguous() for name, tensor in tensors.items()}
    save_torch_state_dict(on_cpu, folder, max_shard_size=max_shard_size)


def load_tensors(folder: Path) -> dict[str, Tensor]:
    """Read a folder's `model.safetensors`, or the shards its index names (memory-mapped until used).

    Raises:
        UserError: no weights there, or a file that is missing, damaged or not safetensors.
    """
    return {name: tensor for file in weight_files(folder) for name, tensor in read_safetensors(file).items()}


def weight_files(folder: Path) -> list[Path]:
    """The safetensors files that hold a folder's weights.

    Raises:
        UserError: there are none, or the index is damaged.
    """
    if (folder / INDEX).is_file():
        try:
            shards = json.loads((folder / INDEX).read_text())["weight_map"].values()
            return [folder / name for name in sorted(set(shards))]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UserError(f"{folder / INDEX} is not an index of safetensors files: {error!r}") from None
    if (folder / WEIGHTS).is_file():
        return [folder / WEIGHTS]
    raise UserError(f"No weights in {folder}: expected {WEIGHTS} or {INDEX}. Is this a checkpoint folder?")


def read_safetensors(file: Path) -> dict[str, Tensor]:
    """Read one safetensors file.

    Raises:
        UserError: it is missing, cut short or something else.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(file)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{file} is damaged or not a safetensors file: {error}") from error


def cast(tensor: Tensor, dtype: torch.dtype | None) -> Tensor:
    """Bring a floating-point tensor to `dtype` (None: leave it); whole numbers and complex ones stay as they are."""
    return tensor if dtype is None or not tensor.is_floating_point() else tensor.to(dtype)


def dtype_of(name: str, what: str = "dtype") -> torch.dtype:
    """Look up `float32` or `bfloat16`.

    Raises:
        UserError: another name.
    """
    if name not in DTYPES:
        raise UserError(f"{what}={name!r}: choose one of {', '.join(DTYPES)}.")
    return DTYPES[name]


def check_fit(
    found: Mapping[str, Tensor],
    expected: Mapping[str, tuple[int, ...]],
    source: str,
    optional: Collection[str] = (),
) -> None:
    """Compare names and shapes.

    Raises:
        UserError: lists every tensor that is missing (and not `optional`), left over or misshapen.
    """
    missing = sorted(set(expected) - set(found) - set(optional))
    unexpected = sorted(set(found) - set(expected))
    misshapen = [
        f"{name}: {tuple(found[name].shape)} instead of {tuple(expected[name])}"
        for name in sorted(set(expected) & set(found))
        if tuple(found[name].shape) != tuple(expected[name])
    ]
    problems = [
        f"{len(names)} {what}:\n  " + "\n  ".join(names)
        for what, names in (("missing", missing), ("unexpected", unexpected), ("misshapen", misshapen))
        if names
    ]
    if problems:
        raise UserError(f"The weights in {source} do not fit this policy.\n" + "\n".join(problems))


def assign_tensors(
    module: nn.Module, tensors: Mapping[str, Tensor], source: str, dtype: torch.dtype | None = None
) -> None:
    """Give a module (on meta or not) these tensors as its parameters; nothing may be missing, left over or misshapen.

    `dtype` is what floating-point tensors are brought to; by default each keeps its own.

    Raises:
        UserError: lists every tensor that does not fit, before anything is changed.
    """
    check_fit(tensors, {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}, source)
    trainable = {name: p.requires_grad for name, p in module.named_parameters()}
    module.load_state_dict({name: cast(t, dtype) for name, t in tensors.items()}, strict=True, assign=True)
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
