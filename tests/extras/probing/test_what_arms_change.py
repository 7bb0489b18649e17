"""What each arm does to the tokens that a memory reads, in numbers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from mme_vla.extras.probing.arms import UNPROBED, read_arm
from mme_vla.extras.probing.channels import MemorySnapshot
from mme_vla.extras.probing.probed import ProbedEpisode, ProbedPolicy
from mme_vla.memory.base import stack_history
from mme_vla.memory.joined import JoinedMemory
from mme_vla.testing.small import small_policy
from mme_vla.types import HistoryTokens

LENGTH, VIDEO = 120, 30


def observed(
    name: str, seed: int = 0, first_moving: int = 0, **options: Any
) -> tuple[ProbedPolicy, ProbedEpisode]:
    """A policy and an episode that it has observed, with states of 0 until `first_moving`."""
    rng = np.random.default_rng(seed)
    probe = ProbedPolicy(small_policy(name, **options).eval(), UNPROBED)
    episode = probe.start_episode("pick up the cube")
    frames = rng.integers(0, 255, (LENGTH, 64, 64, 3), dtype=np.uint8)
    states = rng.standard_normal((LENGTH, 8)).astype(np.float32)
    states[:first_moving] = 0
    views = {"front": frames, "wrist": frames}
    episode.observe(views, states, is_demo=np.arange(LENGTH) < VIDEO)
    return probe, episode


def under(
    word: str, probe: ProbedPolicy, episode: ProbedEpisode, donor: Any = None
) -> HistoryTokens:
    """What the memory reads under an arm."""
    arm = read_arm(word)
    snapshot: MemorySnapshot = probe.channel.read(episode.inner)
    moment = replace(probe.moment(episode), donor=lambda name: donor)
    stores = [arm.edit(store, moment) for store in snapshot.stores]
    remembered: HistoryTokens = probe.channel.counterfactual(episode.inner, snapshot, stores)
    return remembered


def test_past_states_change_places_and_are_taken_from_another_episode() -> None:
    """Those of `spacetime`, which reads states beside its past images."""
    probe, episode = observed("spacetime_context")
    unprobed = under("noise:0", probe, episode).features
    shuffled = under("shuffle", probe, episode).features
    assert not torch.equal(shuffled, unprobed)
    assert torch.equal(shuffled.sort(0).values, unprobed.sort(0).values)
    other, donor = observed("spacetime_context", seed=1)
    donor_store = other.channel.read(donor.inner).stores[0]
    swapped = under("swap", probe, episode, donor_store).features
    assert torch.equal(swapped, under("noise:0", other, donor).features)
    assert not torch.equal(under("noise:0.5", probe, episode).features, unprobed)


@pytest.mark.parametrize("name", ["framesamp_modul", "spacetime_context", "actions_modul"])
def test_a_clock_that_runs_ahead_moves_all_times_and_leaves_ages(name: str) -> None:
    probe, episode = observed(name)
    unprobed, late = under("noise:0", probe, episode), under("delay:64", probe, episode)
    assert torch.equal(
        late.positions[late.mask][:, 0], unprobed.positions[unprobed.mask][:, 0] + 64
    )
    assert late.ages is not None and unprobed.ages is not None
    assert torch.equal(late.ages, unprobed.ages)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("gist_modul", {}),
        ("bank_modul", {"memory": {"length": 3}}),
        ("keyframes_modul", {"memory": {"budget": 64}}),
        ("gist_modul", {"memory": ["gist", "actions"]}),
    ],
    ids=["gist", "bank", "keyframes", "joined"],
)
@torch.no_grad()
def test_a_frame_that_is_removed_leaves_what_the_memory_makes_of_the_others(
    name: str, options: dict[str, Any]
) -> None:
    """Encoders that read several frames together count on padding at one end."""
    probe, episode = observed(name, **options)
    module = probe.inner.require_memory()
    snapshot = probe.channel.read(episode.inner)
    (store,) = snapshot.stores
    slot = len(store) - 2
    removed = store.entries[slot]
    assert removed is not None
    changed = probe.channel.counterfactual(episode.inner, snapshot, [store.without([slot])])
    members = module.memories if isinstance(module, JoinedMemory) else []
    for one in (module, *members):

        def others(history: Any, step: int, rng: Any = None, choose: Any = one.select) -> Any:
            indices = choose(history, step, rng)
            return indices[indices[:, 0] != removed.time]

        one.select = others  # type: ignore[method-assign]
    expected = module.gather_selection(episode.inner.required_history(), LENGTH - 1)
    met, without = module(stack_history([changed])), module(stack_history([expected]))
    assert torch.equal(met.mask, without.mask)
    error = (met.tokens - without.tokens)[met.mask].abs().max()
    assert error < 1e-5 * max(1.0, float(without.tokens[met.mask].abs().max()))


@torch.no_grad()
def test_keyframes_remember_nothing_where_everything_is_removed() -> None:
    probe, episode = observed("keyframes_modul")
    nothing = under("drop:all", probe, episode)
    assert not probe.inner.require_memory()(stack_history([nothing])).mask.any()


def test_frames_of_states_alone_hold_the_tokens_of_the_frame_before_them() -> None:
    """A joined memory of sparse images and dense states has entries without tokens."""
    probe, episode = observed("ttt_modul", memory=["tokendrop", {"name": "actions", "stride": 4}])
    unprobed, shuffled = under("noise:0", probe, episode), under("shuffle", probe, episode)
    assert torch.equal(shuffled.mask, unprobed.mask)
    assert torch.equal(shuffled.positions, unprobed.positions)
    assert not torch.equal(shuffled.features, unprobed.features)


def test_noise_on_states_is_in_standard_deviations_of_all_that_is_read() -> None:
    """As in training, not of each frame by itself: a frame of zeros gets some too."""
    probe, episode = observed("actions_modul", first_moving=LENGTH // 2)
    unprobed, noisy = under("noise:0", probe, episode), under("noise:1", probe, episode)
    rows = unprobed.features[unprobed.mask][:, :17]
    noise = noisy.features[noisy.mask][:, :17] - rows
    assert rows[0].abs().max() < 1e-5
    assert torch.allclose(noise[0].std(), rows.std(), rtol=0.5)
