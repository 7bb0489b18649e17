"""Attention: masks and the one function that chooses the kernel."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel

from mme_vla.backbone.blocks import MaskLayout
from mme_vla.errors import UserError, did_you_mean
from mme_vla.speed.sparse_attention import FlexMask, PackedMask, attend_by_blocks, attend_packed

BACKENDS = ("auto", "sdpa", "flex", "varlen")
"""`sdpa`: fused kernels with an additive mask, the reference. `flex`: compiled from the layout, skips hidden keys.
`varlen`: flash attention over keys packed for each run of queries. `auto`: see `build_mask`."""

AttentionMask = Tensor | FlexMask | PackedMask | None
"""The mask of `attend`: additive [b, 1, q, k], the form of another backend, or None (all keys are visible)."""

BIG_NEGATIVE = -1e30
"""Far below any logit, and still finite where kernels count in base 2 (times 1.44): no row becomes NaN."""

ALIGNMENT = 8
"""Keys a row of the mask is padded to, as fused kernels want it: otherwise they copy the mask in every layer."""

KERNELS = [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]
"""On a GPU. cuDNN, which PyTorch prefers on H100, gives NaN gradients for masks at some lengths (pytorch#196678)."""


def additive_mask(mask: Tensor, dtype: torch.dtype) -> Tensor:
    """[b, q, k] bool → [b, 1, q, k] of 0 and `BIG_NEGATIVE`, made once per forward and shared by all layers.

    Added to finite logits in float32 it absorbs them, so this equals replacing them.
    """
    return _padded(mask, dtype)[..., : mask.shape[-1]].unsqueeze(1)


def layout_mask(layout: MaskLayout, dtype: torch.dtype) -> Tensor:
    """The additive mask [b, 1, n, k] of a layout."""
    return layout.expand(_padded(layout.visible, dtype))[..., : layout.visible.shape[-1]].unsqueeze(1)


def _padded(visible: Tensor, dtype: torch.dtype) -> Tensor:
    *rows, keys = visible.shape
    mask = torch.zeros(*rows, -(-keys // ALIGNMENT) * ALIGNMENT, dtype=dtype, device=visible.device)
    mask[..., :keys].masked_fill_(~visible, BIG_NEGATIVE)
    return mask


def check_backend(name: str) -> str:
    """The name of a backend."""
    if name not in BACKENDS:
        raise UserError(f"policy.attention={name!r}. {did_you_mean(str(name), BACKENDS)}")
    return name


class HasAttentionBackends:
    """Capability of a backbone: it can compute attention with each of `BACKENDS`."""

    def set_attention_backend(self, name: str) -> None:
        """Use another backend than `auto`."""
        raise NotImplementedError


def build_mask(layout: MaskLayout, dtype: torch.dtype, backend: str, compiled: bool) -> AttentionMask:
    """The mask of one backend, built once per forward and shared by all layers.

    `auto` is `flex` for training on a GPU where layers are `compiled`, so that it is part of their code; else `sdpa`.
    """
    if backend == "auto":
        backend = "flex" if compiled and layout.visible.is_cuda and torch.is_grad_enabled() else "sdpa"
    if backend == "flex":
        return FlexMask.of(layout)
    return PackedMask.of(layout) if backend == "varlen" else layout_mask(layout, dtype)


def select_rows(mask: AttentionMask, rows: Sequence[slice], dtype: torch.dtype) -> Tensor:
    """The additive mask of some of the queries, for the last layer: they are few, whatever the backend."""
    if isinstance(mask, Tensor):
        return torch.cat([mask[:, :, at] for at in rows], 2)
    assert mask is not None
    return layout_mask(mask.layout.part(rows), dtype)


def fused_kernels(x: Tensor) -> AbstractContextManager[object]:
    """The context of every attention on a GPU: the kernels of `KERNELS` alone."""
    return sdpa_kernel(KERNELS) if x.is_cuda else nullcontext()


def attend(q: Tensor, k: Tensor, v: Tensor, mask: AttentionMask) -> Tensor:
    """Scaled dot-product attention with grouped queries: query head n reads key head n // (N/K).

    Args:
        q: [b, q, N, h]; k, v: [b, k, K, h].
        mask: of `build_mask`; or additive [b, 1, q, k] in q's dtype; or bool with a key in every row; or None.

    Returns:
        [b, q, N·h].
    """
    if isinstance(mask, FlexMask):
        return attend_by_blocks(q, k, v, mask)
    if isinstance(mask, PackedMask):
        return attend_packed(q, k, v, mask)
    groups = q.shape[2] // k.shape[2]
    q, k, v = (x.transpose(1, 2) for x in (q, k, v))
    if groups > 1:
        # One shared key head broadcasts without a copy; several are repeated.
        k, v = ((x.expand(-1, groups, -1, -1) if x.shape[1] == 1 else x.repeat_interleave(groups, 1)) for x in (k, v))
    with fused_kernels(q):
        return functional.scaled_dot_product_attention(q, k, v, attn_mask=mask).transpose(1, 2).flatten(2)
