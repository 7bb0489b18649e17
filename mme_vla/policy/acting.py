"""What `Policy.act` does, step by step: observations to a chunk, and the chunk to actions of the
embodiment.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.types import stack_noise

if TYPE_CHECKING:
    from mme_vla.policy.base import Policy
    from mme_vla.policy.episode import Episode


@dataclass(frozen=True)
class SelectedActions:
    """What a policy chose for n episodes.

    batch: of `Policy.observation`. chunk: [n, h, a], in the network's units. actions: float32 [n,
    h, w], as the embodiment executes them, without the steps of a chunk that lie in the past.
    """

    batch: Any
    chunk: Tensor
    actions: np.ndarray


def choose_actions(
    policy: "Policy",
    episodes: Sequence["Episode"],
    predict: Callable[[Any, Mapping[str, Tensor]], Tensor],
) -> SelectedActions:
    """Choose the next chunk for episodes in one batch, with each episode's own noise.

    Args:
        predict: from the batch of `Policy.observation` and its noise to the normalised chunk [n, h,
            a].
    """
    processor, space = policy.require_processor(), policy.embodiment.action
    processor.require_stats()  # before the noise or memory of an episode changes
    batch = policy.observation(episodes)
    noise = stack_noise([e.draw() for e in episodes])
    was_training = policy.training
    policy.eval()
    try:
        chunk = predict(batch, noise).float().cpu()
    finally:
        policy.train(was_training)
    absolute = processor.absolute_actions(chunk, torch.stack([e.state for e in episodes]))
    decided = [space.decide(rows, e.options) for rows, e in zip(absolute, episodes, strict=True)]
    actions = torch.stack(decided).numpy()[:, processor.samples.window - 1 :]
    for episode, actions_of in zip(episodes, actions, strict=True):
        episode.acted(actions_of)
    return SelectedActions(batch, chunk, actions)
