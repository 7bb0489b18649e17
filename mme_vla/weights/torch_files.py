"""Checkpoints that `torch.save` wrote, read without running anything in them."""

import pickle
from pathlib import Path

import torch
from torch import Tensor

from mme_vla.errors import UserError, brief, listed

SUFFIXES = (".pth", ".pt")
MODEL = ("model", "state_dict", "model_state_dict", "model_state")
"""Where files keep their tensors, if they hold more than these."""


def find_torch_files(folder: Path) -> list[Path]:
    """The files of this kind in a folder."""
    return sorted(file for file in folder.iterdir() if file.suffix in SUFFIXES and file.is_file())


def read_torch_file(path: Path) -> dict[str, Tensor]:
    """The tensors of a file, by name (of tables by part: part and name), memory-mapped where its layout allows.

    Raises:
        UserError: the file is damaged, holds more than tensors and plain values, or no table of tensors.
    """
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError, AttributeError) as error:
        raise UserError(
            f"{path} cannot be read as weights alone ({brief(str(error).splitlines()[0], 200, quote=False)}): it is "
            "damaged, or holds objects, which are code and are not run."
        ) from error
    for key in MODEL:
        if isinstance(found, dict) and isinstance(found.get(key), dict):
            found = found[key]
            break
    if isinstance(found, dict) and found and all(isinstance(part, dict) for part in found.values()):
        found = {f"{part}.{name}": tensor for part, own in found.items() for name, tensor in own.items()}
    if not isinstance(found, dict) or not found or not all(isinstance(value, Tensor) for value in found.values()):
        held = listed(found) if isinstance(found, dict) else type(found).__name__
        raise UserError(f"{path} holds no table of tensors, but {held}.")
    return {str(name): tensor for name, tensor in found.items()}
