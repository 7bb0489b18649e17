"""RMS normalisation, plain and conditioned on the flow time."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from mme_vla.backbone.layers.precision import float32_linear

EPS = 1e-6


def rms_normalise(x: Tensor) -> Tensor:
    """Return x / √(mean(x²) + ε) over the last axis, in float32."""
    x = x.float()
    return x * (x.square().mean(-1, keepdim=True) + EPS).rsqrt()


class RMSNorm(nn.Module):
    """rms(x)·(1 + scale); the scale starts at 0."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor, condition: None = None) -> tuple[Tensor, None]:
        """Normalise [b, n, d]; the second value is the missing gate, so that both norms read alike."""
        return (rms_normalise(x) * (1 + self.scale.float())).to(x.dtype), None


class Modulation(NamedTuple):
    """What a condition does to one normalised sublayer: each [b or 1, 1, d]."""

    scale: Tensor
    shift: Tensor
    gate: Tensor


class AdaRMSNorm(nn.Module):
    """rms(x)·(1 + scale(c)) + shift(c), and a gate(c) for the sublayer's output. Starts as identity with gate 0."""

    keeps_float32 = True
    """Its weights are never gathered in bfloat16 (`shard_groups`)."""

    def __init__(self, width: int, condition_width: int) -> None:
        super().__init__()
        self.dense = nn.Linear(condition_width, 3 * width)
        nn.init.zeros_(self.dense.weight)
        nn.init.zeros_(self.dense.bias)

    def modulation(self, condition: Tensor) -> Modulation:
        """Map the condition [b, c] to (scale, shift, gate), in float32 as the condition is."""
        return Modulation(*float32_linear(self.dense, condition).unsqueeze(1).chunk(3, dim=-1))

    def forward(self, x: Tensor, condition: Tensor | Modulation) -> tuple[Tensor, Tensor]:
        """Normalise [b, n, d]. `condition` is the raw [b, c] or, when sampling, a modulation made beforehand."""
        m = condition if isinstance(condition, Modulation) else self.modulation(condition)
        return torch.addcmul(m.shift, rms_normalise(x), 1 + m.scale).to(x.dtype), m.gate.to(x.dtype)
