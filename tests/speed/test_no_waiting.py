"""No operation of an update or a chunk waits for the device.

On the meta device operations have no numbers, so that one that needs a number, or a tensor of the
CPU, is found.
"""

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import random_batch, small_policy

MODELS = ["tokendrop_expert", "framesamp_modul", "ttt_expert", "rmt_context"]


class HostWork(TorchDispatchMode):
    """Notes every operation between the CPU and another device, or on the CPU alone."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[str] = []

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        tensors = [x for x in tree_leaves((args, kwargs, result)) if isinstance(x, torch.Tensor)]
        if (
            any(x.device.type == "cpu" and x.numel() for x in tensors)
            or func is torch.ops.aten._local_scalar_dense.default
        ):
            self.waits.append(str(func))
        return result


def on_meta(policy: MMEPolicy) -> tuple[Any, dict[str, torch.Tensor]]:
    """A batch and the draws of its loss there, and the policy moved."""
    batch = random_batch(policy, 2)
    generator = torch.Generator().manual_seed(0)
    draws = policy.training_noise(2, generator) | policy.augmentation_params(2, generator)
    policy.to("meta")
    return batch.to("meta"), {name: value.to("meta") for name, value in draws.items()}


@pytest.mark.parametrize("model", MODELS)
def test_an_update_touches_nothing_on_the_cpu(model: str) -> None:
    policy = small_policy(model, policy={"augment": True}).train()
    batch, draws = on_meta(policy)
    assert "changes" in draws
    with HostWork() as work:
        loss, _ = policy(batch, draws)
        loss.backward()
    assert work.waits == []
    assert all(p.grad is not None for name, p in policy.named_parameters() if "time_in" in name)


@pytest.mark.parametrize("model", MODELS)
def test_a_chunk_touches_nothing_on_the_cpu(model: str) -> None:
    policy = small_policy(model).eval()
    batch, draws = on_meta(policy)
    with HostWork() as work:
        chunk = policy.sample_actions(batch, {"noise": draws["noise"]}, steps=2)
    assert work.waits == [] and chunk.device.type == "meta"
