"""Who may see whom in one pass, kept small: a row for each run of tokens that see the same, not one for each token."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from mme_vla.backbone.layers.blocks import Span, Visibility, row_of


class Sight(NamedTuple):
    """What the visibility table and the valid keys of a batch come to.

    Padding asks like any other token of its block: nobody reads the answer, and no row is without a key that a valid
    token of that block has, so that no kernel divides nothing by nothing.

    lengths: of the runs of queries, in sequence order. seen: [b, runs, k] bool.
    """

    lengths: tuple[int, ...]
    seen: Tensor

    @classmethod
    def of(cls, queries: Sequence[Span], keys: Sequence[Span], valid: Tensor, table: Visibility) -> Self:
        """The sight of blocks, neighbours that see the same as one run.

        Args:
            queries, keys: blocks in sequence order. valid: [b, k] bool, of the keys. table: the visibility table.

        Raises:
            UserError: a block has no row in the table.
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

    def part(self, rows: Sequence[slice]) -> "Sight":
        """The sight of some of the queries, ranges of their numbers in order."""
        lengths, runs, start = [], [], 0
        for run, length in enumerate(self.lengths):
            kept = sum(max(min(at.stop, start + length) - max(at.start, start), 0) for at in rows)
            if kept:
                lengths.append(kept)
                runs.append(run)
            start += length
        seen = self.seen if len(runs) == len(self.lengths) else torch.stack([self.seen[:, run] for run in runs], 1)
        return Sight(tuple(lengths), seen)

    def spread(self, rows: Tensor) -> Tensor:
        """What is said of each run [b, runs, k], for each query [b, n, k]: a view where there is one run."""
        parts = [rows[:, run, None].expand(-1, length, -1) for run, length in enumerate(self.lengths)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, 1)
