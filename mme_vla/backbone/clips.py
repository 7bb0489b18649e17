"""Attention over past frames inside the vision tower, for memories that give it past views."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

PERIOD = 10_000.0


def through_time(layers: Sequence[Any], x: Tensor, visible: Tensor, every: int) -> Tensor:
    """Features of the last frame of clips, with attention over past frames in some of a
    transformer's layers.

    Args:
        layers: timm's `Block`s.
        x: [n, t, p, d].
        visible: [n, t] bool, False on padding.
        every: interval of the layers that attend over time, at least the last one; the past is
            dropped above them.

    Returns:
        [n, p, d].
    """
    n, t = x.shape[:2]
    temporal = {i for i in range(len(layers)) if (i + 1) % every == 0} or {len(layers) - 1}
    # Sinusoidal encoding [t, 1, d] of the frames' times, exactly 0 at the last frame.
    width = x.shape[-1]
    ages = torch.arange(1 - t, 1, device=x.device, dtype=torch.float32)
    pairs = torch.arange(0, width, 2, device=x.device, dtype=torch.float32)
    angles = ages[:, None] * torch.exp(pairs * (-math.log(PERIOD) / width))
    times = torch.stack([angles.sin(), angles.cos() - 1], -1).flatten(1).to(x.dtype)[:, None]
    earlier = torch.ones(t, t, dtype=torch.bool, device=x.device).tril()
    itself = torch.eye(t, dtype=torch.bool, device=x.device)
    # Padding attends to itself, so that no row is empty.
    before = (earlier & visible[:, None]) | itself
    for i, layer in enumerate(layers):
        if i in temporal:
            x = x + space_time(layer.attn, layer.norm1(x + times), before)
            x = x + layer.mlp(layer.norm2(x))
        else:
            x = layer(x.flatten(0, 1)).unflatten(0, (n, -1))
        if i == max(temporal):
            x = x[:, -1:]
    return x[:, 0]


def space_time(attention: Any, x: Tensor, before: Tensor) -> Tensor:
    """Attention over patches whose values are mixed over time, [n, t, p, d] → [n, t, p, d].

    Args:
        attention: timm's `Attention`.
        before: [n, t, t] bool, which frames a frame attends to.
    """
    n, t, p = x.shape[:3]
    qkv = attention.qkv(x).unflatten(-1, (3, attention.num_heads, -1))
    q, k, v = qkv.permute(3, 0, 4, 1, 2, 5)  # each n h t p c

    # Over time: each patch reads the values of the same patch in earlier frames.
    time_q, time_k, time_v = (
        part.permute(0, 3, 1, 2, 4).flatten(0, 1) for part in (q, k, v)
    )  # n·p h t c
    mask = before.repeat_interleave(p, 0)[:, None]
    mixed = functional.scaled_dot_product_attention(time_q, time_k, time_v, attn_mask=mask)
    mixed = mixed.unflatten(0, (n, p)).permute(0, 3, 2, 1, 4)  # n t h p c

    # Over space, in each frame.
    space_q, space_k = (part.transpose(1, 2).flatten(0, 1) for part in (q, k))  # n·t h p c
    output = functional.scaled_dot_product_attention(space_q, space_k, mixed.flatten(0, 1))
    return attention.proj(output.transpose(1, 2).flatten(2).unflatten(0, (n, t)))
