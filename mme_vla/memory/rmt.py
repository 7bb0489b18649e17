"""RMT: memory as a fixed set of slots that attend to every frame and to each other (paper, section
4.2).
"""

from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.errors import check_choice, check_sizes, require
from mme_vla.memory.recurrent import (
    RecurrentLayer,
    RecurrentMemory,
    State,
    Statistics,
    default_hidden,
    full_precision,
    layer_norm,
    linear,
)
from mme_vla.registry import MEMORIES

EPS = 1e-6
BASE = 10_000.0
ROTATIONS = ("full", "cosine_only")
ATTENTION_DTYPES = {"bfloat16": torch.bfloat16, "float32": torch.float32}


def angles(count: int, head_dim: int, device: torch.device | None = None) -> Tensor:
    """p·10000^(−2i/h) for positions 0 … count − 1: [count, h/2] float32."""
    exponent = torch.arange(0, head_dim, 2, device=device, dtype=torch.float32) / head_dim
    return torch.arange(count, device=device, dtype=torch.float32)[:, None] / BASE**exponent


class RMTLayer(RecurrentLayer):
    """Slots m ← norm(m + attention(m → [frame | m])), queries from the slots alone, grouped keys.

    State: the slots [b, budget, d], carried in the dtype their initial values are stored in.
    """

    window = 0

    def __init__(
        self,
        hidden: int,
        heads: int,
        kv_heads: int,
        budget: int,
        rotation: str = "full",
        attention_dtype: str = "bfloat16",
    ) -> None:
        super().__init__()
        require(
            hidden % (2 * heads) == 0 and heads % kv_heads == 0,
            f"memory.hidden={hidden}, memory.heads={heads}, memory.kv_heads={kv_heads} do not fit:"
            " hidden must be an even multiple of heads, and heads a multiple of kv_heads.",
        )
        check_choice("memory.rotation", rotation, ROTATIONS)
        check_choice("memory.attention_dtype", attention_dtype, ATTENTION_DTYPES)
        self.head_dim = hidden // heads
        self.kv_heads = kv_heads
        self.rotation = rotation
        self.attention_dtype = ATTENTION_DTYPES[attention_dtype]
        self.q = nn.Linear(hidden, hidden, bias=False)
        self.kv = nn.Linear(hidden, 2 * kv_heads * self.head_dim, bias=False)
        self.out = nn.Linear(hidden, hidden, bias=False)
        self.pre_norm = nn.LayerNorm(hidden, eps=EPS)
        self.post_norm = nn.LayerNorm(hidden, eps=EPS)
        self.slots = nn.Parameter(torch.randn(budget, hidden) * hidden**-0.5)
        for layer, std in ((self.q, 0.02), (self.kv, 0.02), (self.out, 0.005)):
            nn.init.normal_(layer.weight, std=std)

    def initial(self, batch: int) -> State:
        return (self.slots.expand(batch, *self.slots.shape),)

    def advance(
        self, state: State, x: Tensor, valid: Tensor, following: int = 0, statistics: bool = False
    ) -> tuple[State, Statistics]:
        with full_precision(x):
            (slots,) = state
            patches = x.shape[2]
            # Recomputed, not stored: frame tokens come first, and any number of slots after them.
            rope = angles(patches + slots.shape[1], self.head_dim, x.device)[:, None]  # n 1 h/2
            cos, sin = rope.cos(), rope.sin()
            frame_rope = (cos[:patches], sin[:patches])
            slot_rope = (cos[patches:], sin[patches:])
            kv_weight = self.kv.weight.float()
            # Projected and rotated together: fewer small operations.
            qkv_weight = torch.cat([self.q.weight.float(), kv_weight])
            frames = layer_norm(self.pre_norm, x.float())
            frame_k, frame_v = self._heads(frames, kv_weight, frame_rope)  # b t p kv h
            # Unbound and split, not sliced: the gradient of each slice would fill the whole tensor.
            frame_keys, frame_values = frame_k.unbind(1), frame_v.unbind(1)
            changes = []
            for t in range(x.shape[1]):
                normed = layer_norm(self.pre_norm, slots.float())
                slot_qk, slot_v = self._heads(normed, qkv_weight, slot_rope)
                q, slot_k = slot_qk.split([slot_qk.shape[-2] - self.kv_heads, self.kv_heads], -2)
                k = torch.cat([frame_keys[t], slot_k], 1)
                v = torch.cat([frame_values[t], slot_v], 1)
                output = linear(self.out, self._attend(q, k, v)) + slots.float()
                updated = layer_norm(self.post_norm, output).to(slots.dtype)
                new = torch.where(valid[:, t, None, None], updated, slots)
                if statistics:
                    changes.append(_relative_distance(slots, new))
                slots = new
            if statistics:
                return (slots,), {"slot_change": torch.stack(changes, 1)}
            return (slots,), {}

    def read(self, state: State) -> tuple[Tensor, Tensor]:
        (slots,) = state
        return slots, torch.ones(slots.shape[:2], dtype=torch.bool, device=slots.device)

    def _heads(
        self, x: Tensor, weight: Tensor, rope: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Project x [..., n, hidden] to heads [..., n, heads, e], and rotate all but the values,
        which are last: their pairs (2i, 2i + 1), by angles with cosines and sines [n, 1, h/2].
        """
        heads = nn.functional.linear(x, weight).unflatten(-1, (-1, self.head_dim))
        qk, v = heads.split([heads.shape[-2] - self.kv_heads, self.kv_heads], -2)
        cos, sin = rope
        a, b = qk.unflatten(-1, (-1, 2)).unbind(-1)
        rotated = [a * cos - b * sin, a * sin + b * cos]
        if self.rotation == "cosine_only":
            rotated = [a * cos, b * cos]
        return torch.stack(rotated, -1).flatten(-2), v

    def _attend(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Every slot attends to every key: q [b, n, heads, e], k and v [b, m, kv, e] → [b, n,
        heads·e] float32.
        """
        b, n, heads, h = q.shape
        # Without a mask, the queries that share a key head are simply more queries of that head.
        q = q.unflatten(2, (self.kv_heads, -1)).permute(0, 2, 3, 1, 4).flatten(2, 3)  # b kv (g n) h
        k, v = k.transpose(1, 2), v.transpose(1, 2)
        dtype = self.attention_dtype
        if dtype == torch.float32:
            mixed = nn.functional.scaled_dot_product_attention(q, k, v)
        else:
            # Round where the released code does: inputs, weights and result to `dtype`; softmax in
            # float32. Fused kernels round the weights before they are normalised, which moves a
            # slot by up to 2 % over a window.
            q, k, v = q.to(dtype), k.to(dtype), v.to(dtype)
            scores = (q.float() * q.shape[-1] ** -0.5) @ k.float().transpose(-1, -2)
            weights = scores.softmax(-1).to(dtype)
            if q.device.type == "cpu":
                # Sums are float32 either way, and many CPUs only emulate products of bfloat16.
                mixed = (weights.float() @ v.float()).to(dtype).float()
            else:
                mixed = (weights @ v).float()
        return mixed.view(b, heads, n, h).transpose(1, 2).flatten(2)


@torch.no_grad()
def _relative_distance(before: Tensor, after: Tensor) -> Tensor:
    before, after = before.float().flatten(1), after.float().flatten(1)
    return (after - before).norm(dim=1) / before.norm(dim=1)


@MEMORIES.register("rmt")
class RMT(RecurrentMemory):
    """`budget` slots after the last frame; all of them count."""

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 512,
        hidden: int | None = None,
        heads: int | None = None,
        kv_heads: int = 1,
        rotation: str = "full",
        attention_dtype: str = "bfloat16",
        **options: Any,
    ) -> None:
        """See `RecurrentMemory` and `RMTLayer`.

        Args:
            hidden: width of the recurrence; None is a quarter of `d_vision`, at least 64.
            heads, kv_heads: query and key heads of the slots' attention; None is a head for each 64
                of `hidden`, at least 2, or fewer where these do not divide it into even widths.
            rotation: `full`, or `cosine_only`: what the released evaluation ran, because its
                loading dropped the imaginary part of the rotary table.
            attention_dtype: what queries, keys and values are cast to; `bfloat16` as released;
                `float32` takes the fused kernel, which keeps no weights: less memory.
        """
        hidden = default_hidden(d_vision, hidden)
        if not heads:
            heads = max(2, hidden // 64)
            while heads > 1 and hidden % (2 * heads):
                heads -= 1
        check_sizes("memory", budget=budget, heads=heads, kv_heads=kv_heads)
        layer = RMTLayer(hidden, heads, kv_heads, budget, rotation, attention_dtype)
        super().__init__(d_vision, width, layer, hidden, budget, **options)
