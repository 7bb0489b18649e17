"""How processes share one training run: every one with all weights (DDP), or each with a part of
them (FSDP2).

Sharded, a process keeps 1/n of the weights, gradients, moments and averages, and gathers a group of
weights (`NetworkPolicy.shard_groups`) right before it is needed. All of it is PyTorch's
`fully_shard`. Launchers stay `torchrun` and `accelerate launch`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import torch
from torch import Tensor, distributed, nn
from torch.distributed.checkpoint.state_dict import (
    StateDictOptions,
    get_model_state_dict,
    set_model_state_dict,
)
from torch.distributed.device_mesh import DeviceMesh
from torch.distributed.fsdp import FSDPModule, MixedPrecisionPolicy, fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

from mme_vla.policy.base import Policy
from mme_vla.policy.network import NetworkPolicy
from mme_vla.policy.saving import recompute_buffers
from mme_vla.speed.sharding import ShardGroup, float32_modules, stacked_layers

FULL_STATE = StateDictOptions(full_state_dict=True, cpu_offload=True)
FROM_FIRST = StateDictOptions(full_state_dict=True, broadcast_from_rank0=True)


def shard(policy: Policy, mesh: DeviceMesh, dtype: torch.dtype, compiled: bool = False) -> None:
    """Share a policy's weights in place; the first process's are what all get, and the others' may
    be on meta.

    Args:
        policy: with adapters, frozen parameters, recomputation and compilation as they shall be.
        dtype: matrix products run in it (`policy.compute_dtype`). Groups are gathered in it, but
            for what computes in float32: groups that say so, norms, and all that is in no group.
        compiled: groups are compiled whole, so nothing inside one is gathered apart: its norms are
            in `dtype` too.
    """
    full: dict[str, Any] = {}
    if distributed.get_rank() == 0:
        full = {name: tensor.detach().cpu() for name, tensor in policy.state_dict().items()}
    else:
        recompute_buffers(policy)
    low = None if dtype == torch.float32 else dtype

    def wrap(module: nn.Module | list[nn.Module], kind: torch.dtype | None) -> None:
        rules = MixedPrecisionPolicy(
            param_dtype=kind, reduce_dtype=torch.float32, cast_forward_inputs=False
        )
        fully_shard(module, mesh=mesh, mp_policy=rules)

    if isinstance(policy, NetworkPolicy):
        groups = policy.shard_groups()
    else:
        groups = [ShardGroup(layer) for layer in stacked_layers(policy)]
    for group in groups:
        kind = None if group.full else low
        if kind is not None and not compiled:
            exact = float32_modules(group.module)
            if exact:
                wrap(exact, None)
        wrap(group.module, kind)
        if isinstance(group.module, nn.Embedding):  # its gradient needs the words alone
            cast(FSDPModule, group.module).set_unshard_in_backward(False)
    wrap(policy, None)
    _materialise(policy, mesh)
    set_model_state_dict(policy, full, options=FROM_FIRST)


def _materialise(policy: Policy, mesh: DeviceMesh) -> None:
    """Give what is on meta memory, and what no checkpoint holds the first process's values."""
    device = torch.device(mesh.device_type)
    if device.type == "cuda":
        device = torch.device("cuda", torch.cuda.current_device())
    for module in policy.modules():
        tensors = [*module.parameters(recurse=False), *module.buffers(recurse=False)]
        if any(tensor.is_meta for tensor in tensors):
            module.to_empty(device=device, recurse=False)
    saved = policy.state_dict().keys()
    for name, buffer in policy.named_buffers():
        if name not in saved:
            distributed.broadcast(buffer, 0)


def full_state(policy: Policy) -> dict[str, Tensor]:
    """All of a sharded policy's tensors on the first process's CPU; elsewhere nothing. All
    processes call it.
    """
    full = cast(dict[str, Tensor], get_model_state_dict(policy, options=FULL_STATE))
    if policy.device.type != "cpu":
        return full
    # On the CPU they may be the storage that training continues with, or lie in the middle of what
    # was gathered.
    return {name: tensor.clone() for name, tensor in full.items()}


def reshard(module: nn.Module) -> None:
    """Release gathered weights, so that the next pass gathers what the shards now hold."""
    for part in _sharded_parts(module):
        part.reshard()
        # A pass that used only some of a group's norms left the group waiting for the others.
        fully_shard.state(part)._modules_to_run_forward.clear()  # type: ignore[attr-defined]


@contextmanager
def gathered(policy: Policy) -> Iterator[None]:
    """Within this context every process holds all weights of a sharded policy, and any of its
    methods may be called.

    For sampling and inspection, without gradients. All processes enter it; inside nothing is
    collective.
    """
    parts = _sharded_parts(policy)
    if not parts:
        yield
        return
    fully_shard.state(policy)._lazy_init()  # type: ignore[attr-defined]  # which the first training step does else
    policy.set_reshard_after_forward(False)  # type: ignore[operator]
    for part in parts:
        part.unshard()
    try:
        yield
    finally:
        for part in parts:
            part.set_reshard_after_forward(part is not policy, recurse=False)
        reshard(policy)


def like(tensor: Tensor, full: Tensor) -> Tensor:
    """Of a whole tensor the part that this process keeps, laid out as `tensor` is;
    nothing is sent.
    """
    if not isinstance(tensor, DTensor) or isinstance(full, DTensor):
        return full

    local = full.to(tensor.to_local().device)
    return distribute_tensor(local, tensor.device_mesh, tensor.placements, src_data_rank=None)


def full_value(value: Tensor) -> Tensor:
    """A number that processes hold parts of (a norm over shards) as the number itself."""
    return value.full_tensor() if isinstance(value, DTensor) else value


def _sharded_parts(module: nn.Module) -> list[Any]:
    return [part for part in module.modules() if isinstance(part, FSDPModule)]
