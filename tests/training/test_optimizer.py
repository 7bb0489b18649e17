"""The optimizer reproduces the released recipe."""

import json
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.errors import UserError
from mme_vla.speed.compiler import missing_compiler
from mme_vla.testing.small import small_policy
from mme_vla.training.optim import (
    EMA,
    WeightUpdate,
    clip_gradients,
    lr_factors,
    make_optimizer,
    scheduled_rate,
)
from mme_vla.training.order import BatchOrder, generator_for, seed_of
from mme_vla.training.settings import TrainSettings


def test_learning_rate_follows_the_released_schedule(parity: Path) -> None:
    golden = json.loads((parity / "unit_optimizer.json").read_text())["lr_schedule"]
    released = TrainSettings(steps=80_000, batch_size=64, lr=5e-5, warmup=10_000)
    for step, rate in golden.items():
        # The released schedule runs in float32 and cancels at its first steps: 4e-8 of the peak.
        assert scheduled_rate(int(step), released) == pytest.approx(rate, rel=2e-6, abs=5e-5 * 1e-7)


def test_components_learn_at_their_share_of_the_rate() -> None:
    settings = TrainSettings.from_dict(
        {"steps": 1, "batch_size": 1, "lr": 1e-3, "part_lr": {"vlm": 0.5}}
    )
    spec = small_policy("pi05").finetune_spec
    names = [name for name, _ in small_policy("pi05").named_parameters()]
    shares = lr_factors(names, spec, settings)
    assert set(shares) == {1.0, 0.5}
    for name, share in zip(names, shares, strict=True):
        assert share == (0.5 if spec.component_of(name) == "vlm" else 1.0), name
    without = TrainSettings.from_dict({"steps": 1, "batch_size": 1, "lr": 1e-3, "part_lr": None})
    assert set(lr_factors(names, spec, without)) == {1.0}


def test_a_rate_of_a_part_that_does_not_learn_is_reported() -> None:
    settings = TrainSettings(steps=1, batch_size=1, lr=1.0, part_lr={"vlm": 0.5, "vision": 0.1})
    with pytest.warns(UserWarning, match=r"train\.part_lr\.vision has no effect"):
        shares = lr_factors(
            ["embedding.weight", "action_in.weight"], Pi05Backbone.finetune_spec, settings
        )
    assert shares == [0.5, 1.0]


def test_updates_and_averages_equal_the_released_ones(parity: Path) -> None:
    golden = load_file(parity / "unit_optimizer.safetensors")
    names = [key.removeprefix("out/step0/") for key in golden if key.startswith("out/step0/")]
    module = nn.ParameterDict({name: nn.Parameter(golden[f"in/{name}"].clone()) for name in names})
    settings = TrainSettings(steps=5, batch_size=1, lr=1e-2, warmup=3)
    optimizer = make_optimizer(module.parameters(), settings)
    ema = EMA(dict(module.items()), 0.999)
    for step in range(5):
        for name in names:
            module[name].grad = golden[f"in/grad{step}/{name}"].clone()
        clip_gradients([p.grad for p in module.parameters() if p.grad is not None], 1.0)
        optimizer.param_groups[0]["lr"] = scheduled_rate(step, settings)
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


class SmallTraining:
    """Weights of several shapes, of which some do not decay, and what updates them."""

    def __init__(self, one_pass: bool) -> None:
        generator = torch.Generator().manual_seed(0)
        self.weights = nn.ParameterDict()
        for i, shape in enumerate([(7, 5), (33,), (1,), (16, 8)]):
            self.weights[str(i)] = nn.Parameter(torch.randn(shape, generator=generator))
        parameters = dict(self.weights.items())
        settings = TrainSettings(steps=1, batch_size=1, lr=1e-2, decay_min_dim=2, weight_decay=0.1)
        self.optimizer = make_optimizer(parameters.values(), settings)
        self.ema = EMA(parameters, 0.99, warmup=True)
        self.update = WeightUpdate(parameters, self.optimizer, self.ema, 1.0, one_pass)

    def step(self, done: int) -> float:
        """An update with gradients below the norm and above it in turn."""
        generator = torch.Generator().manual_seed(done)
        scale = 10.0 if done % 2 else 0.01
        for parameter in self.weights.values():
            parameter.grad = scale * torch.randn(parameter.shape, generator=generator)
        for group in self.optimizer.param_groups:
            group["lr"] = 1e-2 / (done + 1)
        return float(self.update(done))

    def numbers(self) -> list[Tensor]:
        moments = [value for state in self.optimizer.state.values() for value in state.values()]
        return [*self.weights.values(), *self.ema.tensors().values(), *moments]


@pytest.mark.slow
@pytest.mark.skipif(missing_compiler(torch.device("cpu")) is not None, reason="needs a compiler")
def test_one_pass_equals_clipping_optimizer_and_average_within_rounding() -> None:
    torch.compiler.reset()
    passes, one_pass = SmallTraining(False), SmallTraining(True)
    for done in range(4):
        assert passes.step(done) == one_pass.step(done)
        assert all(p.grad is None for p in one_pass.weights.values())
        for expected, value in zip(passes.numbers(), one_pass.numbers(), strict=True):
            torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6)
    # From a checkpoint it continues to the last bit.
    resumed = SmallTraining(True)
    resumed.weights.load_state_dict(one_pass.weights.state_dict())
    resumed.ema.load(one_pass.ema.tensors())
    resumed.optimizer.load_state_dict(deepcopy(one_pass.optimizer.state_dict()))
    assert resumed.step(4) == one_pass.step(4)
    pairs = zip(resumed.numbers(), one_pass.numbers(), strict=True)
    assert all(torch.equal(first, second) for first, second in pairs)


def test_an_update_without_a_gradient_leaves_that_weight_as_it_is() -> None:
    training = SmallTraining(True)
    training.step(0)
    before = training.weights["0"].detach().clone()
    for name, parameter in training.weights.items():
        parameter.grad = None if name == "0" else torch.ones_like(parameter)
    training.update(1)
    assert torch.equal(training.weights["0"], before)


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
