"""Averages between two log lines."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from mme_vla.errors import UserError


class Window:
    """Sums what updates report, on their device, and the time they take; reading it waits for the device once.

    A number that only some updates report is averaged over those.
    """

    def __init__(self, batch_size: int) -> None:
        self._batch_size = batch_size
        self.restart()

    def restart(self) -> None:
        """Begin anew."""
        self._sums: dict[str, Tensor | float] = {}
        self._counts: dict[str, int] = {}
        self._updates = 0
        self._waited = self._paused = 0.0
        self._begun = time.perf_counter()

    def add(self, metrics: Mapping[str, Tensor | float]) -> None:
        """Take one update's numbers; plain ones, such as the learning rate, are the same in every process."""
        for name, value in metrics.items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value
            self._counts[name] = self._counts.get(name, 0) + 1
        self._updates += 1

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Time spent here is waiting for data."""
        begun = time.perf_counter()
        yield
        self._waited += time.perf_counter() - begun

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Time spent here (validation, checkpoints) is not training."""
        begun = time.perf_counter()
        yield
        self._paused += time.perf_counter() - begun

    def close(self, step: int, reduce: Callable[..., Any]) -> dict[str, float]:
        """The averages, and the speed; then begin anew.

        Args:
            step: updates done. reduce: averages a tensor over all processes (`Accelerator.reduce`).

        Raises:
            UserError: the loss is no longer a number.
        """
        averages = {name: total / self._counts[name] for name, total in self._sums.items()}
        measured = {name: average for name, average in averages.items() if isinstance(average, Tensor)}
        means = reduce(torch.stack(list(measured.values())), reduction="mean").tolist()
        known = averages | dict(zip(measured, means, strict=True))
        values = {f"train/{name}": float(mean) for name, mean in known.items()}
        seconds = time.perf_counter() - self._begun - self._paused
        values["speed/samples_per_s"] = self._updates * self._batch_size / seconds
        values["speed/waiting_for_data"] = self._waited / seconds
        broken = [name for name, value in values.items() if not math.isfinite(value)]
        if broken:
            raise UserError(
                f"{' and '.join(broken)} stopped being a number before step {step}; nothing of it was saved. "
                "Resume from the last checkpoint with a lower train.lr in a new run (init_from=…), "
                "or look for broken values in the data (python -m mme_vla.inspect dataset=…)."
            )
        self.restart()
        return values
