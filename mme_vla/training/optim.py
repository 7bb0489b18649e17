"""AdamW, warm-up, clipping: the released recipe, number by number."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from mme_vla.training.settings import TrainSettings


def learning_rate(step: int, peak: float, warmup: int) -> float:
    """Rate of update `step`, from 0: linear from peak/(warmup + 1) to `peak` at step `warmup`, then constant."""
    if step >= warmup:
        return peak
    start = peak / (warmup + 1)
    return start + (peak - start) * step / warmup


def make_optimizer(parameters: Iterable[nn.Parameter], settings: TrainSettings) -> torch.optim.AdamW:
    """AdamW over all trainable parameters alike; fused, which every device that trains supports."""
    return torch.optim.AdamW(
        list(parameters),
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
