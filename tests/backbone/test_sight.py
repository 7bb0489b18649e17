"""Who may see whom, run by run: the visibility table for whatever a valid token asks, and no row without a key."""

import math
from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from mme_vla import UserError
from mme_vla.backbone import attention, gemma
from mme_vla.backbone.attention import (
    ALIGNMENT,
    BIG_NEGATIVE,
    PI05_VISIBILITY,
    MaskLayout,
    Span,
    Visibility,
    attention_mask,
    layout_mask,
)
from mme_vla.integration.base import MEMORY_VISIBILITY, memory_visibility
from mme_vla.testing.small import random_batch, small_policy

OWN: Visibility = {
    "memory": {"memory", "images"}, "images": {"prompt"}, "prompt": {"memory", "action"},
    "action": {"memory", "images", "prompt", "action"},
}  # fmt: skip
TABLES: Mapping[str, Visibility] = {
    "pi05": PI05_VISIBILITY,
    "memory": MEMORY_VISIBILITY,
    "paper": memory_visibility(prompt_sees_memory=False),
    "own": OWN,
}


def blocks_of(table: Visibility) -> list[Span]:
    return [Span(name, length) for name, length in zip(table, (5, 7, 6, 4), strict=False)]


def validity(n: int, seed: int = 0) -> Tensor:
    return torch.rand(3, n, generator=torch.Generator().manual_seed(seed)) < 0.7


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_what_a_valid_token_sees_is_what_the_table_says(table: Visibility) -> None:
    spans = blocks_of(table)
    valid = validity(sum(span.length for span in spans))
    expected = attention_mask(spans, spans, valid, valid, table)
    sight = MaskLayout.of(spans, spans, valid, table)
    assert torch.equal(sight.expand(sight.visible) & valid[:, :, None], expected)
    assert sum(sight.lengths) == valid.shape[1] and len(sight.lengths) <= len(spans)


def test_neighbours_that_see_the_same_are_one_run() -> None:
    spans = blocks_of(PI05_VISIBILITY)
    assert MaskLayout.of(spans, spans, validity(18), PI05_VISIBILITY).lengths == (12, 6)


def test_a_part_of_the_queries_sees_what_it_saw_in_the_whole() -> None:
    spans = blocks_of(MEMORY_VISIBILITY)
    sight = MaskLayout.of(spans, spans, validity(22), MEMORY_VISIBILITY)
    rows = [slice(2, 4), slice(11, 22)]
    part = sight.part(rows)
    whole = sight.expand(sight.visible)
    assert torch.equal(part.expand(part.visible), torch.cat([whole[:, at] for at in rows], 1))


def test_a_block_without_a_row_is_named() -> None:
    with pytest.raises(UserError, match="'sounds' has no row"):
        MaskLayout.of([Span("sounds", 2)], [Span("images", 2)], torch.ones(1, 2, dtype=torch.bool), PI05_VISIBILITY)


def test_the_number_behind_hidden_keys_survives_kernels_that_count_in_base_two() -> None:
    least = torch.tensor(BIG_NEGATIVE, dtype=torch.float32) * torch.tensor(math.log2(math.e), dtype=torch.float32)
    assert torch.isfinite(least)
    assert torch.tensor(1e4) + BIG_NEGATIVE == BIG_NEGATIVE, "a logit must vanish beside it"


@pytest.mark.parametrize("keys", [5, 16, 596])
def test_rows_of_a_mask_lie_where_fused_kernels_want_them(keys: int) -> None:
    sight = MaskLayout((3, 2), torch.ones(2, 2, keys, dtype=torch.bool))
    for mask in (
        layout_mask(sight, torch.bfloat16),
        layout_mask(MaskLayout((5,), sight.visible[:, :1]), torch.bfloat16),
    ):
        assert mask.shape == (2, 1, 5, keys) and mask.stride(-1) == 1
        assert all(stride % ALIGNMENT == 0 for stride in mask.stride()[2:-1])


@pytest.mark.parametrize("model", ["pi05", "tokendrop_expert", "framesamp_context", "tokendrop_modul", "rmt_context"])
def test_what_padding_asks_changes_no_loss_no_gradient_and_no_chunk(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Padding used to see nothing at all, which fused kernels on a GPU turn into zeros or NaN."""
    policy = small_policy(model, policy={"augment": False})
    batch = random_batch(policy, 3)
    batch.image_mask[2, 1] = False
    draws = policy.training_noise(3, torch.Generator().manual_seed(1))

    def results() -> tuple[Tensor, dict[str, Tensor], Tensor]:
        policy.zero_grad()
        policy.train()
        loss, _ = policy(batch, draws)
        loss.backward()
        gradients = {name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None}
        return loss.detach(), gradients, policy.eval().sample_actions(batch, draws["noise"], steps=2)

    now = results()

    def as_it_was(spans: list[Span], keys: list[Span], valid: Tensor, table: Visibility) -> MaskLayout:
        asking = valid[:, -sum(span.length for span in spans) :]
        return MaskLayout((1,) * asking.shape[1], attention_mask(spans, keys, asking, valid, table))

    monkeypatch.setattr(gemma.MaskLayout, "of", as_it_was)
    monkeypatch.setattr(attention, "BIG_NEGATIVE", -2.3819763e38)
    before = results()
    assert torch.equal(now[0], before[0]) and torch.equal(now[2], before[2])
    assert now[1].keys() == before[1].keys()
    assert all(torch.equal(now[1][name], before[1][name]) for name in now[1])
