"""The memories beyond the paper on the small backbone that is trained from nothing on two cores."""

from typing import Any

import numpy as np
import pytest
import torch

from helpers.nano_policies import demonstration
from mme_vla import UserError, build_policy
from mme_vla.nano.learning import Decisions, statistics
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import BEYOND_MEMORIES

LITTLE: dict[str, dict[str, Any]] = {
    "retrieval": {"budget": 32, "grid": 2, "every": 8}, "moment": {"budget": 16, "grid": 2},
    "gist": {"budget": 48, "grid": 2}, "actions": {"max_steps": 32, "max_video": 16},
    "learned_topk": {"budget": 16, "grid": 2, "pool": 8},
}  # fmt: skip


def nano(model: str) -> MMEPolicy:
    words: dict[str, Any] = {"backbone": "nano", "embodiment": "robomme_waypoint_front", "policy": {"augment": False}}
    return build_policy(model, memory=LITTLE[model.rsplit("_", 1)[0]], **words)


@pytest.mark.parametrize("name", BEYOND_MEMORIES)
def test_it_trains_for_twenty_steps_on_what_a_demonstration_shows(name: str) -> None:
    policy = nano(f"{name}_modul")
    decisions = np.array([66, 120, 155])
    demo_frames = demonstration(tuple(np.union1d(decisions, policy.frames_read(decisions, 66)).tolist()))
    policy.require_processor().stats = statistics([demo_frames], policy)
    batch, generator, losses = Decisions.of(policy, [demo_frames]).batch, torch.Generator().manual_seed(0), []
    draws = policy.training_noise(len(batch.prompt), generator)
    optimizer = torch.optim.AdamW([p for p in policy.parameters() if p.requires_grad], lr=3e-3, fused=True)
    for _ in range(20):
        loss, _ = policy(batch, draws)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.5 * losses[0]


def test_where_blocks_have_no_rotary_place_learned_topk_says_so() -> None:
    with pytest.raises(UserError, match=r"memory_position=time.*has no place for blocks"):
        nano("learned_topk_context")
