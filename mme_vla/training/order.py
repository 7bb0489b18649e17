"""Batch order, random numbers and validation loss as functions of (seed, step): resuming replays
nothing.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import counted, require
from mme_vla.policy.base import Policy


def seed_of(*key: int | str) -> int:
    """A 63-bit seed for whatever the key names; neighbouring keys give unrelated seeds."""
    return int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:8], "big") >> 1


def generator_for(*key: int | str) -> torch.Generator:
    """A CPU generator for whatever the key names: the same numbers whatever device trains."""
    return torch.Generator().manual_seed(seed_of(*key))


class BatchOrder:
    """Which samples each update sees: a fresh global shuffle every epoch, the last incomplete batch
    dropped.

    As a batch sampler it yields, update after update, this process's `accumulate` pieces as lists
    of (epoch, index). The whole batch of an update depends on neither the number of processes nor
    of pieces.
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
        require(
            samples >= batch_size,
            f"The training split has {counted(samples, 'sample')}, fewer than"
            f" train.batch_size={batch_size}: lower the batch size or add data.",
        )
        require(
            batch_size % (accumulate * processes) == 0,
            f"train.batch_size={batch_size} counts the samples of one update over all processes: it"
            f" must be a multiple of {processes} processes × train.accumulate={accumulate}.",
        )
        self.samples = samples
        self.batch_size = batch_size
        self.seed = seed
        self.steps = steps
        self.accumulate = accumulate
        self.process = process
        self.processes = processes
        self.steps_per_epoch = samples // batch_size
        self._epoch = -1
        self._shuffled = torch.empty(0, dtype=torch.int64)

    def batch(self, step: int) -> list[int]:
        """The whole batch of one update, in order."""
        epoch, place = divmod(step, self.steps_per_epoch)
        if epoch != self._epoch:
            self._epoch = epoch
            self._shuffled = torch.randperm(
                self.samples, generator=generator_for(self.seed, "order", epoch)
            )
        return self._shuffled[place * self.batch_size : (place + 1) * self.batch_size].tolist()

    def rows(self, piece: int) -> slice:
        """Which rows of the whole batch this process sees in its `piece`-th piece."""
        size = self.batch_size // (self.accumulate * self.processes)
        start = (piece * self.processes + self.process) * size
        return slice(start, start + size)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        for step in self.steps:
            batch = self.batch(step)
            epoch = step // self.steps_per_epoch
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
    if hasattr(item, "__dict__"):
        return sum(map(size_of, vars(item).values()))
    return 0


def readers(workers: int, batch_bytes: int, most: float) -> tuple[int, int]:
    """How many workers read, and how many batches each of them reads ahead, within `most` bytes.

    Args:
        workers: as many as may be, at least one, which reads one batch ahead whatever its size.
    """
    fitting = max(int(most // max(batch_bytes, 1)), 1)
    workers = min(workers, fitting)
    return workers, min(fitting // workers, MOST_AHEAD)


class Samples(Protocol):
    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Any: ...


Collate = Callable[[Sequence[Any]], Any]
"""Items as a batch of the policy's own kind, which has `to`."""


class Validation:
    """A fixed set of held-out samples, read once and kept on the CPU."""

    def __init__(
        self, samples: Samples, collate: Collate, count: int, batch_size: int, seed: int
    ) -> None:
        """Choose `count` samples, evenly spaced over the split (all, if it has no more)."""
        self._samples = samples
        self._collate = collate
        self._batch_size = batch_size
        self._seed = seed
        size = len(samples)
        self.indices = np.linspace(0, size - 1, min(count, size)).round().astype(int).tolist()
        self._batches: list[Any] = []

    @torch.no_grad()
    def loss(
        self,
        policy: Policy,
        process: int = 0,
        processes: int = 1,
        reduce: Callable[..., Any] | None = None,
    ) -> float:
        """The mean loss, without augmentation; the policy's mode is put back.

        Args:
            process, processes: which of how many this is; each takes its share of the batches. All
                of them run the policy equally often, as sharing its weights asks: one without a
                batch of its own repeats its last.
            reduce: sums a tensor over all processes (`Accelerator.reduce`), where there are
                several.
        """
        was_training = policy.training
        policy.eval()
        total = torch.zeros((), dtype=torch.float64)
        chunks = []
        for i in range(0, len(self.indices), self._batch_size):
            chunks.append(self.indices[i : i + self._batch_size])
        share = chunks[process::processes]
        for number in range(math.ceil(len(chunks) / processes)):
            counts = number < len(share)
            indices = share[number] if counts else chunks[process % len(chunks)]
            if number == len(self._batches):
                self._batches.append(self._collate([self._samples[i] for i in indices]))
            # Each sample has its own noise, whatever batch it is in.
            rows = []
            for i in indices:
                rows.append(policy.training_noise(1, generator_for(self._seed, "validation", i)))
            draws = {}
            for name in rows[0]:
                draws[name] = torch.cat([row[name] for row in rows]).to(policy.device)
            # Compiled code of the training step does not fit here, and a few batches are not worth
            # code of their own.
            with torch.compiler.set_stance("force_eager"):
                loss, _ = policy(self._batches[number].to(policy.device), draws)
            if counts:
                total += float(loss) * len(indices)
        policy.train(was_training)
        if reduce is not None and processes > 1:
            total = reduce(total.to(policy.device), reduction="sum")
        return float(total) / len(self.indices)
