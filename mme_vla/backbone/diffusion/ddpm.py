"""The noise schedule, which is diffusers': what is added in training, and the way back to a chunk."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mme_vla.errors import UserError, missing_extra

Schedule = Any
"""A `diffusers.DDPMParallelScheduler`, whose package is asked for only where it is used."""


def require_diffusers() -> None:
    """Make sure that the package is there, before anything is built.

    Raises:
        UserError: it is not.
    """
    try:
        import diffusers  # noqa: F401
    except ImportError:
        raise missing_extra("Diffusion Policy", "baselines") from None


def noise_schedule(steps: int) -> Schedule:
    """A squared-cosine schedule of so many steps that predicts noise and clips its guesses of the chunk to ±1.

    It moves its own tables to where it is used: make a new one for each use.
    """
    from diffusers import DDPMParallelScheduler

    with torch.device("cpu"):  # also where a policy is built on meta
        return DDPMParallelScheduler(
            num_train_timesteps=steps,
            beta_schedule="squaredcos_cap_v2",
            variance_type="fixed_small",
            clip_sample=True,
            prediction_type="epsilon",
        )


def add_noise(schedule: Schedule, chunk: Tensor, noise: Tensor, step: Tensor) -> Tensor:
    """Chunks [b, h, a] as noisy as the steps [b] say."""
    noisy: Tensor = schedule.add_noise(chunk, noise, step)
    return noisy


def denoise_once(schedule: Schedule, predicted: Tensor, step: int, x: Tensor, fresh: Tensor | None) -> Tensor:
    """One step of the way back, from the predicted noise and fresh noise of the same shape, which step 0 needs not."""
    steps = torch.full((len(x),), step, device=x.device)
    mean: Tensor = schedule.batch_step_no_noise(predicted, steps, x)
    if step == 0 or fresh is None:
        return mean
    variance: Tensor = schedule._get_variance(step)
    return mean + variance.to(x) ** 0.5 * fresh


def sample(
    schedule: Schedule, predict: Callable[[Tensor, Tensor], Tensor], start: Tensor, fresh: Tensor,
    steps: int | None = None,
) -> Tensor:  # fmt: skip
    """From noise to chunks.

    Args:
        predict: (noisy chunks [b, h, a], steps [b]) → their noise. start: [b, h, a].
        fresh: [b, steps − 1, h, a], what is added after each step but the last. steps: fewer than the schedule's.

    Raises:
        UserError: more steps than the schedule has.
    """
    total = int(schedule.config.num_train_timesteps)
    if steps is not None and not 1 <= steps <= total:
        raise UserError(f"flow_steps={steps}: Diffusion Policy samples in 1 to {total} steps.")
    schedule.set_timesteps(steps or total)
    x = start
    for i, step in enumerate(schedule.timesteps.tolist()):
        predicted = predict(x, torch.full((len(x),), step, device=x.device))
        x = denoise_once(schedule, predicted, step, x, fresh[:, i] if step else None)
    return x
