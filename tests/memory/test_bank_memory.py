"""MemoryVLA's bank as a memory of other backbones: what it holds, and a policy that learns through
it.
"""

import pytest
import torch

from mme_vla.memory.extensions.bank import MemoryBank
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


MOMENTS = torch.tensor([[1.0, 0.0], [0.0, 1.0], [3.0, 4.0], [4.0, 3.0], [0.0, -1.0]])
# Cosines of neighbours are 0, 0.8, 0.96 and −0.6: (3, 4) and (4, 3) become (3.5, 3.5) when a fourth
# moment comes, and (0, 1) becomes one with that when the fifth comes.
ENTRIES = {
    "fifo": ([[3.0, 4.0], [4.0, 3.0], [0.0, -1.0]], [32, 48, 64]),
    "tome": ([[1.0, 0.0], [1.75, 2.25], [0.0, -1.0]], [0, 16, 64]),
}


@pytest.mark.parametrize("consolidation", ENTRIES)
def test_a_bank_holds_the_same_whether_it_is_filled_at_once_or_one_by_one(
    consolidation: str,
) -> None:
    bank = MemoryBank(2, length=3, time_code=False, consolidation=consolidation)
    moments, times = MOMENTS[None, :, None], torch.arange(0, 80, 16)[None]
    valid = torch.ones(1, 5, dtype=torch.bool)
    expected, expected_times = ENTRIES[consolidation]

    at_once = bank.replay(moments, times, valid)
    streamed = moments[:, :0], times[:, :0], valid[:, :0]
    for place in range(5):
        new = slice(place, place + 1)
        streamed = bank.replay(
            torch.cat([streamed[0], moments[:, new]], 1),
            torch.cat([streamed[1], times[:, new]], 1),
            torch.cat([streamed[2], valid[:, new]], 1),
        )
    padding = torch.tensor([[False]])
    padded = bank.replay(
        torch.cat([moments[:, :1], moments], 1),
        torch.cat([times[:, :1], times], 1),
        torch.cat([padding, valid], 1),
    )
    for entries, entry_times, is_entry in (at_once, streamed, padded):
        assert entries[0, :, 0].tolist() == expected
        assert entry_times[0].tolist() == expected_times and is_entry.all()
