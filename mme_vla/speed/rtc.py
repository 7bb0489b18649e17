"""Real-time chunking: a chunk that is sampled while the one before it is being executed, and agrees
with it.

Black, Galliker, Levine: Real-Time Execution of Action Chunking Flow Policies (2025). Every Euler
step is pulled towards a path whose predicted end agrees with the actions that remain of the chunk
before. Their flow runs from noise at 0 to actions at 1; τ here is 1 at noise and 0 at actions.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mme_vla.types import Overlap

Velocity = Callable[[Tensor, int], Tensor]
"""The velocity [b, h, a] at noisy chunks [b, h, a], asked at the index of a flow time."""
STRONGEST = 5.0  # β of the paper: the pull would grow without bound at both ends


def overlap_weights(delay: int, count: int, horizon: int) -> Tensor:
    """How strongly a chunk of `horizon` steps is pulled towards `count` remaining ones, [horizon]
    in [0, 1].

    The first `delay`, which are executed before the new chunk is there, count in full; the others
    less and less, by the paper's equation 5; later ones are 0.
    """
    decay = (count - torch.arange(horizon, dtype=torch.float32)) / (count - delay + 1)
    weights = decay * torch.expm1(decay) / (math.e - 1)
    weights[:delay], weights[count:] = 1.0, 0.0
    return weights


def strength(time: Tensor) -> Tensor:
    """How strong the pull is at flow time τ: τ / ((1 − τ) r²) with r² = τ² / (τ² + (1 − τ)²), at
    most `STRONGEST`.
    """
    remaining = 1 - time
    return (
        ((remaining.square() + time.square()) / (remaining * time))
        .nan_to_num(posinf=STRONGEST)
        .clamp(max=STRONGEST)
    )


def rtc_guidance(velocity: Velocity, overlap: Overlap, times: Tensor) -> Velocity:
    """A velocity whose path ends in agreement with `overlap`.

    Each call then also runs the network backwards.

    Args:
        times: [n] flow times by index.
    """

    def pulled(x: Tensor, index: int) -> Tensor:
        with torch.enable_grad():
            x = x.detach().clone().requires_grad_(True)
            free = velocity(x, index).float()
            end = x - times[index] * free
            missing = (overlap.actions - end.detach()) * overlap.weight
            (pull,) = torch.autograd.grad(end, x, missing)
        return free.detach() - strength(times[index]) * pull

    return pulled
