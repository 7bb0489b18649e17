"""Real-time chunking: a chunk agrees with what the robot executes while it is chosen."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mme_vla.errors import UserError
from mme_vla.policy.mme import MMEPolicy
from mme_vla.speed.rtc import STRONGEST, overlap_weights, rtc_guidance, strength
from mme_vla.testing.small import moving_frames, small_policy
from mme_vla.types import Overlap

FRAMES = moving_frames(3)
STATE = np.linspace(-0.3, 0.3, 8, dtype=np.float32)


def episode_of(policy: MMEPolicy, seed: int = 3):
    episode = policy.start_episode("press the button", seed=seed)
    episode.observe({"front": FRAMES, "wrist": FRAMES}, np.stack([STATE] * 3))
    return episode


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return small_policy("framesamp_modul")


@pytest.fixture(scope="module")
def before(policy: MMEPolicy) -> np.ndarray:
    """The end of another chunk."""
    return policy.act(episode_of(policy, seed=8))[10:]


def test_weights_are_full_until_the_chunk_is_there_and_then_fade() -> None:
    weights = overlap_weights(delay=3, count=9, horizon=12)
    assert weights[:3].tolist() == [1, 1, 1] and weights[9:].tolist() == [0, 0, 0]
    assert (weights[3:9].diff() < 0).all() and weights[8] > 0 and weights[3] < 1
    remaining = (9 - 3) / (9 - 3 + 1)
    assert weights[3].item() == pytest.approx(remaining * (np.exp(remaining) - 1) / (np.e - 1))
    assert overlap_weights(4, 4, 4).tolist() == [1, 1, 1, 1]


def test_the_pull_is_bounded_at_both_ends() -> None:
    times = torch.tensor([1.0, 0.9, 0.5, 0.1, 0.0])
    assert strength(times).tolist() == pytest.approx(
        [STRONGEST, STRONGEST, 2.0, STRONGEST, STRONGEST]
    )


def test_the_pull_is_the_gradient_through_the_network() -> None:
    torch.manual_seed(0)
    mixing, x, time = torch.randn(6, 6), torch.randn(1, 2, 3), torch.tensor([0.5])
    overlap = Overlap(torch.randn(1, 2, 3), torch.rand(1, 2, 3))

    def velocity(x: torch.Tensor, _: int) -> torch.Tensor:
        return (x.flatten(1) @ mixing).reshape(x.shape)

    with torch.no_grad():
        gradient = rtc_guidance(velocity, overlap, time)(x, 0)
    jacobian = torch.eye(6) - 0.5 * mixing.T
    missing = (overlap.actions - (x - 0.5 * velocity(x, 0))) * overlap.weight
    expected = velocity(x, 0) - 2.0 * (missing.flatten() @ jacobian).reshape(x.shape)
    assert not gradient.requires_grad
    torch.testing.assert_close(gradient, expected)


def test_the_next_chunk_honours_what_was_committed(policy: MMEPolicy, before: np.ndarray) -> None:
    free = policy.act(episode_of(policy))
    episode = episode_of(policy)
    episode.set_action_prefix(before, delay=4)
    bound = policy.act(episode)
    apart = [np.abs(chunk[:10] - before).mean(1) for chunk in (free, bound)]
    # these are executed before the chunk is there
    assert (apart[1][:4] < 0.15 * apart[0][:4]).all(), apart
    assert apart[1][4:7].mean() < 0.6 * apart[0][4:7].mean(), apart  # these fade
    assert episode.action_prefix is None
    np.testing.assert_array_equal(policy.act(episode_of(policy)), free)


def test_a_prefix_changes_its_episode_alone(policy: MMEPolicy, before: np.ndarray) -> None:
    alone = episode_of(policy)
    alone.set_action_prefix(before, delay=4)
    bound, other = episode_of(policy), episode_of(policy, seed=5)
    bound.set_action_prefix(before, delay=4)
    together = policy.act([bound, other])
    np.testing.assert_allclose(together[0], policy.act(alone), atol=1e-5)
    np.testing.assert_allclose(together[1], policy.act(episode_of(policy, seed=5)), atol=1e-5)


def test_a_prefix_counts_inside_inference_mode(policy: MMEPolicy, before: np.ndarray) -> None:
    chunks = []
    for mode in (False, True):
        with torch.inference_mode(mode):
            episode = episode_of(policy)
            episode.set_action_prefix(before, delay=4)
            chunks.append(policy.act(episode))
    np.testing.assert_array_equal(*chunks)


@pytest.mark.parametrize(
    ("actions", "delay", "message"),
    [
        (np.zeros((21, 8)), 0, "1 to 20 actions of 8 numbers"),
        (np.zeros((3, 7)), 0, "of 8 numbers"),
        (np.full((3, 8), np.nan), 0, "finite"),
        (np.zeros((3, 8)), 4, "delay=4 must be a whole number from 0 to 3"),
    ],
)
def test_a_prefix_that_cannot_be_is_refused(
    policy: MMEPolicy, actions: np.ndarray, delay: int, message: str
) -> None:
    with pytest.raises(UserError, match=message):
        episode_of(policy).set_action_prefix(actions, delay)


def test_a_policy_that_answers_at_once_says_that_it_cannot() -> None:
    other = small_policy("pi05")
    other.info = replace(other.info, supports_rtc=False)
    episode = episode_of(other)
    episode.set_action_prefix(np.zeros((3, 8)), 1)
    with pytest.raises(UserError, match="does not support real-time chunking"):
        other.act(episode)
