"""A policy shown recorded episodes as an environment would show them, so that what happens inside can be watched."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.statistics import compute_norm_stats
from mme_vla.errors import UserError
from mme_vla.policy.episode import Episode
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.prompt import SubgoalText

STRIDE = 16
"""Steps between two chunks, as an evaluation executes them."""


def replay(
    policy: MMEPolicy, source: EpisodeSource, episode: int, stride: int = STRIDE, most: int | None = None
) -> Iterator[tuple[int, Episode]]:
    """Show a recorded episode frame by frame and let the policy act at every `stride`-th execution step.

    The recorded actions continue being executed, whatever the policy answers. Subgoals, where the policy reads them,
    are the recorded ones.

    Args:
        most: chunks at most, spread over the episode.

    Yields:
        The step a chunk was just chosen at, and the running episode.
    """
    if not 0 <= episode < len(source):
        raise UserError(f"episode={episode}: {source.name} has episodes 0 … {len(source) - 1}.")
    give_statistics(policy, source)
    start, length = int(source.exec_starts[episode]), int(source.lengths[episode])
    steps = np.arange(start, length, stride)
    if most is not None and most < len(steps):
        steps = steps[np.linspace(0, len(steps) - 1, most).round().astype(int)]
    text = SubgoalText.from_config(policy.config.get("subgoal_text"))
    running, n_observed = policy.start_episode(source.goal(episode)), 0
    running.options = source.options(episode)
    for step in steps.tolist():
        indices = np.arange(n_observed, step + 1)
        views = {view: source.frames(episode, indices, view) for view in policy.embodiment.camera_names}
        executed = indices[indices >= start]
        actions = source.actions(episode)[np.maximum(executed - 1, 0)]
        if source.robot.action.frames is None:
            actions = source.past_actions(episode, step, len(actions))
        running.observe(views, source.states(episode, n_observed, step + 1), indices < start, actions)
        n_observed = step + 1
        if text is not None:
            texts = source.subgoals(episode, step)
            if text.kind not in texts:
                raise UserError(f"{source.name} has no {text.kind}, which this policy reads.")
            running.subgoal = texts[text.kind]
        policy.act([running])
        yield step, running


def replay_all(
    policy: MMEPolicy,
    source: EpisodeSource,
    episodes: Sequence[int] | None,
    stride: int = STRIDE,
    most: int | None = None,
    after: Callable[[int, int], None] = lambda episode, step: None,
) -> int:
    """Replay several episodes (None: all); return how many chunks were chosen.

    Args:
        after: called after every chunk, with its episode and step.
    """
    count = 0
    for episode in range(len(source)) if episodes is None else episodes:
        for step, _ in replay(policy, source, episode, stride, most):
            after(episode, step)
            count += 1
    return count


def give_statistics(policy: MMEPolicy, source: EpisodeSource) -> None:
    """Normalisation statistics for a fresh policy, which has none: those of the data it is shown."""
    processor = policy.require_processor()
    if processor.stats is None:
        processor.stats = compute_norm_stats(
            [source], horizon=processor.embodiment.action.horizon, robot=processor.embodiment
        )
