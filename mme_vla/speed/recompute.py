"""Activation checkpointing: layers that keep no activations for the backward pass, or only the expensive ones."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch.utils.checkpoint import checkpoint, create_selective_checkpoint_contexts

Recompute = bool | str
"""What to compute again in the backward pass: True everything inside a layer, False nothing, or SELECTIVE."""
ALL, SELECTIVE = "all", "selective"
"""Everything inside a layer; or all of it but the results of matrix products and of attention, which are kept."""

_ATEN = torch.ops.aten
SAVED_OPS: list[Any] = [
    _ATEN.mm.default, _ATEN.addmm.default, _ATEN.bmm.default, _ATEN.convolution.default,
    _ATEN._scaled_dot_product_flash_attention.default, _ATEN._scaled_dot_product_efficient_attention.default,
    _ATEN._scaled_dot_product_cudnn_attention.default, _ATEN._scaled_dot_product_flash_attention_for_cpu.default,
    torch.ops.higher_order.flex_attention,
]  # fmt: skip


def checkpoint_options(how: Recompute) -> dict[str, Any]:
    """What `torch.utils.checkpoint` and transformers take besides the layer."""
    contexts = {"context_fn": partial(create_selective_checkpoint_contexts, SAVED_OPS)} if how == SELECTIVE else {}
    return {"use_reentrant": False, **contexts}


def run_layer(layer: Callable[..., Any], *inputs: Any, how: Recompute) -> Any:
    """`layer(*inputs)`, computed again in the backward pass as `how` says."""
    if not how or not torch.is_grad_enabled():
        return layer(*inputs)
    return checkpoint(layer, *inputs, **checkpoint_options(how))
