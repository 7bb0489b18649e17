"""What is compiled: few graphs whatever the depth, no break, no eager fall-back, and the loss that
it always was.
"""

import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch._dynamo.utils import counters

from mme_vla.backbone.base import Hook, LayerHooks, bind_hook
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import random_batch, small_policy
from mme_vla.training.order import Validation
from mme_vla.types import Batch

pytestmark = pytest.mark.slow

MOST_GRAPHS = 6
SHORT_TOWER = {"backbone.vision.depth": 1}
"""The tower is one graph of all its layers, and takes as long to trace as they are many."""


@pytest.fixture(autouse=True)
def fresh_and_quiet(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing compiled before or after; and no notes of every step, which pytest would keep and
    which cost seconds.
    """
    monkeypatch.setattr(logging.getLogger("torch.__trace"), "disabled", True)
    torch.compiler.reset()
    yield
    torch.compiler.reset()


class Counted:
    """A backend that compiles nothing and counts what it is given."""

    def __init__(self) -> None:
        self.graphs = 0

    def __call__(self, graph: torch.fx.GraphModule, inputs: list[Any]) -> Any:
        self.graphs += 1
        return graph.forward


def batch_of(policy: MMEPolicy, samples: int, prompt: int, frames: int) -> Batch:
    """A batch whose prompt and whose window of past frames are so long."""
    memory = policy.memory
    valid = frames * memory.storage.grid**2 if memory is not None and memory.pad_left else 100
    batch = random_batch(policy, samples, valid=valid)
    words = torch.full((samples, prompt), 5)
    return replace(batch, prompt=words, prompt_mask=words > 0)


@pytest.mark.parametrize(
    ("model", "depth"),
    [("framesamp_modul", 4), ("ttt_expert", 2), ("rmt_context", 2)],
)
def test_a_run_compiles_few_graphs_at_any_depth(model: str, depth: int) -> None:
    policy = small_policy(
        model, **{"backbone.depth": depth}, **SHORT_TOWER, policy={"augment": False}
    ).train()
    policy.backbone.vision.requires_grad_(False)
    first, second = batch_of(policy, 2, 32, 16), batch_of(policy, 2, 16, 8)
    draws = policy.training_noise(2, torch.Generator().manual_seed(0))
    eager, _ = policy(first, draws)
    policy.compile(backend=(counted := Counted()))
    loss, _ = policy(first, draws)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(float(eager.detach()), rel=1e-5)
    after_one = counted.graphs
    policy(second)[0].backward()
    validation = Validation(
        [0, 1, 2], lambda items: batch_of(policy, len(items), 16, 8), 3, 2, seed=0
    )
    validation.loss(policy)
    assert after_one == counted.graphs <= MOST_GRAPHS, (
        "other lengths, batches and validation need no code of their own"
    )
    assert counted.graphs >= 3, "the tower, a layer, and the last layer"


@pytest.mark.nightly
@pytest.mark.parametrize("model", ["framesamp_modul", "ttt_expert", "rmt_context"])
def test_compiled_updates_equal_eager_ones(model: str) -> None:
    counters.clear()
    eager, reference = updated(model, compiled=False)
    compiled, gradients = updated(model, compiled=True)
    assert compiled == pytest.approx(eager, rel=1e-6)
    for name, gradient in gradients.items():
        tolerance = 1e-5 * float(reference[name].abs().max())
        torch.testing.assert_close(gradient, reference[name], atol=tolerance, rtol=0)
    assert counters["stats"]["unique_graphs"] == 4
    assert not counters["graph_break"]


def updated(model: str, compiled: bool) -> tuple[list[float], dict[str, torch.Tensor]]:
    """Losses of three updates, and the gradients of the first."""
    depths = {"backbone.depth": 2} | SHORT_TOWER
    # In bfloat16 another order of sums may round a number up instead of down.
    exact = {"memory.attention_dtype": "float32"} if model == "rmt_context" else {}
    policy = small_policy(model, **depths, **exact, policy={"augment": False}).train()
    policy.backbone.vision.requires_grad_(False)
    if compiled:
        policy.compile()
    batch = random_batch(policy, 2)
    draws = policy.training_noise(2, torch.Generator().manual_seed(0))
    optimizer = torch.optim.AdamW([p for p in policy.parameters() if p.requires_grad], lr=1e-3)
    losses: list[float] = []
    gradients: dict[str, torch.Tensor] = {}
    for _ in range(3):
        loss, _ = policy(batch, draws)
        loss.backward()
        for name, parameter in policy.named_parameters() if not losses else ():
            if parameter.grad is not None:
                gradients[name] = parameter.grad.clone()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(float(loss.detach()))
    return losses, gradients


def test_a_hook_of_layers_answers_as_one_of_numbers() -> None:
    hook: Hook = LayerHooks([lambda x: x + 1, lambda x: x * 2])
    x = torch.ones(2)
    for layer, expected in enumerate((2.0, 2.0)):
        bound = bind_hook(hook, layer)
        assert (
            bound is not None
            and torch.equal(bound(x), hook(layer, x))
            and float(bound(x)[0]) == expected
        )
    bound_layer = bind_hook(lambda layer, x: x + layer, 3)
    assert bound_layer is not None and float(bound_layer(x)[0]) == 4
    assert bind_hook(None, 0) is None
