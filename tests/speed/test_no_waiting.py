"""Nothing in an update or a chunk waits for the device: shown on the meta device, and on a GPU that does nothing.

On the meta device every operation runs without numbers, so that one that needs a number, or a tensor of the CPU, stands
out. The GPU that does nothing (`../shared/noop_gpu`, where it is at hand) counts what PyTorch's CUDA build really asks.
"""

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from noop_gpu import NoopGpu, needs_noop_gpu, noop_gpu  # noqa: F401  (a fixture)
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import random_batch, small_policy

MODELS = ["tokendrop_expert", "framesamp_modul", "ttt_expert", "rmt_context"]


class HostWork(TorchDispatchMode):
    """Notes every operation between the CPU and another device, or on the CPU alone."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        tensors = [x for x in tree_leaves((args, kwargs, result)) if isinstance(x, torch.Tensor)]
        if (
            any(x.device.type == "cpu" and x.numel() for x in tensors)
            or func is torch.ops.aten._local_scalar_dense.default
        ):
            self.found.append(str(func))
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
    assert work.found == []
    assert all(p.grad is not None for name, p in policy.named_parameters() if "time_in" in name)


@pytest.mark.parametrize("model", MODELS)
def test_a_chunk_touches_nothing_on_the_cpu(model: str) -> None:
    policy = small_policy(model).eval()
    batch, draws = on_meta(policy)
    with HostWork() as work:
        chunk = policy.sample_actions(batch, {"noise": draws["noise"]}, steps=2)
    assert work.found == [] and chunk.device.type == "meta"


def test_what_waits_is_found() -> None:
    x = torch.ones(2, device="meta")
    with HostWork() as work:
        x + torch.tensor([1.0, 2.0]).to("meta")
        x.new_tensor([1.0, 2.0])
    assert len(work.found) >= 2


COUNTING = """
import ctypes, warnings
warnings.filterwarnings("ignore")
import torch
from mme_vla.testing.small import random_batch, small_policy
torch.backends.cudnn.enabled = False
driver = ctypes.CDLL(None)
names = ("n_sync", "n_h2d", "n_d2h", "n_graphlaunch", "n_launch")
count = lambda: [ctypes.c_long.in_dll(driver, name).value for name in names]
for model in ("framesamp_modul", "rmt_context"):
    policy = small_policy(model).cuda()
    batch = random_batch(policy, 2).to("cuda")
    draws = {k: v.cuda() for k, v in policy.train().training_noise(2, torch.Generator()).items()}
    draws["changes"] = policy.augmentation_params(2, torch.Generator())["changes"].cuda()
    noise = draws["noise"]
    def update():
        policy(batch, draws)[0].backward()
    def chunk():
        policy.sample_actions(batch, noise, memory=memory)
    def counted(work):
        work(); torch.cuda.synchronize(); before = count(); work()
        return [b - a for a, b in zip(before, count())]
    print(model, "update", *counted(update))
    with torch.no_grad():
        memory = policy.eval().encode_memory(batch.history)
    policy.compile_sampling()
    print(model, "chunk", *counted(chunk))
"""


@needs_noop_gpu
def test_a_gpu_that_does_nothing_counts_no_wait_and_one_launch_a_chunk(noop_gpu: NoopGpu) -> None:  # noqa: F811
    told = noop_gpu.run("-c", COUNTING)
    lines = [line.split() for line in told.splitlines()]
    assert [line[:2] for line in lines] == [
        [m, w] for m in ("framesamp_modul", "rmt_context") for w in ("update", "chunk")
    ]
    for model, what, waits, to_gpu, from_gpu, graphs, launches in lines:
        assert (waits, to_gpu, from_gpu) == ("0", "0", "0"), (model, what)
        assert (graphs, launches) == ("1", "0") if what == "chunk" else int(launches) > 100, (model, what)
