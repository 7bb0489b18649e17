"""Writing so that a reader, or the next run, sees the old file or the new one and nothing between."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a draft beside `path`, which becomes `path` in one rename if the block ends well and is removed otherwise.

    >>> with write_atomically(Path("plan.json")) as draft:
    ...     draft.write_text("{}")
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # The process in the name: two writers never share a draft, and the last one to finish wins whole.
    draft = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield draft
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any, indent: int | None = 2) -> None:
    """Write `value` as JSON in one rename; numbers that are not finite are refused (ValueError)."""
    with write_atomically(path) as draft:
        draft.write_text(json.dumps(value, indent=indent, allow_nan=False) + "\n")
