"""Attention backends without an additive mask: they skip keys that no query attends to."""

from functools import cache
from typing import Any, NamedTuple, Protocol, Self

import torch
from torch import Tensor
from torch.nn import functional
from torch.nn.attention.flex_attention import BlockMask, create_block_mask, flex_attention
from torch.nn.attention.varlen import varlen_attn


class Layout(Protocol):
    """Runs of queries that attend to the same keys: their lengths, and the keys bool [b, runs, k]
    (`MaskLayout`).
    """

    @property
    def lengths(self) -> tuple[int, ...]: ...

    @property
    def visible(self) -> Tensor: ...


WIDE_HEAD = 256
_TILES = ("bwd_BLOCK_M1", "bwd_BLOCK_N1", "bwd_BLOCK_M2", "bwd_BLOCK_N2")
WIDE_HEAD_OPTIONS = dict.fromkeys(_TILES, 32) | {"bwd_num_warps": 8, "bwd_num_stages": 2}
"""Tiles of the backward pass at head width 256: the default ones spill registers, these fit cards
of 24 GB too.
"""


class FlexMask(NamedTuple):
    """A mask layout as `flex_attention` reads it: which tiles have visible keys, and the mask
    inside them.
    """

    layout: Any
    blocks: BlockMask

    @classmethod
    def of(cls, layout: Layout) -> Self:
        mask, device = layout.visible, layout.visible.device
        run = torch.cat([torch.full((n,), i, device=device) for i, n in enumerate(layout.lengths)])

        def visible(batch: Tensor, head: Tensor, query: Tensor, key: Tensor) -> Tensor:
            return mask[batch, run[query], key]

        queries, keys = sum(layout.lengths), mask.shape[-1]
        return cls(
            layout, create_block_mask(visible, len(mask), None, queries, keys, device=device)
        )

    def attend(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Attention [b, q, N·e] of q [b, q, N, e] on k, v [b, k, K, e]; a query without visible
        keys returns zeros.
        """
        q, k, v = (x.transpose(1, 2) for x in (q, k, v))
        # Inside a compiled layer it is part of that layer's code. The CPU runs the uncompiled
        # function.
        flex: Any = flex_attention
        if q.is_cuda and not torch.compiler.is_compiling():
            flex = _compiled_flex()
        options = WIDE_HEAD_OPTIONS if q.is_cuda and q.shape[-1] >= WIDE_HEAD else None
        output: Tensor = flex(
            q, k, v, block_mask=self.blocks, enable_gqa=True, kernel_options=options
        )
        return output.transpose(1, 2).flatten(2)


@cache
def _compiled_flex() -> Any:
    return torch.compile(flex_attention, fullgraph=True, dynamic=True)


class PackedRun(NamedTuple):
    """One run of queries: order [b·k] of all keys, visible ones first by sample, and the start of
    each sample.
    """

    queries: int
    order: Tensor
    starts: Tensor  # [b + 1] int32


class PackedMask(NamedTuple):
    """A mask layout as flash attention over sequences of any length reads it."""

    layout: Any
    runs: tuple[PackedRun, ...]

    @classmethod
    def of(cls, layout: Layout) -> Self:
        runs = []
        for length, mask in zip(layout.lengths, layout.visible.unbind(1), strict=True):
            # The order has all keys, valid or not: the number of valid ones would have to be copied
            # from the GPU.
            order = (~mask).flatten().to(torch.uint8).argsort(stable=True)
            starts = functional.pad(mask.sum(1).cumsum(0), (1, 0)).to(torch.int32)
            runs.append(PackedRun(length, order, starts))
        return cls(layout, tuple(runs))

    def attend(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Attention [b, q, N·e] of q [b, q, N, e] on k, v [b, k, K, e]; a query without visible
        keys returns zeros.
        """
        batch, max_keys = k.shape[:2]
        outputs = []
        for part, run in zip(
            q.split([run.queries for run in self.runs], 1), self.runs, strict=True
        ):
            # The kernel leaves whatever memory held as the gradient of keys that no sample has,
            # past the last start.
            is_invalid = (torch.arange(len(run.order), device=k.device) >= run.starts[-1])[
                :, None, None
            ]
            keys, values = (x.flatten(0, 1)[run.order].masked_fill(is_invalid, 0) for x in (k, v))
            queries = part.flatten(0, 1)
            of_sample = torch.arange(batch + 1, device=q.device, dtype=torch.int32) * run.queries
            attend = varlen_attn if q.is_cuda else _one_by_one
            output: Any = attend(
                queries, keys, values, of_sample, run.starts, run.queries, max_keys
            )
            outputs.append(output.unflatten(0, (batch, run.queries)))
        return torch.cat(outputs, 1).flatten(2)


def _one_by_one(
    q: Tensor, k: Tensor, v: Tensor, q_starts: Tensor, k_starts: Tensor, max_q: int, max_k: int
) -> Tensor:
    """The result of `varlen_attn` on a CPU, for which it has no kernel."""
    outputs = []
    for (q0, q1), (k0, k1) in zip(
        q_starts.unfold(0, 2, 1).tolist(), k_starts.unfold(0, 2, 1).tolist(), strict=True
    ):
        queries, keys, values = (
            x[a:b].transpose(0, 1) for x, a, b in ((q, q0, q1), (k, k0, k1), (v, k0, k1))
        )
        if k0 == k1:
            outputs.append(torch.zeros_like(q[q0:q1]))
            continue
        output = functional.scaled_dot_product_attention(queries, keys, values, enable_gqa=True)
        outputs.append(output.transpose(0, 1))
    return torch.cat(outputs)
