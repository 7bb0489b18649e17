"""Parts of memories: a small pre-norm transformer block in which some tokens read others."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.errors import check_sizes, require
from mme_vla.memory.recurrent import default_hidden
from mme_vla.speed import fused_kernels

MLP = 4
"""Width of a block's MLP, in widths of its tokens."""


@dataclass(frozen=True)
class ReaderOptions:
    """Options of the small transformer by which a memory reads.

    layers: number of blocks.
    hidden: their width; None is a quarter of `d_vision`, at least 64.
    heads: None is one for each 64 of `hidden`, at least 2.
    """

    layers: int = 2
    hidden: int | None = None
    heads: int | None = None

    def sizes(self, d_vision: int) -> tuple[int, int]:
        """Width and heads, where they are not set those that follow from `d_vision`."""
        check_sizes("memory", layers=self.layers)
        hidden = default_hidden(d_vision, self.hidden)
        heads = self.heads or max(2, hidden // 64)
        require(
            heads >= 1 and hidden % heads == 0,
            f"memory.heads={heads} does not divide memory.hidden={hidden}.",
        )
        return hidden, heads


class ReadingBlock(nn.Module):
    """x ← x + attention(x → [context]); x ← x + MLP(x). `context` may hold x itself."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.head_dim = width // heads
        self.norm = nn.LayerNorm(width)
        self.context_norm = nn.LayerNorm(width)
        self.mlp_norm = nn.LayerNorm(width)
        self.q = nn.Linear(width, width)
        self.kv = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)
        self.up = nn.Linear(width, MLP * width)
        self.down = nn.Linear(MLP * width, width)

    def forward(self, x: Tensor, context: Tensor, mask: Tensor) -> Tensor:
        """Let x [b, q, d] read context [b, k, d] where mask, bool [b, q, k], is True; a row without
        a True reads all.
        """
        q = self.q(self.norm(x)).unflatten(-1, (-1, self.head_dim))
        kv = self.kv(self.context_norm(context)).unflatten(-1, (-1, self.head_dim))
        k, v = kv.chunk(2, -2)
        q, k, v = (part.transpose(1, 2) for part in (q, k, v))
        # A row that may read nothing is padding: reading all keeps it finite.
        key_mask = (mask | ~mask.any(-1, keepdim=True))[:, None]
        with fused_kernels(q):
            read = functional.scaled_dot_product_attention(q, k, v, attn_mask=key_mask)
        x = x + self.out(read.transpose(1, 2).flatten(2))
        return x + self.down(functional.gelu(self.up(self.mlp_norm(x))))


def not_later(queries: Tensor, keys: Tensor) -> Tensor:
    """Which keys belong to a query's frame or an earlier one: frame numbers [b, q] and [b, k] →
    bool [b, q, k].
    """
    return keys[:, None, :] <= queries[:, :, None]


def by_frame(x: Tensor, patches: int) -> Tensor:
    """Tokens [b, t·p, …] of whole frames as [b, t, p, …]."""
    return x.unflatten(1, (-1, patches))


def rows_at(x: Tensor, at: Tensor) -> Tensor:
    """The rows at [b, k] of x [b, n, …]: [b, k, …]."""
    index = at.view(*at.shape, *[1] * (x.ndim - 2))
    return torch.gather(x, 1, index.expand(-1, -1, *x.shape[2:]))
