"""MemoryVLA's bank as a memory of other backbones: what it holds, and a policy that learns through
it.
"""

import torch

from mme_vla.testing.check_memory import check_memory
from mme_vla.testing.small import random_batch, small_policy


def test_with_other_options_it_keeps_the_contract_of_memories() -> None:
    options = {"consolidation": "fifo", "fusion": "add", "time_code": False}
    check_memory("bank", grid=4, moments=8, video=4, length=2, **options)


def test_bank_modul_answers_by_what_it_remembers() -> None:
    policy = small_policy("bank_modul")
    batch = random_batch(policy, 2, valid=6 * 64)
    assert batch.history is not None
    noise = {"noise": torch.randn(2, policy.horizon, policy.action_dim)}
    chunk = policy.sample_actions(batch, noise, 2)
    batch.history.features[:, :64] += 1.0  # the oldest moment
    assert not torch.equal(policy.sample_actions(batch, noise, 2), chunk)
    loss, _ = policy(batch)
    loss.backward()
    learned = {
        name
        for name, p in policy.memory.named_parameters()
        if p.grad is not None and p.grad.abs().sum() > 0
    }
    assert {
        "reduce.weight",
        "output.weight",
        "bank.gate.weight",
        "bank.blocks.0.value.weight",
    } <= learned
