"""Normalisation statistics of the training data, over the samples a policy trains on."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from mme_vla.data.console import progress
from mme_vla.data.episodes import EpisodeSource
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.errors import require
from mme_vla.processing.normalise import ExactStats, NormStats, QuantileStats, RunningStats, normalize

BATCH = 128  # as released; the quantiles of a running histogram depend a little on it


def compute_norm_stats(
    sources: Sequence[EpisodeSource],
    episodes: Sequence[np.ndarray] | None = None,
    horizon: int = 20,
    action_offset: int = 0,
    seed: int = 42,
    robot: Embodiment = ROBOMME_JOINT,
    every: bool = False,
    extremes: bool = False,
    exact: bool = False,
    video: bool = False,
) -> NormStats:
    """Mean, deviation and 1 % / 99 % quantiles of states and of action chunks as they are predicted.

    As released: one pass over all execution steps in shuffled order, in batches of 128 of which an incomplete last one
    is left out (unless it is the only one), every step of every chunk counted, repeated last actions included.
    Numbers of which one is 1, the letters of a choice, go from 0 to 1 whatever the data hold.

    Args:
        sources: the datasets.
        episodes: which of each dataset's episodes count; None counts all.
        horizon, action_offset: as in training; chunk step i of observation k is action k + offset + i.
        seed: of the order. robot: says which numbers of an action are relative to the state.
        every: count every execution step, in the data's order. extremes: keep the smallest and largest values too.
        exact: quantiles of all rows at once (linear interpolation), not of their histogram.
        video: count the conditioning video's steps too.
    """
    steps = _counted_steps(sources, episodes, video)
    require(len(steps) >= 2, f"Normalisation statistics need at least two execution steps; the data have {len(steps)}.")
    if not every:
        np.random.default_rng(seed).shuffle(steps)
    batches = -(-len(steps) // BATCH) if every else max(len(steps) // BATCH, 1)
    states, actions = (ExactStats() if exact else RunningStats() for _ in range(2))
    with progress("statistics", batches, unit="batches") as advance:
        for i in range(batches):
            rows = steps[i * BATCH : (i + 1) * BATCH].tolist()
            state = torch.from_numpy(np.stack([sources[s].states(e, t, t + 1)[0] for s, e, t in rows]))
            chunks = [sources[s].action_chunk(e, t, horizon, action_offset)[0] for s, e, t in rows]
            chunk = torch.from_numpy(np.stack(chunks))
            states.update(state.numpy())
            actions.update(robot.action.to_relative(chunk, state).numpy())
            advance(1)
    values = actions.result(extremes).to_dict()
    for name, value in {"q01": 0.0, "q99": 1.0, "min": 0.0, "max": 1.0}.items():
        for place in robot.action.choice if name in values else ():  # a letter that is seldom chosen has no range
            values[name][place] = value
    return NormStats(state=states.result(extremes), actions=QuantileStats.from_dict(values))


def _counted_steps(sources: Sequence[EpisodeSource], episodes: Sequence[np.ndarray] | None, video: bool) -> np.ndarray:
    """All (source, episode, step) of the execution phases, or of whole records, int32 [n, 3]."""
    parts: list[np.ndarray] = [np.zeros((0, 3), np.int32)]
    for i, source in enumerate(sources):
        for episode in range(len(source)) if episodes is None else episodes[i]:
            every = range(int(source.lengths[int(episode)])) if video else source.decisions(int(episode))
            step = np.asarray(every, np.int32)
            parts.append(np.stack([np.full_like(step, i), np.full_like(step, episode), step], axis=1))
    return np.concatenate(parts)


def normalised_states(states: np.ndarray) -> Tensor:
    """States [t, s] by their own quantiles, [t, s] float32: of recordings that no policy with statistics reads."""
    low, high = np.quantile(states.astype(np.float64), (0.01, 0.99), axis=0)
    stats = QuantileStats(states.mean(0), states.std(0), low, high)
    return normalize(torch.from_numpy(np.asarray(states, np.float32)), stats)
