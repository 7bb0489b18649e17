"""Layers that all experts share: float32 linear layers, rotary embedding, and RMS norms."""

from typing import NamedTuple

import torch
from torch import Tensor, nn


def compute_dtype(x: Tensor) -> torch.dtype:
    """The dtype matmuls run in where `x` lives: autocast's when it is on, else the tensor's own."""
    kind = x.device.type
    return torch.get_autocast_dtype(kind) if kind != "meta" and torch.is_autocast_enabled(kind) else x.dtype


def float32_linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a linear layer in float32 whatever autocast or the stored weights say."""
    with torch.autocast(x.device.type if x.device.type != "meta" else "cpu", enabled=False):
        bias = None if layer.bias is None else layer.bias.float()
        return nn.functional.linear(x.float(), layer.weight.float(), bias)


BASE = 10_000.0


class Rotation(NamedTuple):
    """cos and sin of every position's angles, float32 [b, n, 1, h]: both halves turn by the same angles."""

    cos: Tensor
    sin: Tensor

    def rows(self, keep: slice) -> "Rotation":
        """Return the rotation of some of the tokens."""
        return Rotation(self.cos[:, keep], self.sin[:, keep])


def rotation(positions: Tensor, head_dim: int) -> Rotation:
    """Angles p·10000^(−2i/h) for positions [b, n], whole numbers or not.

    Of positions [b, n, k] the angles use the coordinates in turn.
    """
    exponent = torch.arange(head_dim // 2, device=positions.device, dtype=torch.float32) * (2 / head_dim)
    several = positions.ndim == 3
    places = positions[..., torch.arange(head_dim // 2) % positions.shape[-1]] if several else positions[..., None]
    angles = (places[:, :, None].float() / BASE**exponent).repeat(1, 1, 1, 2)
    return Rotation(angles.cos(), angles.sin())


def rotate(x: Tensor, rope: Rotation) -> Tensor:
    """Rotate queries or keys [b, n, heads, h]; the result keeps the dtype of x."""
    a, b = x.float().chunk(2, dim=-1)
    quarter_turned = torch.cat([-b, a], dim=-1)
    return torch.addcmul(x.float() * rope.cos, quarter_turned, rope.sin).to(x.dtype)


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
