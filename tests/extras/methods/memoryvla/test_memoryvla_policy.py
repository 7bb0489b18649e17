"""MemoryVLA as a policy: groups of one episode, banks in the episode."""

import numpy as np
import pytest
import torch

from helpers.memoryvla_golden import reached
from mme_vla import UserError, build_policy
from mme_vla.data.sources import open_sources
from mme_vla.extras.methods.memoryvla.groups import GroupDataset
from mme_vla.extras.methods.memoryvla.policy import MemoryVlaPolicy
from mme_vla.extras.methods.memoryvla.processor import GroupBatch

SMALL = {"vision": {"image_size": 28}}


def tiny() -> MemoryVlaPolicy:
    return reached(backbone={**SMALL}, processor={"group_size": 4})


@pytest.fixture(scope="module")
def policy() -> MemoryVlaPolicy:
    """For tests that change nothing in it."""
    return tiny()


def frames(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        name: rng.integers(0, 256, (count, 32, 32, 3), dtype=np.uint8)
        for name in ("front", "wrist")
    }


def states(count: int) -> np.ndarray:
    return np.zeros((count, 8), np.float32)


def groups(policy: MemoryVlaPolicy) -> GroupDataset:
    sources = open_sources(["sample"], policy.embodiment)
    return GroupDataset(sources, policy.require_processor(), group_size=4)


def test_a_group_is_of_one_episode_in_the_order_of_time_and_sampled_anew_every_epoch(
    policy: MemoryVlaPolicy,
) -> None:
    data = groups(policy)
    first, again = data[1], data[1]
    assert np.array_equal(first["times"], again["times"])
    assert len(first["times"]) == 4 and (np.diff(first["times"]) > 0).all()
    data.set_epoch(1)
    assert (
        not np.array_equal(data[1]["times"], first["times"])
        and data[1]["place"][1] == first["place"][1]
    )
    count = len(data.sources[0])
    assert {data[i]["place"][1] for i in range(count)} == set(range(count))
    assert len(data) % count == 0 and abs(len(data) * 4 - data.steps) <= 4 * count
    with pytest.raises(IndexError):
        data[len(data)]


def test_the_group_before_a_step_is_where_the_policy_would_have_been_requested(
    policy: MemoryVlaPolicy,
) -> None:
    data = groups(policy)
    _, _, frame = data.locate(30)
    assert data.observation(30)["times"].tolist() == [max(frame, 0) - 8 * i for i in (3, 2, 1, 0)]


def batch_of(policy: MemoryVlaPolicy, count: int = 2) -> GroupBatch:
    data = groups(policy)
    return policy.require_processor().collate([data[i] for i in range(count)])


def test_the_loss_repeats_with_its_draws_and_reaches_every_part(policy: MemoryVlaPolicy) -> None:
    batch = batch_of(policy)
    draws = policy.training_noise(2, torch.Generator().manual_seed(0))
    loss, metrics = policy(batch, draws)
    assert torch.equal(loss, policy(batch, draws)[0]) and metrics["loss"] == loss
    loss.backward()
    component = policy.finetune_spec.component_of
    for part in ("vision", "vlm", "memory", "action"):
        learned = [
            p
            for name, p in policy.named_parameters()
            if component(name) == part and p.grad is not None
        ]
        assert any(p.grad.abs().sum() > 0 for p in learned), part  # type: ignore[union-attr]


@torch.no_grad()
def test_images_are_changed_by_their_draws_alone_whatever_stands_beside_them() -> None:
    policy = tiny().train()
    batch = batch_of(policy)
    draws = policy.training_noise(2, torch.Generator().manual_seed(0))
    draws_ = [
        draws | policy.augmentation_params(2, torch.Generator().manual_seed(seed))
        for seed in (1, 1, 2)
    ]
    assert draws_[0]["changes"].shape == (2, 4, 6)
    first, again, other = (policy(batch, each)[0] for each in draws_)
    assert torch.equal(first, again) and not torch.equal(first, other)
    halves = [
        policy(batch.rows(slice(i, i + 1)), {k: v[i : i + 1] for k, v in draws_[0].items()})
        for i in range(2)
    ]
    # pixels are rounded, so that a last bit may become a level
    apart = sum(loss for loss, _ in halves) / 2
    assert abs(apart - first) < abs(other - first) / 20
    assert policy.eval().augmentation_params(2, torch.Generator()) == {}


@torch.no_grad()
def test_actions_repeated_past_the_end_count_only_where_they_are_requested(
    policy: MemoryVlaPolicy, monkeypatch
) -> None:
    data, collate = groups(policy), policy.require_processor().collate
    baseline = collate([data[0], data.observation(data.steps - 1)])
    data.mask_padding = True
    batch = collate([data[0], data.observation(data.steps - 1)])
    assert baseline.action_mask is None and batch.action_mask.shape == batch.actions.shape[:3]
    counted = batch.action_mask[batch.valid].tile(policy.sizes.repeats, 1)
    assert 0 < counted.sum() < counted.numel()
    losses = torch.rand(counted.shape, generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(policy.core, "noise_error", lambda *_: losses)
    torch.testing.assert_close(policy(baseline)[0], losses.mean())
    expected = torch.stack(
        [
            row[valid].mean() if valid.any() else row.new_zeros(())
            for row, valid in zip(losses, counted, strict=True)
        ]
    )
    torch.testing.assert_close(policy(batch)[0], expected.mean())


def test_acting_twice_at_one_frame_stores_one_entry_and_gives_the_same_chunk(
    policy: MemoryVlaPolicy,
) -> None:
    episode = policy.start_episode("press the button", seed=3)
    episode.observe(frames(1), states(1))
    start = episode.noise_state
    chunk = policy.act(episode)
    assert chunk.shape == (16, 8) and episode.banks.count == 0
    episode.noise_state = start
    np.testing.assert_array_equal(policy.act(episode), chunk)
    episode.observe(frames(8, seed=1), states(8))
    assert episode.banks.count == 1 and episode.pending is None
    policy.act(episode)
    episode.observe(frames(8, seed=2), states(8))
    assert (
        episode.banks.cognition.times.tolist() == [0, 1] == episode.banks.perceptual.times.tolist()
    )


@pytest.mark.parametrize(("length", "saved"), [(17, 2), (18, 3), (1, 0), (8, 1)])
def test_every_eighth_frame_of_the_video_is_saved_but_not_its_last(
    policy: MemoryVlaPolicy, length: int, saved: int
) -> None:
    """However the frames arrive: at once, or one by one."""
    video, now = frames(length), frames(1, seed=1)
    straight, parts = (policy.start_episode("press the button") for _ in range(2))
    together = {name: np.concatenate([video[name], now[name]]) for name in video}
    straight.observe(together, states(length + 1), is_demo=np.arange(length + 1) < length)
    for i in range(length):
        parts.observe({name: video[name][i : i + 1] for name in video}, states(1), is_demo=True)
    parts.observe(now, states(1))
    for episode in (straight, parts):
        assert episode.banks.count == saved
    torch.testing.assert_close(
        straight.banks.cognition.entries, parts.banks.cognition.entries, rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(policy.act(straight), policy.act(parts), atol=1e-4)


def test_a_video_that_comes_before_its_goal_is_read_with_the_goal(policy: MemoryVlaPolicy) -> None:
    """As over the MME-VLA protocol, where past frames come before the first prompt."""
    apart, together = policy.start_episode(""), policy.start_episode("press the button")
    video = frames(17)
    for episode in (apart, together):
        episode.add_frames(video[policy.embodiment.memory_camera], is_demo=True)
    apart.goal = "press the button"
    assert apart.banks.count == 2
    torch.testing.assert_close(apart.banks.cognition.entries, together.banks.cognition.entries)
    other = policy.start_episode("lift the cube")
    other.add_frames(video[policy.embodiment.memory_camera], is_demo=True)
    assert not torch.equal(other.banks.cognition.entries, apart.banks.cognition.entries)


def test_episodes_in_one_batch_act_as_alone_and_their_past_matters(policy: MemoryVlaPolicy) -> None:
    chunks = {}
    for batched in (True, False):
        pair = [policy.start_episode("press the button", seed=i) for i in range(2)]
        pair[0].observe(frames(1, seed=5), states(1))
        policy.act(pair[0])
        for episode in pair:
            episode.observe(frames(1), states(1))
        chunks[batched] = (
            policy.act(pair) if batched else np.stack([policy.act(episode) for episode in pair])
        )
    np.testing.assert_allclose(chunks[True], chunks[False], atol=1e-4)
    empty = policy.start_episode("press the button", seed=0)
    empty.observe(frames(1), states(1))
    empty.draw()
    assert np.abs(policy.act(empty) - chunks[True][0]).max() > 1e-3


@torch.no_grad()
def test_acting_over_a_stream_equals_a_group_of_its_moments(policy: MemoryVlaPolicy) -> None:
    processor = policy.require_processor()
    episode, images = policy.start_episode("press the button"), frames(3)
    for i in range(3):
        episode.observe({name: images[name][i : i + 1] for name in images}, states(1))
        chunk = policy.act(episode)
    ids, mask = processor.prompt("press the button")
    clip, valid = processor.resized(images["front"])[None], torch.ones(1, 3, dtype=torch.bool)
    group = GroupBatch(
        clip, ids.expand(1, 3, -1), mask.expand(1, 3, -1), torch.arange(3)[None], valid
    )
    last = policy.start_episode("press the button")
    draws = [last.draw() for _ in range(3)][-1]
    normalised = policy.sample_actions(group, {"noise": draws["noise"][None]})
    expected = processor.absolute_actions(normalised, torch.zeros(1, 8))[0].numpy()
    np.testing.assert_allclose(chunk, expected, atol=1e-4)


def test_a_prompt_ends_in_the_opening_piece_and_the_end_of_the_text(
    policy: MemoryVlaPolicy,
) -> None:
    processor = policy.require_processor()
    with pytest.warns(UserWarning, match="loses its end"):
        cut = processor.prompt("press " * 200)
    for ids, mask in (processor.prompt("press the button"), cut):
        assert ids[mask][-2:].tolist() == [processor.tokenizer.piece("▁"), processor.tokenizer.end]


def test_what_it_has_no_place_for_is_refused_in_words() -> None:
    with pytest.raises(UserError, match="group_size=1: MemoryVLA's banks"):
        build_policy("memoryvla", processor={"group_size": 1})
    with pytest.raises(UserError, match=r"group_size=.* must be a whole number, 1 or more"):
        build_policy("memoryvla", processor={"group_size": 0})
