"""The loss on held-out steps, with noise and times that belong to the sample: numbers of different steps compare."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch

from mme_vla.policy.mme import MMEPolicy
from mme_vla.training.order import draw_flow
from mme_vla.types import Batch


class Samples(Protocol):
    """A map-style dataset."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Any: ...


Collate = Callable[[Sequence[Any]], Batch]


class Validation:
    """A fixed set of held-out samples, read once and kept on the CPU."""

    def __init__(self, samples: Samples, collate: Collate, count: int, batch_size: int, seed: int) -> None:
        """Choose `count` samples, evenly spaced over the split (all, if it has no more)."""
        self._samples, self._collate, self._batch_size, self._seed = samples, collate, batch_size, seed
        size = len(samples)
        self.indices = np.linspace(0, size - 1, min(count, size)).round().astype(int).tolist()
        self._batches: list[Batch] = []

    @torch.no_grad()
    def loss(self, policy: MMEPolicy) -> float:
        """The mean flow-matching loss, without augmentation; the policy's mode is put back."""
        config = policy.backbone.config
        was_training = policy.training
        policy.eval()
        total, places = (
            0.0,
            [self.indices[i : i + self._batch_size] for i in range(0, len(self.indices), self._batch_size)],
        )
        for number, place in enumerate(places):
            if number == len(self._batches):
                self._batches.append(self._collate([self._samples[i] for i in place]))
            draws = [
                draw_flow(1, config.horizon, config.action_dim, config.time_distribution, self._seed, "validation", i)
                for i in place
            ]
            noise, time = (torch.cat(parts).to(policy.device) for parts in zip(*draws, strict=True))
            loss, _ = policy(self._batches[number].to(policy.device), noise, time)
            total += float(loss) * len(place)
        policy.train(was_training)
        return total / len(self.indices)
