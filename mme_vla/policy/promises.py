"""Actions that are promised while the next chunk is chosen, as the network meets them (real-time chunking)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.processing.base import PolicyProcessor
from mme_vla.processing.normalise import finite_array
from mme_vla.speed.rtc import overlap_weights
from mme_vla.types import Overlap


@dataclass(frozen=True)
class Promise:
    """Actions [n, w] float32 as the robot takes them, of which the first `delay` are executed before the next chunk."""

    actions: np.ndarray
    delay: int


def checked_promise(actions: np.ndarray, delay: int, horizon: int, width: int) -> Promise:
    """A promise of a chunk of `horizon` actions of `width` numbers.

    Raises:
        UserError: actions of another form, more than a chunk, or a delay that they do not cover.
    """
    given = finite_array(actions, "the promised actions")
    if given.ndim != 2 or given.shape[1] != width or not 1 <= len(given) <= horizon:
        raise UserError(f"promise() needs 1 to {horizon} actions of {width} numbers, got shape {given.shape}.")
    if isinstance(delay, bool) or not isinstance(delay, int) or not 0 <= delay <= len(given):
        raise UserError(f"promise(): delay={delay!r} must be a whole number from 0 to {len(given)}, the actions given.")
    return Promise(given, delay)


def promised_overlap(
    promises: Sequence[Promise | None], states: Tensor, processor: PolicyProcessor, action_dim: int
) -> Overlap | None:
    """What the next chunks of n episodes, at raw states [n, s], are to agree with; None where nothing is promised."""
    if all(promise is None for promise in promises):
        return None
    horizon, width = processor.horizon, processor.embodiment.action.width
    actions, weight = torch.zeros(2, len(promises), horizon, action_dim)
    for i, promise in enumerate(promises):
        if promise is None:
            continue
        count = len(promise.actions)
        whole = np.concatenate([promise.actions, promise.actions[-1:].repeat(horizon - count, 0)])
        actions[i] = processor.actions(whole, states[i])
        weight[i, :, :width] = overlap_weights(promise.delay, count, horizon)[:, None]
    return Overlap(actions, weight)
