"""Attention behind one function, so that the backend is chosen in one place."""

import torch
from torch import Tensor
from torch.nn import functional

BIG_NEGATIVE = -2.3819763e38
"""Finite: a row that sees no key (a padding query) averages all values instead of becoming NaN."""


def additive_mask(mask: Tensor, dtype: torch.dtype) -> Tensor:
    """[b, q, k] bool → [b, 1, q, k] of 0 and `BIG_NEGATIVE`, made once per forward and shared by all layers.

    Added to finite logits in float32 it absorbs them, so this equals replacing them.
    """
    return torch.zeros_like(mask, dtype=dtype).masked_fill_(~mask, BIG_NEGATIVE).unsqueeze(1)


def attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None) -> Tensor:
    """Scaled dot-product attention with grouped queries: query head n reads key head n // (N/K).

    Args:
        q: [b, q, N, h]; k, v: [b, k, K, h].
        mask: additive [b, 1, q, k] in q's dtype, or bool (then every row must see a key), or None.

    Returns:
        [b, q, N·h].
    """
    groups = q.shape[2] // k.shape[2]
    q, k, v = (x.transpose(1, 2) for x in (q, k, v))
    if groups > 1:
        # One shared key head broadcasts without a copy; several are repeated.
        k, v = ((x.expand(-1, groups, -1, -1) if x.shape[1] == 1 else x.repeat_interleave(groups, 1)) for x in (k, v))
    return functional.scaled_dot_product_attention(q, k, v, attn_mask=mask).transpose(1, 2).flatten(2)
