"""Everything random in training, as a function of (seed, step): nothing has to be replayed to resume."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from mme_vla.errors import UserError


def seed_of(*key: int | str) -> int:
    """A 63-bit seed for whatever the key names; neighbouring keys give unrelated seeds."""
    return int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:8], "big") >> 1


def generator_for(*key: int | str) -> torch.Generator:
    """A CPU generator for whatever the key names: the same numbers whatever device trains."""
    return torch.Generator().manual_seed(seed_of(*key))


class BatchOrder:
    """Which samples each update sees: a fresh global shuffle every epoch, the last incomplete batch dropped.

    As a batch sampler it yields, update after update, this process's `accumulate` pieces as lists of (epoch, index).
    The whole batch of an update depends on neither the number of processes nor of pieces.
    """

    def __init__(
        self,
        samples: int,
        batch_size: int,
        seed: int,
        steps: range,
        accumulate: int = 1,
        process: int = 0,
        processes: int = 1,
    ) -> None:
        """Order `samples` samples for the updates `steps`."""
        if samples < batch_size:
            raise UserError(
                f"The training split has {samples} samples, fewer than train.batch_size={batch_size}: "
                "lower the batch size or add data."
            )
        if batch_size % (accumulate * processes):
            raise UserError(
                f"train.batch_size={batch_size} counts the samples of one update over all processes: it must be a "
                f"multiple of {processes} processes × train.accumulate={accumulate}."
            )
        self.samples, self.batch_size, self.seed, self.steps = samples, batch_size, seed, steps
        self.accumulate, self.process, self.processes = accumulate, process, processes
        self.steps_per_epoch = samples // batch_size
        self._epoch, self._shuffled = -1, torch.empty(0, dtype=torch.int64)

    def batch(self, step: int) -> list[int]:
        """The whole batch of one update, in order."""
        epoch, place = divmod(step, self.steps_per_epoch)
        if epoch != self._epoch:
            self._epoch = epoch
            self._shuffled = torch.randperm(self.samples, generator=generator_for(self.seed, "order", epoch))
        return self._shuffled[place * self.batch_size : (place + 1) * self.batch_size].tolist()

    def rows(self, piece: int) -> slice:
        """Which rows of the whole batch this process sees in its `piece`-th piece."""
        size = self.batch_size // (self.accumulate * self.processes)
        start = (piece * self.processes + self.process) * size
        return slice(start, start + size)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        for step in self.steps:
            batch, epoch = self.batch(step), step // self.steps_per_epoch
            for piece in range(self.accumulate):
                yield [(epoch, index) for index in batch[self.rows(piece)]]

    def __len__(self) -> int:
        return len(self.steps) * self.accumulate


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
