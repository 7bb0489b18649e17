"""Where memory tokens stand for rotary attention: by slot, as released, or by time, which a
selection cannot shift.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from mme_vla import UserError, build_policy
from mme_vla.backbone.layers import apply_custom_positions, rotary_positions
from mme_vla.memory.base import stack_history
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing import check_integration
from mme_vla.testing.small import cached_history, moving_frames, random_batch, small_policy
from mme_vla.types import HistoryTokens

GRID, FRAMES, OLD = 4, 6, 16
"""Tokens a side, frames in memory, and where the tokens of the frame that is dropped begin."""


def composed(integration: str, position: str) -> MMEPolicy:
    policy = small_policy(
        f"framesamp_{integration}",
        memory={"budget": 128},
        integration={"memory_position": position},
    )
    with torch.no_grad():  # the modulator starts near the identity
        for parameter in policy.integration.parameters():
            parameter.add_(
                0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
            )
    return policy.eval()


def without(history: HistoryTokens, first: int, count: int) -> HistoryTokens:
    """The same selection as if one frame had not been remembered: the later tokens move up, padding
    follows.
    """

    def shifted(x: Tensor) -> Tensor:
        others = torch.cat([x[:, :first], x[:, first + count :]], 1)
        return torch.cat([others, torch.zeros_like(x[:, :count])], 1)

    mask = shifted(history.mask)
    return replace(
        history, features=shifted(history.features), positions=shifted(history.positions), mask=mask
    )


def remembered(policy: MMEPolicy) -> HistoryTokens:
    frames = moving_frames(FRAMES)
    return stack_history(
        [policy.require_memory().gather_selection(cached_history(policy, frames), FRAMES - 1)] * 2
    )


@pytest.mark.parametrize(("position", "shifts"), [("slot", True), ("time", False)])
@pytest.mark.parametrize("integration", ["context", "expert"])
def test_a_dropped_frame_shifts_the_distance_the_older_ones_stand_from_the_view_only_by_slot(
    integration: str, position: str, shifts: bool
) -> None:
    policy = composed(integration, position)
    history, views = remembered(policy), random_batch(policy, valid=16)

    def distance(selection: HistoryTokens) -> float:
        """From the first memory token to the first token of the current view."""
        memory = policy.memory(selection)
        assert memory is not None
        observed = policy.backbone.embed(replace(views, images=views.images.float()))
        blocks = policy.integration.blocks(observed, memory)
        positions = apply_custom_positions(
            rotary_positions(torch.cat([block.mask for block in blocks], 1)), blocks
        )
        return float(positions[0, len(blocks[0])] - positions[0, 0])

    dropped = without(history, 2 * OLD, OLD)
    assert (distance(history) != distance(dropped)) == shifts
    if position == "time":
        # frame 0 is five frames ago, and the view stands one place further
        assert distance(history) == FRAMES


@pytest.mark.parametrize(("position", "shifts"), [("slot", True), ("time", False)])
def test_a_frame_that_is_not_there_moves_the_remainder_of_what_the_modulator_reads_only_by_slot(
    position: str, shifts: bool
) -> None:
    policy = composed("modul", position)
    memory = policy.memory(remembered(policy))
    fewer = policy.memory(without(remembered(policy), OLD, OLD))
    assert memory is not None and fewer is not None
    hidden = replace(memory, mask=memory.mask.clone())
    hidden.mask[:, OLD : 2 * OLD] = (
        False  # still in its slots, but unseen: the same tokens are read
    )
    x = torch.randn(
        2, 5, policy.integration.memory_width, generator=torch.Generator().manual_seed(0)
    )
    read = [policy.integration.hook(tokens)(0, x) for tokens in (hidden, fewer)]  # type: ignore[misc]
    assert bool((read[0] - read[1]).abs().max() > 1e-3) == shifts


@pytest.mark.parametrize("integration", ["context", "modul", "expert"])
def test_time_is_counted_back_from_now(integration: str) -> None:
    """The same moments, remembered at the same distance in a later part of an episode, are read
    alike.
    """
    policy = composed(integration, "time")
    batch = random_batch(policy, valid=32)
    assert batch.history is not None and batch.history.step is not None
    memory = policy.model.memory_tokens(batch)
    assert memory is not None and memory.ages is not None
    later = replace(
        batch.history, positions=batch.history.positions.clone(), step=batch.history.step + 700
    )
    later.positions[..., 0] += 700
    assert torch.equal(later.ages, memory.ages)  # type: ignore[arg-type]
    older = replace(memory, ages=memory.ages * 3)
    noise = torch.randn(
        2, policy.horizon, policy.action_dim, generator=torch.Generator().manual_seed(3)
    )
    chunks = [policy.sample_actions(batch, noise, memory=tokens) for tokens in (memory, older)]
    assert (chunks[0] - chunks[1]).abs().max() > 1e-6


@pytest.mark.parametrize("integration", ["context", "modulator", "expert"])
def test_by_time_an_integration_keeps_an_integrations_contract(integration: str) -> None:
    check_integration(integration, memory_position="time")


def test_an_episode_and_a_cache_place_memory_alike() -> None:
    policy = small_policy(
        "framesamp_modul", memory={"budget": 64}, integration={"memory_position": "time"}
    )
    episode, frames = policy.start_episode("press the button"), moving_frames(9)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((9, 8), np.float32))
    recalled = [
        episode.gather_selection(),
        policy.require_memory().gather_selection(cached_history(policy, frames), 8),
    ]
    assert [item.step.item() for item in recalled if item.step is not None] == [8, 8]
    ages = [stack_history([item]).ages for item in recalled]
    assert ages[0] is not None and ages[0].max() == 8 and torch.equal(ages[0], ages[1])  # type: ignore[arg-type]


def test_what_has_no_time_or_no_place_for_it_is_refused() -> None:
    with pytest.raises(UserError, match=r"memory_position=time.*'rmt'"):
        build_policy("rmt_modul", integration={"memory_position": "time"}, device="meta")
    with pytest.raises(UserError, match=r"'nano' has no place for blocks"):
        build_policy(
            "framesamp_context",
            backbone="nano",
            integration={"memory_position": "time"},
            device="meta",
        )
    with pytest.raises(UserError, match="Did you mean 'time'"):
        build_policy("framesamp_modul", integration={"memory_position": "tme"}, device="meta")


def test_tokens_that_do_not_tell_their_age_are_not_taken_for_new_ones() -> None:
    policy = composed("modul", "time")
    batch = random_batch(policy, valid=16)
    batch.history = replace(batch.history, step=None)  # type: ignore[type-var]
    with pytest.raises(ValueError, match="ages"):
        policy(batch)
