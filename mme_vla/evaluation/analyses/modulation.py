"""What a modulator predicts: statistics of scale and bias (paper, "Memory token contribution")."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor, nn

from mme_vla.errors import UserError
from mme_vla.integration.modulator import Modulator
from mme_vla.policy.mme import MMEPolicy


@dataclass
class ModulationStats:
    """Mean and deviation [depth] of a layer's predicted scales a and biases β, over samples, steps, tokens, features.

    The residual stream is multiplied by 1 + a. `overall` pools the layers.
    """

    scale: tuple[Tensor, Tensor]
    bias: tuple[Tensor, Tensor]
    overall: dict[str, tuple[float, float]]


@dataclass
class ModulationWatch:
    """Collects what a policy's modulator predicts while it is entered; without it nothing is computed."""

    policy: MMEPolicy
    _sums: dict[int, Tensor] = field(default_factory=dict)
    _lap: dict[int, Tensor] = field(default_factory=dict)
    _handles: list[Any] = field(default_factory=list)

    def __enter__(self) -> Self:
        integration = self.policy.integration
        if not isinstance(integration, Modulator):
            raise UserError(
                "This policy has no modulator, so no scale and bias to look at: choose one with integration=modulator, "
                "such as framesamp_modul."
            )
        for i, layer in enumerate(integration.layers):
            modulation: nn.Linear = layer.modulation  # type: ignore[assignment]
            self._handles.append(modulation.register_forward_hook(partial(self._take, i)))
        return self

    def __exit__(self, *_: object) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles = []

    def result(self) -> ModulationStats:
        """What has been seen."""
        return self._stats({})

    def lap(self) -> ModulationStats:
        """What has been seen since the last lap."""
        stats = self._stats(self._lap)
        self._lap = dict(self._sums)
        return stats

    def _stats(self, before: dict[int, Tensor]) -> ModulationStats:
        news = [self._sums[i] - before.get(i, 0) for i in sorted(self._sums)]
        if not news or not news[0].any():
            raise UserError("No modulation has been seen: let the policy act inside the `with` block.")
        sums = torch.stack(news)  # depth × (scale, bias) × (count, sum, squares)
        mean, std = _moments(sums)
        means, stds = _moments(sums.sum(0))
        overall = {name: (float(means[i]), float(stds[i])) for i, name in enumerate(("scale", "bias"))}
        return ModulationStats((mean[:, 0], std[:, 0]), (mean[:, 1], std[:, 1]), overall)

    def _take(self, index: int, _module: nn.Module, _args: tuple, output: Tensor) -> None:
        parts = [part.detach().double() for part in output.chunk(2, dim=-1)]
        rows = [[part.new_tensor(part.numel()), part.sum(), part.square().sum()] for part in parts]
        added = torch.stack([torch.stack(row) for row in rows]).cpu()
        self._sums[index] = self._sums.get(index, torch.zeros(2, 3, dtype=torch.float64)) + added


def _moments(sums: Tensor) -> tuple[Tensor, Tensor]:
    count, total, squares = sums.unbind(-1)
    mean = total / count
    return mean, (squares / count - mean.square()).clamp(min=0).sqrt()
