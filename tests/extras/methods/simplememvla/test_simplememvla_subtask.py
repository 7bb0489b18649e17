"""π0.5 with the sub-task channel: it trains, generates words, and its words decide
about actions.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.prior_vla_runs import UNTESTED, losses, run
from mme_vla import UserError, build_policy
from mme_vla.extras.methods.simplememvla.subtask import SubtaskBatch, SubtaskPolicy
from mme_vla.extras.trajectories.rollouts import join
from mme_vla.policy.base import Policy
from mme_vla.types import MemoryTokens


@pytest.mark.parametrize("integration", ["modulator", "context"])
def test_it_trains_two_updates_and_acts(integration: str, tmp_path: Path) -> None:
    words = [f"integration={integration}", "train.steps=2", "train.batch_size=2"]
    policy = Policy.from_pretrained(run("pi05_subtask", tmp_path / "run", *words, short=UNTESTED))
    assert np.isfinite(losses(tmp_path / "run")).all() and isinstance(policy, SubtaskPolicy)
    episode = policy.start_episode("pick up the cube", seed=1)
    image = np.zeros((1, 64, 64, 3), np.uint8)
    episode.observe({"front": image, "wrist": image}, np.full((1, 8), 0.1, np.float32))
    assert np.isfinite(policy.act(episode, 2)).all()


def test_the_hidden_states_of_words_decide_about_actions() -> None:
    policy: Any = build_policy("pi05_subtask")
    batch, noise = policy.full_batch(), {"noise": torch.zeros(1, policy.horizon, policy.action_dim)}
    with torch.no_grad():
        for parameter in policy.parameters():
            if not parameter.any():  # gates begin at zero
                parameter.normal_(std=0.5)
    tokens = policy.generate(batch)
    assert tokens.tokens.shape[:2] == batch.forced.shape
    other = MemoryTokens(tokens.tokens.flip(0, 1) + 1, tokens.mask)
    custom = policy.sample_actions(batch, noise, 2)
    assert torch.equal(custom, policy.sample_actions(batch, noise, 2, memory=tokens))
    assert not torch.allclose(custom, policy.sample_actions(batch, noise, 2, memory=other))


def test_sample_weights_weigh_the_words_too() -> None:
    policy: Any = build_policy("pi05_subtask", seed=0).eval()
    one = policy.full_batch()
    samples = [replace(one, words=torch.full_like(one.words, word)) for word in (1, 2)]
    noise = policy.training_noise(1, torch.Generator().manual_seed(0))
    losses = [policy(sample, noise)[1]["words"] for sample in samples]
    assert losses[0] != losses[1]
    rows = replace(join(samples), weight=torch.tensor([0.0, 3.0]))
    words, mask = (
        torch.cat([getattr(sample, name) for sample in samples]) for name in ("words", "words_mask")
    )
    both = SubtaskBatch(**vars(rows), words=words, words_mask=mask)
    noises = {name: torch.cat([value, value]) for name, value in noise.items()}
    assert torch.allclose(policy(both, noises)[1]["words"], 1.5 * losses[1])


def test_words_end_at_the_limit_or_before() -> None:
    decoder: Any = build_policy("pi05_subtask", policy={"subtask_words": 3}).subtask
    context = torch.randn(2, 5, decoder.context.in_features)
    ids, mask = decoder.generate(context, torch.ones(2, 5, dtype=torch.bool), end=1)
    assert ids.shape[1] <= 4 and ids[:, -1].eq(1).logical_or(~mask[:, -1]).all()


def test_a_sub_task_that_is_too_long_is_reported() -> None:
    policy: Any = build_policy("pi05_subtask", policy={"subtask_words": 3})
    with pytest.raises(UserError, match=r"11 words, more than policy\.subtask_words=3"):
        policy(policy.full_batch())


def test_a_memory_beside_the_words_is_refused() -> None:
    with pytest.raises(UserError, match="in a memory's place"):
        build_policy("pi05_subtask", memory="framesamp")
    with pytest.raises(UserError, match="in a memory's place"):
        build_policy("pi05_subtask", integration="none")
