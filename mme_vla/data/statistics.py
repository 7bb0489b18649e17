"""Normalisation statistics of the training data, over the samples a policy trains on."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mme_vla.data.console import progress
from mme_vla.data.episodes import EpisodeSource
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.errors import UserError, check_choice, require
from mme_vla.processing.normalise import (
    EPSILON,
    ExactStats,
    NormStats,
    QuantileStats,
    RunningStats,
    normalize,
)

log = logging.getLogger(__name__)

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
    narrow: str = "warn",
) -> NormStats:
    """Mean, deviation and 1 % / 99 % quantiles of states and of action chunks as they are
    predicted.

    As released: one pass over all execution steps in shuffled order, in batches of 128 of which an
    incomplete last one is left out (unless it is the only one), every step of every chunk counted,
    repeated last actions included. Numbers of which one is 1, the letters of a choice, go from 0 to
    1 whatever the data hold.

    Args:
        sources: the datasets.
        episodes: which of each dataset's episodes count; None counts all.
        horizon, action_offset: as in training; chunk step i of observation k is action k + offset +
            i.
        seed: of the order.
        robot: says which numbers of an action are relative to the state.
        every: count every execution step, in the data's order.
        extremes: keep the smallest and largest values too.
        exact: quantiles of all rows at once (linear interpolation), not of their histogram.
        video: count the conditioning video's steps too.
        narrow: what to do about a number whose range the values leave by far (`check_ranges`).

    Raises:
        UserError: `narrow` is none of `NARROW`, there are fewer than two steps, or a range is too
            narrow and `narrow` is `refuse`.
    """
    check_choice("narrow", narrow, NARROW)
    # All (source, episode, step) that count [n, 3].
    parts: list[np.ndarray] = [np.zeros((0, 3), np.int32)]
    for i, source in enumerate(sources):
        for episode in range(len(source)) if episodes is None else episodes[i]:
            counted = _steps_of(source, int(episode), video).astype(np.int32)
            parts.append(
                np.stack(
                    [np.full_like(counted, i), np.full_like(counted, episode), counted], axis=1
                )
            )
    steps = np.concatenate(parts)
    require(
        len(steps) >= 2,
        f"Normalisation statistics need at least two execution steps; the data have {len(steps)}.",
    )
    if not every:
        np.random.default_rng(seed).shuffle(steps)
    batches = -(-len(steps) // BATCH) if every else max(len(steps) // BATCH, 1)
    kind = ExactStats if exact else RunningStats
    states, actions = kind(), kind()
    with progress("statistics", batches) as advance:
        for i in range(batches):
            of_batch, chunks = [], []
            for s, episode, step in steps[i * BATCH : (i + 1) * BATCH].tolist():
                of_batch.append(sources[s].states(episode, step, step + 1)[0])
                chunks.append(sources[s].action_chunk(episode, step, horizon, action_offset)[0])
            state = np.stack(of_batch)
            states.update(state)
            relative = robot.action.to_relative(
                torch.from_numpy(np.stack(chunks)), torch.from_numpy(state)
            )
            actions.update(relative.numpy())
            advance(1)
    of_actions = actions.result(extremes)
    # a letter that is seldom chosen has no range
    letters = list(robot.action.choice)
    for bound, value in (
        (of_actions.q01, 0),
        (of_actions.q99, 1),
        (of_actions.min, 0),
        (of_actions.max, 1),
    ):
        if bound is not None:
            bound[letters] = value
    stats = NormStats(states.result(extremes), of_actions)
    return check_ranges(stats, sources, episodes, horizon, action_offset, robot, video, narrow)


NARROW_RANGES = 100
"""Ranges q01…q99 beyond which a value says that the range is not that of its number."""
NARROW = ("refuse", "warn", "widen", "ignore")
"""What can be done about a range that is far too narrow; `ignore` does not look, for policies that
do not need it.
"""


def check_ranges(
    stats: NormStats,
    sources: Sequence[EpisodeSource],
    episodes: Sequence[np.ndarray] | None = None,
    horizon: int = 20,
    action_offset: int = 0,
    robot: Embodiment = ROBOMME_JOINT,
    video: bool = False,
    narrow: str = "refuse",
) -> NormStats:
    """Compare statistics with the extremes of what they normalise: every state, and every action of
    every chunk.

    A number that never moves is in order. One that moves in so few samples that its quantiles do
    not show it, or that has values beyond `NARROW_RANGES` ranges, gives the loss targets of many
    thousands.

    Args:
        stats: of any data. The others are as in `compute_norm_stats`.
        narrow: `refuse`; `warn`; or `widen`, which makes the range of such a number reach to its
            extremes.

    Returns:
        The statistics, widened if asked to.

    Raises:
        UserError: a range is too narrow, and `narrow` is `refuse`. It names the number, its range
            and its extremes.
    """
    if narrow == "ignore":
        return stats
    state, actions = _extremes(sources, episodes, horizon, action_offset, robot, video)
    names = {"state": sources[0].state_names, "actions": sources[0].robot.action.names}
    changed = {}
    for kind, (least, greatest) in (("state", state), ("actions", actions)):
        of = getattr(stats, kind)
        reach = np.maximum(of.q01 - least, greatest - of.q99)
        beyond = reach > NARROW_RANGES * (of.q99 - of.q01 + EPSILON)
        places = np.flatnonzero(beyond).tolist()
        if kind == "actions":
            places = [place for place in places if place not in robot.action.choice]
        if not places:
            continue
        lines = []
        for place in places:
            name = names[kind][place] if place < len(names[kind]) else f"number {place + 1}"
            lines.append(
                f"{name} of the {kind.removesuffix('s')} has q01 {of.q01[place]:.6g} and q99"
                f" {of.q99[place]:.6g}, but values from {least[place]:.6g} to"
                f" {greatest[place]:.6g}"
            )
        summary = "; ".join(lines)
        if narrow == "widen":
            log.warning("%s. Its range is widened to these values.", summary)
            low, high = of.q01.copy(), of.q99.copy()
            low[places] = np.minimum(low[places], least[places])
            high[places] = np.maximum(high[places], greatest[places])
            changed[kind] = replace(of, q01=low, q99=high)
            continue
        message = (
            f"{summary}. Normalised by such a range they become numbers in the hundreds to"
            " millions, and the loss with them. If they are broken readings, correct the data. If"
            " the number seldom moves, set data.narrow_ranges=widen: its range then reaches from"
            " the least to the greatest value."
        )
        if narrow == "refuse":
            raise UserError(message)
        log.warning("%s", message)
    return replace(stats, **changed)


def _extremes(
    sources: Sequence[EpisodeSource],
    episodes: Sequence[np.ndarray] | None,
    horizon: int,
    action_offset: int,
    robot: Embodiment,
    video: bool,
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Least and greatest of the states, [s] each, and of the actions as they are predicted, [w]
    each.
    """
    state_ends: list[np.ndarray] = []
    action_ends: list[np.ndarray] = []
    for i, source in enumerate(sources):
        for number in range(len(source)) if episodes is None else episodes[i]:
            episode = int(number)
            steps = _steps_of(source, episode, video)
            if not len(steps):
                continue
            states = source.states(episode)[steps]
            state_ends += [states.min(axis=0), states.max(axis=0)]
            chunks, _ = source.action_chunk(episode, steps, horizon, action_offset)
            relative = robot.action.to_relative(
                torch.from_numpy(chunks), torch.from_numpy(states)
            ).numpy()
            action_ends += [relative.min(axis=(0, 1)), relative.max(axis=(0, 1))]
    return (
        (np.min(state_ends, axis=0), np.max(state_ends, axis=0)),
        (np.min(action_ends, axis=0), np.max(action_ends, axis=0)),
    )


def _steps_of(source: EpisodeSource, episode: int, video: bool) -> np.ndarray:
    """The steps of an episode that count, int64 [n]: its decisions, or all frames."""
    if video:
        return np.arange(int(source.lengths[episode]))
    return np.asarray(source.decisions(episode), np.int64)


def normalised_states(states: np.ndarray) -> Tensor:
    """States [t, s] by their own quantiles, [t, s] float32: of recordings that no policy with
    statistics reads.
    """
    low, high = np.quantile(states.astype(np.float64), (0.01, 0.99), axis=0)
    stats = QuantileStats(states.mean(0), states.std(0), low, high)
    return normalize(torch.from_numpy(np.asarray(states, np.float32)), stats)
