"""The backbone's first door: an ordered list of named blocks, and a table that says which block may look at which."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from torch import Tensor

from mme_vla.errors import UserError

Visibility = Mapping[str, frozenset[str] | set[str]]
"""For each block that asks: the blocks whose keys it may attend to."""

PI05_VISIBILITY: Visibility = {
    "images": {"images", "prompt"},
    "prompt": {"images", "prompt"},
    "action": {"images", "prompt", "action"},
}
"""Images and prompt are one bidirectional block; actions see everything and nothing sees them."""


@dataclass
class Block:
    """A run of tokens that share a name, hence a row of the table, and an expert whose weights process them.

    tokens: [b, n, d] at the expert's width. mask: [b, n] bool, False on padding.
    positions: [b, n] rotary positions of its own, on the line on which the others are numbered; None numbers it too.
    """

    name: str
    tokens: Tensor
    mask: Tensor
    expert: str
    positions: Tensor | None = None

    def __len__(self) -> int:
        return self.tokens.shape[1]


class Span(NamedTuple):
    """A block's name and length: what remains of it in a key-value cache."""

    name: str
    length: int


def row_of(name: str, table: Visibility) -> frozenset[str] | set[str]:
    """What a block of this name may look at."""
    if name not in table:
        raise UserError(f"Block {name!r} has no row in the visibility table; it has rows {sorted(table)}.")
    return table[name]


def attention_mask(
    queries: Sequence[Span], keys: Sequence[Span], query_mask: Tensor, key_mask: Tensor, table: Visibility
) -> Tensor:
    """Who attends whom: query q sees key k iff q's row of the table names k's block and both tokens are valid.

    Args:
        queries, keys: blocks in sequence order.
        query_mask: [b, q] bool. key_mask: [b, k] bool.
        table: the visibility table.

    Returns:
        [b, q, k] bool.
    """
    device = key_mask.device
    rows = []
    for query in queries:
        row = row_of(query.name, table)
        sees = [torch.full((key.length,), key.name in row, device=device) for key in keys]
        rows.append(torch.cat(sees).expand(query.length, -1))
    return torch.cat(rows) & query_mask[:, :, None] & key_mask[:, None, :]


def token_positions(mask: Tensor, past_mask: Tensor | None = None) -> Tensor:
    """Rotary positions [b, n]: valid tokens are numbered on, padding repeats the number before it (−1 at the start)."""
    positions = mask.long().cumsum(1) - 1
    return positions if past_mask is None else positions + past_mask.long().sum(1, keepdim=True)


def placed(numbered: Tensor, blocks: Sequence[Block]) -> Tensor:
    """Rotary positions [b, n] of blocks in sequence order: those of a block's own, where it has some."""
    if all(block.positions is None for block in blocks):
        return numbered
    parts = numbered.float().split([len(block) for block in blocks], 1)
    positions = [
        part if block.positions is None else block.positions for part, block in zip(parts, blocks, strict=True)
    ]
    return torch.cat(positions, 1)


class MaskLayout(NamedTuple):
    """What the visibility table and the valid keys of a batch come to.

    Padding asks like any other token of its block: nobody reads the answer, and no row is without a key that a valid
    token of that block has, so that no kernel divides nothing by nothing.

    lengths: of the runs of queries, in sequence order. seen: [b, runs, k] bool.
    """

    lengths: tuple[int, ...]
    visible: Tensor

    @classmethod
    def of(cls, queries: Sequence[Span], keys: Sequence[Span], valid: Tensor, table: Visibility) -> Self:
        """The sight of blocks, neighbours that see the same as one run.

        Args:
            queries, keys: blocks in sequence order. valid: [b, k] bool, of the keys. table: the visibility table.
        """
        runs: list[tuple[int, list[bool]]] = []
        for query in queries:
            sees = [key.name in row_of(query.name, table) for key in keys]
            if runs and runs[-1][1] == sees:
                runs[-1] = (runs[-1][0] + query.length, sees)
            else:
                runs.append((query.length, sees))
        parts = valid.split([key.length for key in keys], 1)
        hidden = [torch.zeros_like(part) for part in parts]
        rows = [
            valid if all(sees) else torch.cat([p if s else h for p, h, s in zip(parts, hidden, sees, strict=True)], 1)
            for _, sees in runs
        ]
        return cls(tuple(length for length, _ in runs), torch.stack(rows, 1))

    def part(self, rows: Sequence[slice]) -> "MaskLayout":
        """The sight of some of the queries, ranges of their numbers in order."""
        lengths, runs, start = [], [], 0
        for run, length in enumerate(self.lengths):
            count = sum(max(min(at.stop, start + length) - max(at.start, start), 0) for at in rows)
            if count:
                lengths.append(count)
                runs.append(run)
            start += length
        visible = (
            self.visible if len(runs) == len(self.lengths) else torch.stack([self.visible[:, run] for run in runs], 1)
        )
        return MaskLayout(tuple(lengths), visible)

    def expand(self, rows: Tensor) -> Tensor:
        """What is said of each run [b, runs, k], for each query [b, n, k]: a view where there is one run."""
        parts = [rows[:, run, None].expand(-1, length, -1) for run, length in enumerate(self.lengths)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, 1)
