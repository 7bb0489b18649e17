"""The moving average of the trainable weights: what is evaluated, saved and released."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from mme_vla.training.parallel import like


class EMA:
    """average ← decay·average + (1 − decay)·weights after every update, begun with the initial weights as released."""

    def __init__(
        self,
        parameters: Mapping[str, nn.Parameter],
        decay: float,
        warmup: bool = False,
        reshard: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin with copies of the parameters; of sharded ones, every process of its own part.

        Args:
            decay: of the average; with `warmup` at most, and (1 + k)/(10 + k) after k updates before (0 at first).
            reshard: lets go of weights that were gathered from the parameters before they change.
        """
        self.decay, self.warmup, self._reshard = decay, warmup, reshard
        self._parameters = dict(parameters)
        self._average = [p.detach().clone() for p in self._parameters.values()]

    def decay_after(self, done: int) -> float:
        """The decay of the update before which `done` were done; the first one copies, while warming up."""
        if not self.warmup:
            return self.decay
        return min((1 + done) / (10 + done), self.decay) if done else 0.0

    @torch.no_grad()
    def update(self, done: int = 0) -> None:
        """Move towards the current weights, after `done` earlier updates (which only a warm-up asks)."""
        torch._foreach_lerp_(self._average, list(self._parameters.values()), 1 - self.decay_after(done))

    @torch.no_grad()
    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the averages from `tensors`, which must name every parameter."""
        for name, average in zip(self._parameters, self._average, strict=True):
            average.copy_(like(average, tensors[name]))

    def tensors(self) -> dict[str, Tensor]:
        """The averages by parameter name."""
        return dict(zip(self._parameters, self._average, strict=True))

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Within this context the module has the averaged weights.

        Storage is exchanged and nothing copied, but for shards: what gathers them holds on to their storage, so their
        numbers are exchanged.
        """
        self._exchange()
        try:
            yield
        finally:
            self._exchange()

    @torch.no_grad()
    def _exchange(self) -> None:
        self._reshard()
        for i, parameter in enumerate(self._parameters.values()):
            average = self._average[i]
            if isinstance(parameter, DTensor) and isinstance(average, DTensor):
                own, other = parameter.to_local(), average.to_local()
                kept = own.clone()
                own.copy_(other)
                other.copy_(kept)
            else:
                parameter.data, self._average[i] = average, parameter.data
        self._reshard()
