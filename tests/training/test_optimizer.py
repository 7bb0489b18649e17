"""The optimizer reproduces the released recipe."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from mme_vla.errors import UserError
from mme_vla.testing.small import small_policy
from mme_vla.training.optim import EMA, clip_gradients, learning_rate, make_optimizer
from mme_vla.training.order import BatchOrder, generator_for, seed_of
from mme_vla.training.settings import TrainSettings


def test_learning_rate_follows_the_released_schedule(parity: Path) -> None:
    golden = json.loads((parity / "unit_optimizer.json").read_text())["lr_schedule"]
    for step, rate in golden.items():
        # The released schedule runs in float32 and cancels at its first steps: 4e-8 of the peak.
        assert learning_rate(int(step), 5e-5, 10_000) == pytest.approx(
            rate, rel=2e-6, abs=5e-5 * 1e-7
        )


def test_updates_and_averages_equal_the_released_ones(parity: Path) -> None:
    golden = load_file(parity / "unit_optimizer.safetensors")
    names = [key.removeprefix("out/step0/") for key in golden if key.startswith("out/step0/")]
    module = nn.ParameterDict({name: nn.Parameter(golden[f"in/{name}"].clone()) for name in names})
    optimizer = make_optimizer(module.parameters(), TrainSettings(steps=5, batch_size=1, lr=1e-2))
    ema = EMA(dict(module.items()), 0.999)
    for step in range(5):
        for name in names:
            module[name].grad = golden[f"in/grad{step}/{name}"].clone()
        clip_gradients([p.grad for p in module.parameters() if p.grad is not None], 1.0)
        optimizer.param_groups[0]["lr"] = learning_rate(step, 1e-2, 3)
        optimizer.step()
        ema.update()
        for name in names:
            torch.testing.assert_close(
                module[name].data, golden[f"out/step{step}/{name}"], rtol=2e-6, atol=1e-7
            )
            torch.testing.assert_close(
                ema.tensors()[name], golden[f"out/ema{step}/{name}"], rtol=2e-6, atol=1e-7
            )


def test_gradients_below_the_norm_stay_as_they_are() -> None:
    small, zero = [torch.tensor([0.3, 0.4])], [torch.zeros(2)]
    assert clip_gradients(small, 1.0).item() == pytest.approx(0.5)
    clip_gradients(zero, 1.0)
    assert small[0].tolist() == pytest.approx([0.3, 0.4])
    assert zero[0].tolist() == [0, 0]


def test_average_is_exchanged_in_and_out() -> None:
    module = nn.Linear(1, 1, bias=False)
    initial = module.weight.item()
    ema = EMA(dict(module.named_parameters()), 0.5)
    with torch.no_grad():
        module.weight.add_(2.0)
    ema.update()
    with ema.applied():
        assert module.weight.item() == pytest.approx(initial + 1)
    assert module.weight.item() == pytest.approx(initial + 2)


def test_every_epoch_sees_each_sample_once_in_a_new_order() -> None:
    order = BatchOrder(12, 4, seed=0, steps=range(6))
    batches = [order.batch(step) for step in range(6)]
    first, second = ([i for batch in epoch for i in batch] for epoch in (batches[:3], batches[3:]))
    assert sorted(first) == sorted(second) == list(range(12))
    assert first != second
    assert [BatchOrder(12, 4, 0, range(5, 6)).batch(5)] == batches[5:]


def test_pieces_and_processes_share_out_the_same_batch() -> None:
    full = list(BatchOrder(16, 8, 0, range(2)))
    shares = [
        list(BatchOrder(16, 8, 0, range(2), accumulate=2, process=p, processes=2)) for p in range(2)
    ]
    assert [shares[0][0] + shares[1][0] + shares[0][1] + shares[1][1]] == full[:1]


def test_impossible_batches_are_refused() -> None:
    with pytest.raises(UserError, match="3 samples"):
        BatchOrder(3, 4, 0, range(1))
    with pytest.raises(UserError, match="3 processes"):
        BatchOrder(30, 4, 0, range(1), processes=3)


def test_what_a_loss_draws_depends_on_the_key_alone() -> None:
    policy = small_policy("pi05")
    first = policy.training_noise(4, generator_for(1, "train", 7))
    torch.manual_seed(123)
    again = policy.training_noise(4, generator_for(1, "train", 7))
    assert {name: len(value) for name, value in first.items()} == {"noise": 4, "time": 4}
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert seed_of(1, "train", 7) != seed_of(1, "train", 8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps=0"),
        ({"batch_size": 9, "accumulate": 2}, "multiple of train.accumulate=2"),
        ({"ema": 1.0}, "ema=1.0"),
        ({"lrr": 1}, "Did you mean 'lr'"),
        ({"keep": {"last": 0}}, "last=0"),
    ],
)
def test_impossible_settings_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        TrainSettings.from_dict({"steps": 1, "batch_size": 8, "lr": 1e-3, **change})
