"""How float32 is multiplied is said in one place, holds for recurrent memories alone, and leaves
PyTorch as it was.
"""

import pytest
import torch

from mme_vla import UserError
from mme_vla.config.devices import float32_products
from mme_vla.testing.small import random_batch, small_policy

SWITCH = torch.backends.cuda.matmul


def switches() -> tuple[object, ...]:
    backends = torch.backends
    return (
        SWITCH.fp32_precision,
        SWITCH.allow_tf32,
        torch.get_float32_matmul_precision(),
        backends.fp32_precision,
        backends.cudnn.allow_tf32,
    )


@pytest.mark.parametrize("before", ["highest", "high"])
@pytest.mark.parametrize("how", ["ieee", "tf32"])
def test_the_switch_is_set_inside_and_as_it_was_behind_it(how: str, before: str) -> None:
    torch.set_float32_matmul_precision(before)
    try:
        inside = switches()
        with float32_products(how):
            assert SWITCH.fp32_precision == how
        assert switches() == inside
        with pytest.raises(ZeroDivisionError), float32_products(how):
            _ = 1 / 0
        assert switches() == inside
    finally:
        torch.set_float32_matmul_precision("highest")


@pytest.mark.parametrize("model", ["ttt_modul", "rmt_context"])
@pytest.mark.parametrize("how", ["ieee", "tf32"])
def test_recurrent_layers_alone_see_it_the_recomputed_ones_too(
    model: str, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = small_policy(model, **{"+policy": {"float32_products": how}}).train()
    layer, inside, outside = policy.memory.layer, [], switches()
    advance = type(layer).advance

    def watched(*inputs, **named):
        inside.append(SWITCH.fp32_precision)
        return advance(layer, *inputs, **named)

    monkeypatch.setattr(layer, "advance", watched)
    precisions = []
    policy.backbone.vision.register_forward_hook(lambda *_: precisions.append(switches()))
    policy.memory.encoder.register_forward_hook(lambda *_: precisions.append(switches()))
    loss, _ = policy(random_batch(policy, 2))
    forward = len(inside)
    loss.backward()
    assert set(inside) == {how} and len(inside) == 2 * forward, (
        "every chunk once more for the backward pass"
    )
    assert set(precisions) == {outside} and switches() == outside


def test_an_unknown_way_is_refused() -> None:
    with pytest.raises(UserError, match=r"float32_products='tf23'.*Did you mean 'tf32'"):
        small_policy("ttt_modul", **{"+policy": {"float32_products": "tf23"}})


def test_members_of_a_joined_memory_are_reported() -> None:
    policy = small_policy("framesamp_ttt_modul", **{"+policy": {"float32_products": "tf32"}})
    _, recurrent = policy.memory.memories
    assert recurrent.float32_products == "tf32"
