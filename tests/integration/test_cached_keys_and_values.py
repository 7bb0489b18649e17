"""Keys and values of earlier prefixes: read beside the prefix, written once a chunk."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from helpers import REPOSITORY
from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.extras.probing.channels import WritableChannel, channel_of
from mme_vla.policy.caching import CachingEpisode
from mme_vla.testing.small import open_gates, random_batch, unit_stats
from mme_vla.types import KeysValues, stack_noise

EXAMPLE = REPOSITORY / "examples" / "fifo"


def built(name: str = "fifo", **overrides: Any) -> MMEPolicy:
    policy = build_policy(name, config_dir=EXAMPLE / "configs", backbone="tiny", **overrides)
    assert isinstance(policy, MMEPolicy)
    policy.require_processor().stats = unit_stats()
    open_gates(policy)
    return policy


@pytest.fixture
def policy(monkeypatch: pytest.MonkeyPatch) -> MMEPolicy:
    monkeypatch.syspath_prepend(EXAMPLE)
    return built(memory={"chunks": 2})


def frames(seed: int, count: int = 3) -> tuple[dict[str, np.ndarray], np.ndarray]:
    images = np.random.default_rng(seed).integers(0, 256, (count, 64, 64, 3), dtype=np.uint8)
    return {"front": images, "wrist": images}, np.zeros((count, 8), np.float32)


def started(policy: MMEPolicy, seed: int, chunks: int = 0) -> CachingEpisode:
    episode = policy.start_episode("press the button" + " twice" * (seed % 3), seed)
    assert isinstance(episode, CachingEpisode)
    for i in range(chunks + 1):
        episode.observe(*frames(10 * seed + i))
        if i < chunks:
            policy.act(episode)
    return episode


def test_an_empty_cache_gives_the_plain_chunk_bitwise(policy: MMEPolicy) -> None:
    base = built("pi05")
    episode, other = started(policy, 1), base.start_episode("press the button twice", 1)
    other.observe(*frames(10))
    assert np.array_equal(policy.act(episode), base.act(other))
    episode.observe(*frames(11))
    other.observe(*frames(11))
    assert not np.array_equal(policy.act(episode), base.act(other))


def test_the_loss_is_that_of_the_policy_without_memory(policy: MMEPolicy) -> None:
    base = built("pi05")
    batch, noise = random_batch(base), base.training_noise(2, torch.Generator().manual_seed(0))
    history = policy.memory.gather_selection(started(policy, 0).required_history(), 2)
    with_memory = replace(
        batch,
        history=history.__class__(*(x[None].repeat(2, *[1] * x.ndim) for x in history.tensors())),
    )
    assert torch.equal(policy(with_memory, noise)[0], base(batch, noise)[0])


def test_a_batch_with_unequal_caches_gives_each_episodes_own_chunk(policy: MMEPolicy) -> None:
    alone = [policy.act(started(policy, seed, chunks)) for seed, chunks in ((1, 0), (2, 1), (3, 3))]
    episodes = [started(policy, seed, chunks) for seed, chunks in ((1, 0), (2, 1), (3, 3))]
    together = policy.act(episodes)
    np.testing.assert_allclose(together, np.stack(alone), atol=1e-5)
    assert [len(episode.cache) for episode in episodes] == [1, 2, 2]


def test_the_cache_is_written_once_after_the_chunk_stands(
    policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode = started(policy, 2, 1)
    expected = policy.act(started(policy, 2, 1))
    processor, state, before = policy.require_processor(), episode.noise_state, episode.cache
    with monkeypatch.context() as patch:
        patch.setattr(
            processor,
            "absolute_actions",
            lambda *_: (_ for _ in ()).throw(RuntimeError("no memory")),
        )
        with pytest.raises(RuntimeError):
            policy.act(episode)
    assert episode.cache is before
    episode.noise_state = state
    assert np.array_equal(policy.act(episode), expected)
    assert [frame for frame, _ in episode.cache] == [2, 5]


def test_a_probe_reads_and_replaces_the_cache_and_writes_nothing(policy: MMEPolicy) -> None:
    channel, episode = channel_of(policy), started(policy, 2, 2)
    assert isinstance(channel, WritableChannel)
    snapshot, before = channel.read(episode), episode.cache
    (store,) = snapshot.stores
    assert [entry.time for entry in store.entries if entry] == [2, 5]
    noise = stack_noise([policy.sampling_noise(torch.Generator().manual_seed(0))])
    batch = policy.observation([episode])
    same = channel.counterfactual(episode, snapshot, [store])
    empty = channel.counterfactual(episode, snapshot, [store.without([0, 1])])
    retained, without = (channel.predict_chunk(batch, [twin], noise) for twin in (same, empty))
    assert torch.equal(retained, policy.predict_chunk(batch, [episode], noise))
    assert not torch.equal(retained, without)
    assert episode.cache is before
    channel.commit(episode, empty)
    episode.acted(np.zeros((20, 8), np.float32))
    assert [frame for frame, _ in episode.cache] == [5, 8]


def test_sampling_and_the_joint_pass_read_the_cache_alike(policy: MMEPolicy) -> None:
    episode = started(policy, 2, 2)
    batch = policy.observation([episode])
    memory = policy._memory_tokens([episode], batch)
    assert memory is not None
    memory.cache = KeysValues.stack([[values for _, values in episode.cache]])
    noise = {"noise": torch.randn(1, policy.horizon, policy.action_dim)}
    chunk = policy.sample(batch, noise, 1, memory)
    velocity = policy.velocity(batch, noise["noise"], torch.ones(1), memory)
    torch.testing.assert_close(chunk, noise["noise"] - velocity, atol=1e-5, rtol=1e-5)


def test_memory_and_integration_go_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    with pytest.raises(UserError, match="needs an integration that reads them"):
        built("fifo", integration="none")
    with pytest.raises(UserError, match="has no place for cache"):
        build_policy("fifo", config_dir=EXAMPLE / "configs", backbone="nano")
