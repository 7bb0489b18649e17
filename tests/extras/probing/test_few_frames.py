"""What a memory remembers where an arm lets it choose among some frames alone."""

from typing import Any

import numpy as np
import pytest
import torch

from mme_vla.errors import UserError
from mme_vla.extras.probing.arms import read_arm
from mme_vla.extras.probing.channels import channel_of, selectable
from mme_vla.extras.probing.probed import ProbedPolicy
from mme_vla.memory.history import FrameScores
from mme_vla.policy.episode import Episode
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import moving_frames, small_policy
from mme_vla.types import HistoryTokens, stack_noise

LENGTH = 40


def running(policy: MMEPolicy) -> Episode:
    episode = policy.start_episode("pick up the cube")
    frames = moving_frames(LENGTH, 64)
    states = np.random.default_rng(0).standard_normal((LENGTH, 8)).astype(np.float32)
    episode.observe({"front": frames, "wrist": frames}, states, is_demo=np.arange(LENGTH) < 10)
    return episode


def remembered(policy: MMEPolicy, episode: Episode, only: np.ndarray) -> HistoryTokens:
    channel = channel_of(policy)
    snapshot = channel.read(episode, only=only)
    return channel.counterfactual(episode, snapshot, snapshot.stores)


@pytest.mark.parametrize("only", [[32, 33, 36, 39], [0, 9, 20, 39]])
def test_ages_count_to_the_current_frame_where_few_frames_may_be_remembered(
    only: list[int],
) -> None:
    """A memory of times reads how long ago its frames were (`recent`, `oracle`)."""
    policy = small_policy(
        "framesamp_modul", memory={"budget": 128}, integration={"memory_position": "time"}
    )
    history = remembered(policy, running(policy), np.array(only))
    assert history.ages is not None
    ages = torch.unique(history.ages[history.mask])
    assert ages.tolist() == [LENGTH - 1 - frame for frame in reversed(only)]


@pytest.mark.parametrize("name", ["actions_modul", "spacetime_context", "tokendrop_modul"])
@torch.no_grad()
def test_a_choice_among_all_frames_changes_nothing(name: str) -> None:
    """States and actions are those of all frames, also where no frame has tokens."""
    policy = small_policy(name).eval()
    episode = running(policy)
    frames = selectable(policy.require_memory().storage).stored_frames(LENGTH)
    batch = policy.observation([episode])
    noise = stack_noise([policy.sampling_noise(torch.Generator().manual_seed(0))])
    expected = policy.predict_chunk(batch, [episode], noise)
    channel = channel_of(policy)
    chunk = channel.predict_chunk(batch, [remembered(policy, episode, frames)], noise)
    assert torch.allclose(chunk, expected, atol=1e-5)
    some = channel.predict_chunk(batch, [remembered(policy, episode, frames[-2:])], noise)
    assert not torch.allclose(some, expected, atol=1e-5)


def test_the_first_of_few_frames_has_a_score_where_that_of_an_episode_has_one() -> None:
    policy = small_policy("tokendrop_modul")
    episode: Any = running(policy)
    history = episode.history
    frames_left = np.array([15, 23, 39])

    def scored(first: int) -> list[int]:
        frames = np.append(first, np.arange(15, 40, 8))
        rows = np.zeros((len(frames), 64), np.float32)
        history._scored_frames, history._score_rows = frames.tolist(), list(rows)
        view = channel_of(policy).read(episode, only=frames_left).source[0]
        scores: FrameScores = view.scores
        return scores.frames.tolist()

    assert scored(0) == [0, 7, 15]
    assert scored(7) == [7, 15]


def test_a_chunk_that_is_not_finite_is_reported_before_it_is_recorded() -> None:
    policy = small_policy("framesamp_modul").eval()
    probe = ProbedPolicy(policy, read_arm("drop:all"))
    episode = probe.start_episode("pick up the cube")
    frames = moving_frames(4, 64)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((4, 8), np.float32))
    snapshot, stores = probe.snapshot(episode)
    sampled = policy.sampling_noise(torch.Generator())
    assert probe.ask(episode, snapshot, [stores], [sampled]).isfinite().all()
    with torch.no_grad():
        next(policy.integration.parameters()).fill_(float("nan"))
    with pytest.raises(UserError, match=r"drop:all: a chunk is not finite\. What reads"):
        probe.ask(episode, snapshot, [stores], [sampled])
