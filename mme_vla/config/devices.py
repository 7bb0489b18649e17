"""The device that a command line names, and how it multiplies.

What stays in float32 is computed as it is anywhere (`ieee`), unless `policy.float32_products=tf32`
lets a GPU's tensor cores round what goes into the products of recurrent memories. Nothing else is
touched: no switch of PyTorch's is left other than it was.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from mme_vla.errors import UserError

if TYPE_CHECKING:
    import torch

FLOAT32_PRODUCTS = ("ieee", "tf32")


def find_device(name: "str | int | torch.device") -> "torch.device":
    """The device of that name, or GPU of that number; `auto`: a GPU where there is one."""
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UserError(
            f"device={name!r} is not a device; choose auto, cpu, cuda or cuda:<number>."
        ) from None
    gpus = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= gpus:
        raise UserError(
            f"device={name}: PyTorch sees {gpus} GPUs here, counted from 0; use one of them, or"
            " cpu."
        )
    return device


def process_device(name: str) -> "torch.device":
    """The device of that name; `auto` and `cuda` are a GPU of its own for each of a machine's
    processes (torchrun).
    """
    import torch

    device = find_device(name)
    rank = int(os.environ.get("LOCAL_RANK", "0"))
    if device.type != "cuda" or device.index is not None:
        return device
    return torch.device("cuda", rank % torch.cuda.device_count())


@contextmanager
def float32_products(how: str) -> Iterator[None]:
    """Inside, float32 matrix products of a GPU are `ieee` or `tf32`; behind it they are what they
    were before.

    `tf32` keeps ten bits of what goes into a product and adds up in float32: numbers that came from
    bfloat16, which has seven, lose nothing. The switch is the process's: no other thread should be
    computing on the GPU in float32.
    """
    import torch

    switch = torch.backends.cuda.matmul
    before = switch.fp32_precision
    switch.fp32_precision = how
    try:
        yield
    finally:
        switch.fp32_precision = before
