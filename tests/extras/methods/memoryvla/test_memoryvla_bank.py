"""What a memory bank guarantees, and MemoryVLA's sizes at full scale."""

import pytest
import torch
from torch import Tensor

from mme_vla import UserError
from mme_vla.extras.methods.memoryvla.action_head import Dit, DitConfig, Schedule
from mme_vla.extras.methods.memoryvla.bank import BankState, EpisodeBank
from mme_vla.extras.methods.memoryvla.model import MemoryVlaConfig, MemoryVlaCore
from mme_vla.extras.methods.memoryvla.weights import memoryvla_table
from mme_vla.extras.methods.prismatic import Prismatic
from mme_vla.memory.extensions.bank import CONSOLIDATIONS


def moments(count: int, tokens: int = 3, width: int = 8, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, tokens, width, generator=generator), torch.arange(count) * 3


def one_by_one(bank: EpisodeBank, tokens: Tensor, times: Tensor) -> tuple[Tensor, BankState]:
    state, fused = bank.init_state(tokens.shape[1]), []
    for moment, time in zip(tokens, times.tolist(), strict=False):
        output = bank.read([state], moment[None])[0]
        state = bank.update(state, moment, output, time)
        fused.append(output)
    return torch.stack(fused), state


@torch.no_grad()
def test_of_equal_moments_the_first_two_become_one_and_of_none_the_earlier_time_stays() -> None:
    bank = EpisodeBank(8, length=4)
    tokens = moments(1)[0].repeat(5, 1, 1)
    _, state = one_by_one(bank, tokens, torch.tensor([2, 4, 6, 8, 10]))
    assert state.merged == 0 and state.times.tolist() == [2, 6, 8, 10]
    torch.testing.assert_close(state.entries, tokens[:4])


def test_what_is_stored_carries_no_gradient_and_what_is_read_does() -> None:
    bank = EpisodeBank(8, length=4)
    tokens, times = moments(2)
    tokens.requires_grad_()
    fused, (state,) = bank.run(tokens, times, [torch.arange(2)])
    assert not state.entries.requires_grad
    (gradient,) = torch.autograd.grad(fused[1].sum(), tokens)
    assert gradient[0].abs().sum() == 0 and gradient[1].abs().sum() > 0


@pytest.mark.parametrize("consolidation", CONSOLIDATIONS)
def test_entries_stored_at_once_equal_those_stored_one_by_one(consolidation: str) -> None:
    torch.manual_seed(0)
    bank = EpisodeBank(8, length=4, consolidation=consolidation)
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


@pytest.mark.parametrize(
    "options",
    [{"fusion": "gat"}, {"consolidation": "lifo"}, {"length": 0}, {"retrieval_layers": 0}],
)
def test_a_bank_that_cannot_be_is_refused(options: dict[str, object]) -> None:
    with pytest.raises(UserError, match=f"bank.{next(iter(options))}"):
        EpisodeBank(8, **options)  # type: ignore[arg-type]


def test_a_number_of_ddim_steps_that_no_stride_gives_is_refused() -> None:
    with pytest.raises(
        UserError, match=r"flow_steps=51: .* of 100 diffusion steps, so it samples in 1, 2, 3"
    ):
        Schedule.cosine(100).ddim_steps(51)


@torch.no_grad()
def test_a_fresh_head_does_not_hear_the_perceptual_tokens_until_it_is_reported_to() -> None:
    x, per = torch.randn(2, 5, 4), torch.randn(2, 6, 10)
    for how, reads_tokens in (("zero", False), ("xavier", True)):
        torch.manual_seed(0)
        head = Dit(
            DitConfig(16, 2, 2, how), action_dim=4, horizon=5, d_cognition=8, d_perceptual=10
        )
        torch.nn.init.normal_(head.output.weight)
        read = [
            head(x, torch.tensor([1, 2]), torch.ones(2, 1, 8), tokens) for tokens in (per, per + 1)
        ]
        assert torch.equal(*read) is not reads_tokens


def test_full_size_parameters_are_the_originals_to_the_number() -> None:
    config = MemoryVlaConfig()
    with torch.device("meta"):
        vlm = Prismatic(config.vision, config.vlm, config.vocab_size)
        width = config.vlm.width
        core = MemoryVlaCore(config, EpisodeBank(width), EpisodeBank(config.perceptual_width))
    parts = {
        "vision": (vlm.vision, 730_911_680),
        "projector": (vlm.projector, 71_385_600),
        "language": (vlm.language, 6_738_939_904),
        "compression": (core.compression, 1_278_496),
        "cognition": (core.cognition_bank, 423_735_296),
        "perceptual": (core.perceptual_bank, 1_661_696),
        "head": (core.head, 408_829_959),
    }
    for name, (module, count) in parts.items():
        assert sum(p.numel() for p in module.parameters()) == count, name
    names = [*(f"vlm.{name}" for name in vlm.state_dict()), *core.state_dict()]
    table = memoryvla_table(names)
    assert set(table) == set(names)
    paths = [piece.path for pieces in table.values() for piece in pieces]
    assert len(set(paths)) == len(paths) and "cog_mem_bank.gate_fusion_blocks.proj.weight" in paths
