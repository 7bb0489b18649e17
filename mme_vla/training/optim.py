"""AdamW, warm-up, schedule, clipping: the released recipes, number by number."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.training.settings import TrainSettings


def learning_rate(step: int, peak: float, warmup: int) -> float:
    """Rate of update `step`, from 0: linear from peak/(warmup + 1) to `peak` at step `warmup`, then constant."""
    if step >= warmup:
        return peak
    start = peak / (warmup + 1)
    return start + (peak - start) * step / warmup


def scheduled_rate(step: int, settings: TrainSettings) -> float:
    """Rate of update `step`, from 0, of a recipe.

    Linear to `lr` at step `warmup`, from lr/(warmup + 1) or from 0; then constant, or half a cosine that is 0 at
    `schedule_steps`, or `gamma` times less from each of the `milestones` on.
    """
    peak, warmup = settings.lr, settings.warmup
    if step < warmup:
        return peak * step / warmup if settings.warmup_from_zero else learning_rate(step, peak, warmup)
    if settings.schedule == "cosine":
        total = settings.schedule_steps or settings.steps
        done = min((step - warmup) / max(total - warmup, 1), 1.0)
        return peak * 0.5 * (1 + math.cos(math.pi * done))
    if settings.schedule == "steps":
        return peak * settings.gamma ** sum(step >= milestone for milestone in settings.milestones)
    return peak


def make_optimizer(parameters: Iterable[nn.Parameter], settings: TrainSettings) -> torch.optim.AdamW:
    """AdamW over all trainable parameters; fused, which every device that trains supports.

    Those of fewer than `decay_min_dim` dimensions (biases, norms) are a group of their own, without weight decay.
    """
    found, least = list(parameters), settings.decay_min_dim
    decayed: dict[str, Any] = {"params": [p for p in found if p.ndim >= least]}
    others: dict[str, Any] = {"params": [p for p in found if p.ndim < least], "weight_decay": 0.0}
    return torch.optim.AdamW(
        [group for group in (decayed, others) if group["params"]],
        lr=settings.lr,
        betas=settings.betas,
        eps=settings.eps,
        weight_decay=settings.weight_decay,
        fused=True,
    )


@torch.no_grad()
def clip_gradients(gradients: list[Tensor], max_norm: float) -> Tensor:
    """Scale all gradients in place so that their common norm is at most `max_norm`; return the norm before."""
    norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))
    torch._foreach_mul_(gradients, (max_norm / norm).clamp(max=1.0))
    return norm
