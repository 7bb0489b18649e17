"""Checkpoints that `torch.save` wrote, read without running anything in them."""

import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mme_vla.errors import UserError, listed
from mme_vla.utils import check_sums, decoding, require_file

SUFFIXES = (".pth", ".pt")
MODEL = ("model", "state_dict", "model_state_dict", "model_state")
"""Where files keep their tensors, if they hold more than these."""


_REMEDY = (
    "It is damaged, or holds objects, which are code and are not run. Download or copy it again."
)


def load_torch_file(path: Path, what: str, mapped: bool = False) -> Any:
    """Read a file that `torch.save` wrote, tensors on the CPU. Objects in it are code, and are not
    run.

    Args:
        what: the file is, for the message.
        mapped: read a tensor when it is used, without a check of its bytes. Files from before torch
            1.6 are read whole. Otherwise a `SHA256SUMS` in its folder must list the file, and fit
            it.
    """
    require_file(path, what)  # torch would wait for a pipe without end
    if not mapped:
        check_sums(path.parent, [path.name])
    can_map = mapped and zipfile.is_zipfile(path)
    with decoding(path, what, _REMEDY):
        return torch.load(path, map_location="cpu", weights_only=True, mmap=can_map)


def read_torch_file(path: Path, mapped: bool = False) -> dict[str, Tensor]:
    """The tensors of a file, by name (of tables by part: part and name). mapped: as for
    `load_torch_file`.
    """
    content = load_torch_file(path, "weights", mapped)
    if not isinstance(content, dict):
        raise UserError(f"{path} holds no table of tensors, but {type(content).__name__}.")
    for key in MODEL:
        if isinstance(content.get(key), dict):
            content = content[key]
            break
    tensors: dict[str, Tensor] = {}
    is_by_part = all(isinstance(part, dict) for part in content.values())
    for name, value in content.items():
        if is_by_part:
            for inner, tensor in value.items():
                tensors[f"{name}.{inner}"] = tensor
        else:
            tensors[str(name)] = value
    if not tensors or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise UserError(f"{path} holds no table of tensors, but {listed(tensors or content)}.")
    return tensors
