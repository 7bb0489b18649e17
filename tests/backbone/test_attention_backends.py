"""Every backend of attention computes what the additive mask does, for every table of who may see
whom.
"""

from typing import Any

import pytest
import torch
from torch import Tensor

from helpers.visibility import TABLES, blocks_of, validity
from mme_vla import UserError
from mme_vla.backbone.layers import MaskLayout, Visibility, attend, build_mask, select_rows
from mme_vla.speed import sparse_attention
from mme_vla.testing.small import SMALL_VISION, random_batch, small_policy

OTHERS = ["flex", "varlen"]
pytestmark = pytest.mark.filterwarnings("ignore:flex_attention called without torch.compile")

FEW_TOKENS = {"vision": {**SMALL_VISION, "patch_size": 8}}


def inputs(table: Visibility, kv_heads: int) -> tuple[MaskLayout, list[Tensor]]:
    spans = blocks_of(table)
    n = sum(span.length for span in spans)
    generator = torch.Generator().manual_seed(0)
    sizes = [(3, n, heads, 16) for heads in (4, kv_heads, kv_heads)]
    return MaskLayout.of(spans, spans, validity(n), table), [
        torch.randn(size, generator=generator) for size in sizes
    ]


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
@pytest.mark.parametrize("backend", OTHERS)
@pytest.mark.parametrize("kv_heads", [1, 2])
def test_answers_and_gradients_are_those_of_the_mask(
    backend: str, table: Visibility, kv_heads: int
) -> None:
    layout, tensors = inputs(table, kv_heads)
    assert layout.visible.any(-1).all(), "every run should see a key here"

    def computed(name: str) -> list[Tensor]:
        learning = backend != "flex"  # which has no backward pass on a CPU
        leaves = [x.clone().requires_grad_(learning) for x in tensors]
        output = attend(*leaves, build_mask(layout, torch.float32, name, compiled=False))
        if learning:
            output.square().sum().backward()
        return [output.detach(), *(x.grad for x in leaves if x.grad is not None)]

    for actual, expected in zip(computed(backend), computed("sdpa"), strict=True):
        assert torch.allclose(actual, expected, atol=1e-4, rtol=1e-4)


def test_keys_of_no_sample_get_no_gradient_whatever_the_kernel_leaves_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def kernel(*arguments: Any) -> Tensor:
        """Flash attention writes no gradient for rows past the last start: NaN here, any number on
        a GPU.
        """
        for x in arguments[1:3]:
            is_invalid = (torch.arange(len(x)) >= arguments[4][-1])[:, None, None]
            x.register_hook(lambda gradient, mask=is_invalid: gradient.masked_fill(mask, torch.nan))
        return one_by_one(*arguments)

    one_by_one = sparse_attention._one_by_one
    monkeypatch.setattr(sparse_attention, "_one_by_one", kernel)
    layout, tensors = inputs(TABLES["memory"], 1)
    leaves = [x.requires_grad_() for x in tensors]
    attend(*leaves, build_mask(layout, torch.float32, "varlen", compiled=False)).sum().backward()
    assert not layout.visible.all()
    assert all(torch.isfinite(x.grad).all() for x in leaves if x.grad is not None)


@pytest.mark.parametrize("backend", OTHERS)
def test_queries_that_see_nothing_get_numbers(backend: str) -> None:
    layout, tensors = inputs(TABLES["memory"], 1)
    blind = MaskLayout(
        layout.lengths, layout.visible & (torch.arange(len(layout.lengths)) > 0)[:, None]
    )
    assert torch.isfinite(
        attend(*tensors, build_mask(blind, torch.float32, backend, compiled=False))
    ).all()


@pytest.mark.parametrize("backend", ["sdpa", *OTHERS])
def test_the_last_layer_reads_a_subset_of_the_queries(backend: str) -> None:
    layout, _ = inputs(TABLES["own"], 1)
    full, rows = (
        build_mask(layout, torch.float32, "sdpa", compiled=False),
        [slice(3, 5), slice(18, 22)],
    )
    assert isinstance(full, Tensor)
    selected = select_rows(
        build_mask(layout, torch.float32, backend, compiled=False), rows, torch.float32
    )
    assert torch.equal(selected, torch.cat([full[:, :, at] for at in rows], 2))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["pi05", "tokendrop_expert", "framesamp_modul"])
@pytest.mark.parametrize("backend", OTHERS)
def test_a_policy_gives_the_same_loss_and_the_same_chunk(model: str, backend: str) -> None:
    def results(attention: str) -> tuple[float, Tensor]:
        policy = small_policy(
            model,
            backbone=FEW_TOKENS,
            policy={"augment": False},
            **{"+policy.attention": attention},
        )
        batch = random_batch(policy, 2)
        draws = policy.training_noise(2, torch.Generator().manual_seed(1))
        with torch.no_grad():
            loss, _ = policy(batch, draws)
        return float(loss), policy.eval().sample_actions(batch, draws["noise"], steps=2)

    (loss, chunk), (expected, reference) = results(backend), results("sdpa")
    assert loss == pytest.approx(expected, rel=1e-5)
    assert torch.allclose(chunk, reference, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "words"),
    [("flecks", r"policy\.attention='flecks'.*flex"), ("cudnn", "auto, flex, sdpa, varlen")],
)
def test_a_backend_that_is_none_is_refused(name: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        small_policy("pi05", **{"+policy.attention": name})
