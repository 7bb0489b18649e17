"""How far data workers read ahead, so that what waits has a bound in bytes."""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

MOST_AHEAD = 4  # batches a worker


def size_of(item: Any) -> int:
    """Bytes of all tensors in a sample."""
    if isinstance(item, Tensor):
        return item.nbytes
    if isinstance(item, Mapping):
        return sum(map(size_of, item.values()))
    if isinstance(item, Sequence) and not isinstance(item, str | bytes):
        return sum(map(size_of, item))
    return sum(map(size_of, vars(item).values())) if hasattr(item, "__dict__") else 0


def readers(workers: int, batch_bytes: int, most: float) -> tuple[int, int]:
    """How many workers read, and how many batches each of them reads ahead, within `most` bytes.

    Args:
        workers: as many as may be; at least one of them reads one batch ahead, whatever its size.
    """
    fitting = max(int(most // max(batch_bytes, 1)), 1)
    workers = min(workers, fitting)
    return workers, min(fitting // workers, MOST_AHEAD) if workers else 0
