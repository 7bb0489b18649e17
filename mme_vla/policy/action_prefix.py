"""Action prefixes of real-time chunking: actions that the robot executes while the next chunk is sampled."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import require
from mme_vla.processing.base import PolicyProcessor
from mme_vla.processing.normalise import finite_array
from mme_vla.speed.rtc import overlap_weights
from mme_vla.types import Overlap


@dataclass(frozen=True)
class ActionPrefix:
    """Actions [n, w] float32 as the robot takes them, of which the first `delay` are executed before the next chunk."""

    actions: np.ndarray
    delay: int


def checked_prefix(actions: np.ndarray, delay: int, horizon: int, width: int) -> ActionPrefix:
    """A prefix of a chunk of `horizon` actions of `width` numbers."""
    values = finite_array(actions, "the actions of the prefix")
    require(
        values.ndim == 2 and values.shape[1] == width and 1 <= len(values) <= horizon,
        f"set_action_prefix() needs 1 to {horizon} actions of {width} numbers, got shape {values.shape}.",
    )
    right = isinstance(delay, int) and not isinstance(delay, bool) and 0 <= delay <= len(values)
    require(
        right,
        f"set_action_prefix(): delay={delay!r} must be a whole number from 0 to {len(values)}, the actions given.",
    )
    return ActionPrefix(values, delay)


def prefix_overlap(
    prefixes: Sequence[ActionPrefix | None], states: Tensor, processor: PolicyProcessor, action_dim: int
) -> Overlap | None:
    """The normalised prefixes of n episodes at raw states [n, s]; None if none has one."""
    if all(prefix is None for prefix in prefixes):
        return None
    horizon, width = processor.embodiment.action.horizon, processor.embodiment.action.width
    actions, weight = torch.zeros(2, len(prefixes), horizon, action_dim)
    for i, prefix in enumerate(prefixes):
        if prefix is None:
            continue
        count = len(prefix.actions)
        padded = np.concatenate([prefix.actions, prefix.actions[-1:].repeat(horizon - count, 0)])
        actions[i] = processor.actions(padded, states[i])
        weight[i, :, :width] = overlap_weights(prefix.delay, count, horizon)[:, None]
    return Overlap(actions, weight)
