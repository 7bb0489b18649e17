"""bf16 compute over float32 master weights: which parts stay in float32, and what dtype the rest runs in."""

import torch
from torch import Tensor, nn


def compute_dtype(x: Tensor) -> torch.dtype:
    """The dtype matmuls run in where `x` lives: autocast's when it is on, else the tensor's own."""
    kind = x.device.type
    return torch.get_autocast_dtype(kind) if kind != "meta" and torch.is_autocast_enabled(kind) else x.dtype


def float32_linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a linear layer in float32 whatever autocast or the stored weights say."""
    with torch.autocast(x.device.type if x.device.type != "meta" else "cpu", enabled=False):
        bias = None if layer.bias is None else layer.bias.float()
        return nn.functional.linear(x.float(), layer.weight.float(), bias)
