"""Optional speed of a backbone: compiled attention, CUDA graphs, recomputation, sharding groups,
real-time chunking.

Each is a class to inherit from beside `Backbone`. Callers test for it with `isinstance`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch.utils.checkpoint import checkpoint, create_selective_checkpoint_contexts

if TYPE_CHECKING:
    from mme_vla.speed.sharding import ShardGroup


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
    contexts = (
        {"context_fn": partial(create_selective_checkpoint_contexts, SAVED_OPS)}
        if how == SELECTIVE
        else {}
    )
    return {"use_reentrant": False, **contexts}


def run_layer(layer: Callable[..., Any], *inputs: Any, how: Recompute) -> Any:
    """`layer(*inputs)`, computed again in the backward pass as `how` says."""
    if not how or not torch.is_grad_enabled():
        return layer(*inputs)
    return checkpoint(layer, *inputs, **checkpoint_options(how))


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


class Sharded:
    """Capability of a backbone or policy: it has sharding groups of its own instead of
    `backbone_groups`.
    """

    def shard_groups(self) -> "Sequence[ShardGroup]":
        """Modules that are gathered one by one. All other weights are gathered for a whole pass, in
        float32.
        """
        raise NotImplementedError


class CapturableSampling:
    """Capability of a backbone: `sample` never waits for the GPU, so that it can be captured as a
    CUDA graph.
    """

    def compile_sampling(self) -> None:
        """Keep what depends on weights alone between chunks."""
        raise NotImplementedError

    def sampling_stamp(self) -> object:
        """Identifies the weights that the kept values were computed from; graphs are captured anew
        when it changes.
        """
        raise NotImplementedError
