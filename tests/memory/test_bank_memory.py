"""MemoryVLA's bank as a memory of other backbones: what it holds, and a policy that learns through
it.
"""

import pytest
import torch

from mme_vla.memory.extensions.bank import CONSOLIDATIONS, MemoryBank
from mme_vla.testing.check_memory import check_memory
from mme_vla.testing.small import random_batch, small_policy


def test_with_other_options_it_keeps_the_contract_of_memories() -> None:
    options = {"consolidation": "fifo", "fusion": "add", "time_code": False}
    check_memory("bank", grid=4, moments=8, video=4, length=2, **options)


@pytest.mark.parametrize("consolidation", CONSOLIDATIONS)
def test_entries_stored_at_once_equal_those_stored_one_by_one(consolidation: str) -> None:
    torch.manual_seed(0)
    bank = MemoryBank(8, length=4, consolidation=consolidation)
    moments, times, counts = torch.randn(3, 9, 2, 8), torch.arange(9).repeat(3, 1) * 3, [9, 6, 2]
    moments[0, 5] = moments[0, 4]  # alike, so that they are merged
    valid = torch.arange(9) >= 9 - torch.tensor(counts)[:, None]
    entries, at, there = bank.replay(moments, times, valid)
    for row, count in enumerate(counts):
        state = bank.init_state(2)
        for i in range(9 - count, 9):
            state = bank.update(state, moments[row, i], moments[row, i], int(times[row, i]))
        torch.testing.assert_close(entries[row, there[row]], state.entries)
        assert torch.equal(at[row, there[row]], state.times) and int(there[row].sum()) == min(
            count, 4
        )
        query = torch.randn(1, 2, 8)
        together = bank.retrieve_from(
            query, entries[row : row + 1], at[row : row + 1], there[row : row + 1]
        )
        torch.testing.assert_close(together, bank.retrieve([state], query))


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
