"""Online and offline are one: the same selections, the same tokens, the same actions."""

import numpy as np
import pytest
import torch

from mme_vla import UserError
from mme_vla.memory.base import stack_history
from mme_vla.memory.history import OnlineHistory
from mme_vla.testing.small import (
    NEURAL,
    SMALL_VISION,
    cached_history,
    moving_frames,
    small_policy,
)
from mme_vla.types import Batch, FrameBatch

FRAMES = 90
FEW_TOKENS = {"vision": {**SMALL_VISION, "patch_size": 8}}
"""8×8 tokens a view; what is chosen and carried does not depend on their number."""


@pytest.fixture(params=NEURAL, scope="module")
def policy(request):
    return small_policy(request.param, policy={"history_dtype": "float32"}, backbone=FEW_TOKENS)


@pytest.fixture(scope="module")
def frames():
    return moving_frames(FRAMES)


@pytest.fixture(scope="module")
def framesamp():
    """One policy, for what no memory decides."""
    return small_policy("framesamp_modul", policy={"history_dtype": "float32"}, backbone=FEW_TOKENS)


def online_history(policy, frames: np.ndarray, chunk: int, exec_start: int = 0) -> OnlineHistory:
    """The same episode as an environment would deliver it, `chunk` frames at a time."""
    memory = policy.require_memory()
    history = OnlineHistory(memory.storage, memory.make_scorer(), exec_start)
    for start in range(0, len(frames), chunk):
        history.take(FrameBatch.of(frames[start : start + chunk]), policy.encode_frames)
    return history


def feed(policy, frames, goal="pick up the cube", seed=0, chunk=16, demo=30, upto=None):
    episode = policy.start_episode(goal, seed=seed)
    upto = len(frames) if upto is None else upto
    for start in range(0, upto, chunk):
        part = slice(start, min(start + chunk, upto))
        view = {"front": frames[part], "wrist": frames[part][:, ::-1]}
        count = len(frames[part])
        episode.observe(
            view, np.zeros((count, 8), np.float32), np.arange(start, start + count) < demo
        )
    return episode


@pytest.mark.slow
def test_streaming_and_offline_give_the_same_actions(policy, frames):
    episode = feed(policy, frames)
    streamed = policy.act([episode])
    processor = policy.processor
    history = stack_history(
        [policy.memory.gather_selection(cached_history(policy, frames, exec_start=30), FRAMES - 1)]
    )
    prompt, prompt_mask = processor.prompt("pick up the cube")
    batch = Batch(
        images=processor.images([frames[-1], frames[-1][::-1]])[None],
        image_mask=torch.ones(1, 2, dtype=torch.bool),
        prompt=prompt[None],
        prompt_mask=prompt_mask[None],
        history=history,
    )
    noise = policy.start_episode("pick up the cube", seed=0).draw()["noise"][None]
    chunk = policy.sample_actions(batch, noise)
    offline = processor.absolute_actions(chunk, torch.zeros(1, 8)).numpy()
    assert np.abs(streamed - offline).max() < 1e-4


@pytest.mark.slow
def test_a_batch_of_episodes_acts_as_each_alone(policy, frames):
    def episodes():
        return [
            feed(policy, frames, "pick up the cube", seed=1),
            feed(policy, frames[::-1], "put it into the bin", seed=2, demo=0),
            feed(policy, frames, "press the button", seed=3, upto=5, demo=0),
        ]

    together = policy.act(episodes())
    alone = np.concatenate([policy.act([episode]) for episode in episodes()])
    assert np.abs(together - alone).max() < 1e-4


def test_acting_adds_nothing_to_memory(framesamp, frames):
    episode = feed(framesamp, frames, upto=20)
    before = len(episode.history)
    framesamp.act([episode])
    framesamp.act([episode])
    assert len(episode.history) == before == 20


def test_episodes_refuse_what_they_cannot_use(framesamp, frames):
    episode = framesamp.start_episode("press the button")
    with pytest.raises(UserError, match="No frame was observed"):
        framesamp.act([episode])
    state = np.zeros((2, 8), np.float32)
    with pytest.raises(UserError, match="wrist"):
        episode.observe({"front": frames[:2]}, state)
    with pytest.raises(UserError, match="uint8"):
        episode.observe({"front": frames[:2] / 255.0, "wrist": frames[:2]}, state)
    with pytest.raises(UserError, match="states of shape"):
        episode.observe({"front": frames[:2], "wrist": frames[:2]}, state[:, :7])
    both = {"front": frames[:2], "wrist": frames[:2]}
    episode.observe(both, state, is_demo=False)
    with pytest.raises(UserError, match="video goes first"):
        episode.observe(both, state, is_demo=True)


def test_bfloat16_history_is_what_the_cache_stores(frames):
    policy = small_policy("framesamp_context", backbone=FEW_TOKENS)
    online = online_history(policy, frames, 16)
    cached = cached_history(policy, frames)
    step = FRAMES - 1
    a, b = (
        policy.memory.gather_selection(online, step),
        policy.memory.gather_selection(cached, step),
    )
    assert a.features.dtype == b.features.dtype == torch.bfloat16
    assert torch.allclose(a.features.float(), b.features.float(), rtol=1e-2, atol=1e-3)


def test_tokendrop_at_the_smallest_budget_keeps_the_first_frame_alone(frames):
    policy = small_policy("tokendrop_context", backbone=FEW_TOKENS, memory={"budget": 64})
    selected = policy.memory.select(cached_history(policy, frames), FRAMES - 1)
    assert selected.tolist() == [[0, patch] for patch in range(64)]


def test_tokendrop_encodes_only_the_frames_it_can_choose(frames, monkeypatch):
    policy = small_policy("tokendrop_context", backbone=FEW_TOKENS)
    counted = []
    original = policy.encode_frames
    monkeypatch.setattr(policy, "encode_frames", lambda f: counted.append(len(f)) or original(f))
    feed(policy, frames, demo=0)
    assert sum(counted) == 1 + FRAMES // 8


def test_an_error_leaves_the_episode_as_it_was(framesamp, frames):
    episode = feed(framesamp, frames, upto=20, demo=0)
    before = episode.gather_selection()
    both = {"front": frames[:3], "wrist": frames[:3]}
    states = np.zeros((3, 8), np.float32)
    for wrong in (
        {"actions": np.zeros((1, 8))},
        {"is_demo": np.array([True, False])},
        {"is_demo": True},
    ):
        with pytest.raises(UserError):
            episode.observe(both, states, **wrong)
    with pytest.raises(UserError, match="finite"):
        episode.observe(both, np.full((3, 8), np.nan))
    assert (len(episode.history), episode.n_observed_frames) == (20, 20)
    assert torch.equal(episode.gather_selection().features, before.features)


def test_acting_without_statistics_is_refused_before_anything_moves(framesamp, frames):
    episode = feed(framesamp, frames, upto=5, demo=0)
    stats, framesamp.processor.stats = framesamp.processor.stats, None
    try:
        with pytest.raises(UserError, match="statistics"):
            framesamp.act([episode])
    finally:
        framesamp.processor.stats = stats
    untouched = framesamp.start_episode(episode.goal, seed=0).noise_state
    assert torch.equal(episode.noise_state, untouched)
