"""Flow matching: the path from noise to actions, its loss, and Euler's way back.

τ = 1 is pure noise: x_τ = τ·noise + (1 − τ)·actions, target u = noise − actions.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

MIN_PERIOD, MAX_PERIOD = 4e-3, 4.0


def sample_time(
    count: int, distribution: str, device: torch.device, generator: torch.Generator | None = None
) -> Tensor:
    """Draw τ [count]: `beta` gives 0.001 + 0.999·Beta(1.5, 1), as released; `uniform` U(0, 1), as the paper writes."""
    uniform = torch.rand(count, device=device, generator=generator)
    if distribution == "uniform":
        return uniform
    return 0.001 + 0.999 * uniform ** (1 / 1.5)  # the quantile function of Beta(α, 1) is u^(1/α)


def interpolate(actions: Tensor, noise: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """Return (x_τ, u) for chunks [b, h, a] and times [b]."""
    tau = time[:, None, None]
    return tau * noise + (1 - tau) * actions, noise - actions


def step_loss(velocity: Tensor, target: Tensor) -> Tensor:
    """Squared error averaged over action dimensions: [b, h, a] → [b, h]. Padded dimensions count, as released."""
    return (velocity.float() - target.float()).square().mean(-1)


def time_embedding(time: Tensor, width: int) -> Tensor:
    """Sin-cos features [b, width] of τ [b], periods 4e-3 … 4 in geometric steps."""
    fraction = torch.linspace(0, 1, width // 2, device=time.device, dtype=torch.float32)
    period = MIN_PERIOD * (MAX_PERIOD / MIN_PERIOD) ** fraction
    # Angles reach 1,600 rad, where the order of float32 operations shows: this is the released one.
    angle = time.float()[:, None] * (2 * math.pi / period)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def euler_times(steps: int, device: torch.device) -> Tensor:
    """The times 1, 1 − 1/steps, … at which the velocity is asked for, added up in float32 as released."""
    # Added up where they are needed: a copy from the CPU would wait for the GPU, and could not be in a CUDA graph.
    times, time = [], torch.ones((), device=device)
    for _ in range(steps):
        times.append(time)
        time = time - 1.0 / steps
    return torch.stack(times)


def euler(noise: Tensor, steps: int, velocity: Callable[[Tensor, int], Tensor]) -> Tensor:
    """Integrate from noise to actions: x ← x − v/steps, `velocity(x, index)` asked at `euler_times`."""
    x = noise
    for index in range(steps):
        x = x - velocity(x, index).to(x.dtype) / steps
    return x
