"""The mapping of a conversion as tables on the screen."""

import math
import re
import sys
from collections.abc import Iterable

from rich.console import Console
from rich.table import Table

from mme_vla.policy.base import Policy
from mme_vla.weights.adapter import Adapter
from mme_vla.weights.load import ADAPTERS
from mme_vla.weights.source import FORMATS, Source


def print_mapping(policy: Policy, source: Source, to: str, console: Console | None = None) -> None:
    """Print which tensor becomes which, and the lists of unread, tied and derived ones. Numbered layers are one row."""
    console = console or Console(width=None if sys.stdout.isatty() else 200)
    read, written = f"{source.folder} ({FORMATS[source.format]})", FORMATS[to]
    console.print(f"{read} → {written}; every tensor fits.", soft_wrap=True)
    sides = {ADAPTERS[fmt]: title for fmt, title in ((to, "written"), (source.format, "read")) if fmt != "ours"}
    if not sides:
        console.print("Both sides have the same names.")
    for make, title in reversed(sides.items()):
        _print_adapter(console, make(policy), policy, title)


def _print_adapter(console: Console, adapter: Adapter, policy: Policy, title: str) -> None:
    state = policy.state_dict()
    shapes = adapter.shapes(state)
    table = _table(f"{title}: {len(adapter.needed())} tensors ↔ {len(adapter.table)} of ours")
    for column in ("theirs", "shape", "layout", "ours", "tensors"):
        table.add_column(column, overflow="fold", justify="right" if column == "tensors" else "left")
    rows: dict[tuple[str, ...], int] = {}
    for ours, pieces in adapter.table.items():
        for piece in pieces:
            # A pattern with the same two sides only says how many rows there are.
            left, _, right = (side.strip() for side in piece.pattern.partition("->"))
            layout = "" if left == right else piece.pattern
            cells = (_starred(piece.path), _shape(shapes[piece.path]), layout, _starred(ours))
            rows[cells] = rows.get(cells, 0) + 1
    for row, count in rows.items():
        table.add_row(*row, str(count))
    console.print(table)
    gaps = [
        (gap.path, "whole" if gap.layer is None else f"layer {gap.layer}", _shape(gap.shape), str(math.prod(gap.shape)))
        for gap in adapter.unread
    ]
    about = "no action depends on them (dropped when read, zeros when written)"
    _print_list(console, f"{title}, unread: {about}", gaps, ("tensor", "part", "shape", "parameters"))
    _print_list(console, f"{title}, tied: copies", adapter.tied.items(), ("tensor", "is"))
    derived = [(constant.path, _shape(tuple(constant.make().shape))) for constant in adapter.derived]
    _print_list(console, f"{title}, derived: recomputed constants", derived, ("tensor", "shape"))


def _print_list(console: Console, title: str, rows: Iterable[tuple[str, ...]], columns: tuple[str, ...]) -> None:
    rows = list(rows)
    if not rows:
        console.print(f"{title}: none")
        return
    table = _table(title)
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _table(title: str) -> Table:
    return Table(title=title, title_justify="left", box=None, pad_edge=False)


def _starred(name: str) -> str:
    return re.sub(r"(?<=\.)\d+(?=\.)", "*", name)


def _shape(shape: tuple[int, ...]) -> str:
    return "×".join(map(str, shape)) or "scalar"
