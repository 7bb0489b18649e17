"""bf16 compute over float32 master weights: which parts stay in float32, and what dtype the rest runs in.

What stays in float32 is computed as it is anywhere (`ieee`), unless `policy.float32_products=tf32` lets a GPU's tensor
cores round what goes into the products of recurrent memories (`float32_products`). Nothing else is touched: no switch
of PyTorch's is left other than it was.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from mme_vla.errors import UserError, did_you_mean

FLOAT32_PRODUCTS = ("ieee", "tf32")


def checked_products(how: str) -> str:
    """`how`, once it is one of `FLOAT32_PRODUCTS`.

    Raises:
        UserError: it is not.
    """
    if how not in FLOAT32_PRODUCTS:
        raise UserError(
            f"policy.float32_products={how!r}: choose ieee (exact products) or tf32 (their inputs keep ten bits on a "
            f"GPU). {did_you_mean(str(how), FLOAT32_PRODUCTS)}"
        )
    return how


@contextmanager
def float32_products(how: str) -> Iterator[None]:
    """Inside, float32 matrix products of a GPU are `ieee` or `tf32`; behind it they are what they were before.

    `tf32` keeps ten bits of what goes into a product and adds up in float32: numbers that came from bfloat16, which has
    seven, lose nothing. The switch is the process's: no other thread should be computing on the GPU in float32.
    """
    switch = torch.backends.cuda.matmul
    before = switch.fp32_precision
    switch.fp32_precision = how
    try:
        yield
    finally:
        switch.fp32_precision = before


def compute_dtype(x: Tensor) -> torch.dtype:
    """The dtype matmuls run in where `x` lives: autocast's when it is on, else the tensor's own."""
    kind = x.device.type
    return torch.get_autocast_dtype(kind) if kind != "meta" and torch.is_autocast_enabled(kind) else x.dtype


def float32_linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a linear layer in float32 whatever autocast or the stored weights say."""
    with torch.autocast(x.device.type if x.device.type != "meta" else "cpu", enabled=False):
        bias = None if layer.bias is None else layer.bias.float()
        return nn.functional.linear(x.float(), layer.weight.float(), bias)
