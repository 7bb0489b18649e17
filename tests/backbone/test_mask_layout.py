"""Who may see whom, run by run: the visibility table for whatever a valid token asks, and no row
without a key.
"""

import math

import pytest
import torch
from torch import Tensor

from helpers.visibility import TABLES, blocks_of, validity
from mme_vla import UserError
from mme_vla.backbone import gemma, layers
from mme_vla.backbone.layers import (
    ALIGNMENT,
    BIG_NEGATIVE,
    PI05_VISIBILITY,
    MaskLayout,
    Span,
    Visibility,
    attention_mask,
    layout_mask,
)
from mme_vla.integration.base import MEMORY_VISIBILITY
from mme_vla.testing.small import random_batch, small_policy


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_what_a_valid_token_sees_is_what_the_table_says(table: Visibility) -> None:
    spans = blocks_of(table)
    valid = validity(sum(span.length for span in spans))
    rows = []
    for query in spans:
        sees = [torch.full((key.length,), key.name in table[query.name]) for key in spans]
        rows.append(torch.cat(sees).expand(query.length, -1))
    expected = torch.cat(rows) & valid[:, :, None] & valid[:, None, :]
    assert torch.equal(attention_mask(spans, spans, valid, valid, table), expected)
    layout = MaskLayout.of(spans, spans, valid, table)
    assert sum(layout.lengths) == valid.shape[1] and len(layout.lengths) <= len(spans)


def test_a_subset_of_the_queries_has_the_mask_rows_of_all_queries() -> None:
    spans = blocks_of(MEMORY_VISIBILITY)
    layout = MaskLayout.of(spans, spans, validity(22), MEMORY_VISIBILITY)
    rows = [slice(2, 4), slice(11, 22)]
    part = layout.part(rows)
    full = layout.expand(layout.visible)
    assert torch.equal(part.expand(part.visible), torch.cat([full[:, at] for at in rows], 1))


def test_a_block_without_a_row_is_named() -> None:
    with pytest.raises(UserError, match="No row of the visibility table belongs to sounds"):
        MaskLayout.of(
            [Span("sounds", 2)],
            [Span("images", 2)],
            torch.ones(1, 2, dtype=torch.bool),
            PI05_VISIBILITY,
        )


def test_the_number_behind_hidden_keys_survives_kernels_that_count_in_base_two() -> None:
    least = torch.tensor(BIG_NEGATIVE, dtype=torch.float32) * torch.tensor(
        math.log2(math.e), dtype=torch.float32
    )
    assert torch.isfinite(least)
    assert torch.tensor(1e4) + BIG_NEGATIVE == BIG_NEGATIVE, "a logit must vanish beside it"


@pytest.mark.parametrize("keys", [5, 16, 596])
def test_rows_of_a_mask_lie_where_fused_kernels_want_them(keys: int) -> None:
    layout = MaskLayout((3, 2), torch.ones(2, 2, keys, dtype=torch.bool))
    for mask in (
        layout_mask(layout, torch.bfloat16),
        layout_mask(MaskLayout((5,), layout.visible[:, :1]), torch.bfloat16),
    ):
        assert mask.shape == (2, 1, 5, keys) and mask.stride(-1) == 1
        assert all(stride % ALIGNMENT == 0 for stride in mask.stride()[2:-1])


@pytest.mark.parametrize(
    "model", ["pi05", "tokendrop_expert", "framesamp_context", "tokendrop_modul", "rmt_context"]
)
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
        gradients = {
            name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None
        }
        return (
            loss.detach(),
            gradients,
            policy.eval().sample_actions(batch, draws["noise"], steps=2),
        )

    now = results()
    layout_of = MaskLayout.of

    def as_it_was(
        spans: list[Span], keys: list[Span], valid: Tensor, table: Visibility
    ) -> MaskLayout:
        asking = valid[:, -sum(span.length for span in spans) :]
        layout = layout_of(spans, keys, valid, table)
        rows = layout.expand(layout.visible) & asking[:, :, None]
        return MaskLayout((1,) * asking.shape[1], rows)

    monkeypatch.setattr(gemma.MaskLayout, "of", as_it_was)
    monkeypatch.setattr(layers, "BIG_NEGATIVE", -2.3819763e38)
    before = results()
    assert torch.equal(now[0], before[0]) and torch.equal(now[2], before[2])
    assert now[1].keys() == before[1].keys()
    assert all(torch.equal(now[1][name], before[1][name]) for name in now[1])
