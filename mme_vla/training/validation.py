"""The loss on held-out steps, with random numbers that belong to the sample: losses of different steps compare."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch

from mme_vla.policy.base import Policy
from mme_vla.training.order import generator_for


class Samples(Protocol):
    """A map-style dataset."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Any: ...


Collate = Callable[[Sequence[Any]], Any]
"""Items as a batch of the policy's own kind, which has `to`."""


class Validation:
    """A fixed set of held-out samples, read once and kept on the CPU."""

    def __init__(self, samples: Samples, collate: Collate, count: int, batch_size: int, seed: int) -> None:
        """Choose `count` samples, evenly spaced over the split (all, if it has no more)."""
        self._samples, self._collate, self._batch_size, self._seed = samples, collate, batch_size, seed
        size = len(samples)
        self.indices = np.linspace(0, size - 1, min(count, size)).round().astype(int).tolist()
        self._batches: list[Any] = []

    # Compiled code of the training step does not fit here, and a few batches are not worth code of their own.
    @torch.compiler.set_stance("force_eager")
    @torch.no_grad()
    def loss(
        self, policy: Policy, process: int = 0, processes: int = 1, reduce: Callable[..., Any] | None = None
    ) -> float:
        """The mean loss, without augmentation; the policy's mode is put back.

        Args:
            process, processes: which of how many this is; each takes its share of the batches. All of them run the
                policy equally often, as sharing its weights asks: one without a batch of its own repeats its last.
            reduce: sums a tensor over all processes (`Accelerator.reduce`), where there are several.
        """
        was_training = policy.training
        policy.eval()
        total = torch.zeros((), dtype=torch.float64)
        places = [self.indices[i : i + self._batch_size] for i in range(0, len(self.indices), self._batch_size)]
        mine = places[process::processes]
        for number in range(-(-len(places) // processes)):
            place = mine[number] if number < len(mine) else places[process % len(places)]
            if number == len(self._batches):
                self._batches.append(self._collate([self._samples[i] for i in place]))
            rows = [policy.training_noise(1, generator_for(self._seed, "validation", i)) for i in place]
            draws = {name: torch.cat([row[name] for row in rows]).to(policy.device) for name in rows[0]}
            loss, _ = policy(self._batches[number].to(policy.device), draws)
            if number < len(mine):
                total += float(loss) * len(place)
        policy.train(was_training)
        if reduce is not None and processes > 1:
            total = reduce(total.to(policy.device), reduction="sum")
        return float(total) / len(self.indices)
