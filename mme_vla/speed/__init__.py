"""Optional speed of a backbone: compiled attention, CUDA graphs, recomputation, real-time chunking.

Each capability is a class to inherit from beside `Backbone`. Callers test for it with `isinstance`.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint, create_selective_checkpoint_contexts

Recompute = bool | str
"""What to compute again in the backward pass: True everything inside a layer, False nothing, or
SELECTIVE.
"""
ALL, SELECTIVE = "all", "selective"
"""Everything inside a layer; or all of it but the results of matrix products and of attention,
which are kept.
"""

_ATEN = torch.ops.aten
SAVED_OPS: list[Any] = [
    _ATEN.mm.default,
    _ATEN.addmm.default,
    _ATEN.bmm.default,
    _ATEN.convolution.default,
    _ATEN._scaled_dot_product_flash_attention.default,
    _ATEN._scaled_dot_product_efficient_attention.default,
    _ATEN._scaled_dot_product_cudnn_attention.default,
    _ATEN._scaled_dot_product_flash_attention_for_cpu.default,
    torch.ops.higher_order.flex_attention,
]


def checkpoint_options(how: Recompute) -> dict[str, Any]:
    """What `torch.utils.checkpoint` and transformers take besides the layer."""
    options: dict[str, Any] = {"use_reentrant": False}
    if how == SELECTIVE:
        options["context_fn"] = partial(create_selective_checkpoint_contexts, SAVED_OPS)
    return options


def run_layer(layer: Callable[..., Any], *inputs: Any, how: Recompute) -> Any:
    """`layer(*inputs)`, computed again in the backward pass as `how` says."""
    if not how or not torch.is_grad_enabled():
        return layer(*inputs)
    return checkpoint(layer, *inputs, **checkpoint_options(how))


def fused_kernels(x: torch.Tensor) -> AbstractContextManager[object]:
    """The context of an attention with a mask: on a GPU, every kernel but cuDNN's.

    cuDNN's, which PyTorch prefers on H100, gives NaN gradients for masks at some lengths
    (pytorch#196678).
    """
    if not x.is_cuda:
        return nullcontext()
    from torch.nn.attention import SDPBackend, sdpa_kernel

    return sdpa_kernel(
        [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]
    )


SAMPLING_OPTIONS: dict[str, Any] = {"dynamic": False, "options": {"combo_kernels": True}}
"""How `torch.compile` compiles for sampling: for each length by itself, since a graph is captured
for each; and independent small kernels as one, such as the rotation of queries and the writing of
keys and values.
"""


def compile_parts(root: nn.Module | None, **options: Any) -> None:
    """Compile in place every part of a memory or an integration that overrides `compile`.

    `options` are `torch.compile`'s.
    """
    if root is None:
        return
    for module in root.modules():
        if type(module).compile is not nn.Module.compile:
            module.compile(**options)


class HasAttentionBackends:
    """Capability of a backbone: it can compute attention with each backend
    (`mme_vla.backbone.layers.BACKENDS`).
    """

    def set_attention_backend(self, name: str) -> None:
        """Use another backend than `auto`."""
        raise NotImplementedError


class Recomputes:
    """Capability of a backbone or policy: it can compute activations again in the backward pass."""

    def recompute(self, mode: Recompute) -> None:
        """Set what to compute again; False keeps all activations."""
        raise NotImplementedError


class CapturableSampling:
    """Capability of a backbone: `sample` never waits for the GPU, so that it can be captured as a
    CUDA graph.
    """

    def compile_sampling(self, layers: bool = False) -> Callable[[], object]:
        """Keep what depends on weights alone between chunks.

        Args:
            layers: compile the network too (`SAMPLING_OPTIONS`).

        Returns:
            What identifies the weights that the kept values were computed from: graphs are captured
            anew when it returns another value.
        """
        raise NotImplementedError
