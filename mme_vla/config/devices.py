"""The device that a command line names."""

from typing import TYPE_CHECKING

from mme_vla.errors import UserError

if TYPE_CHECKING:
    import torch


def find_device(name: str) -> "torch.device":
    """The device of that name; `auto`: a GPU where there is one.

    Raises:
        UserError: it is no device, or not here.
    """
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UserError(f"device={name!r} is not a device; choose auto, cpu, cuda or cuda:<number>.") from None
    gpus = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= gpus:
        raise UserError(f"device={name}: PyTorch sees {gpus} GPUs here, counted from 0; use one of them, or cpu.")
    return device
