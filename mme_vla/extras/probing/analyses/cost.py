"""What a model costs: FLOPs and parameters, counted on the meta device, so that full size needs no
memory.

FLOPs are those of PyTorch's `FlopCounterMode` over the real code: two for each multiply-add of
linear layers, convolutions, matrix products and attention (on meta its kernel is taken apart into
counted products; `count_model` makes sure of that). Elementwise work, norms, softmax and embedding
look-ups are not counted. Batch 1, two cameras, every prompt as long as its model's config allows, a
full memory; recurrent memories read a full window. Past frames arrive as stored tokens, as they do
in training; what the vision tower spends on them in an episode is a number of its own.
"""

import csv
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from mme_vla.config.composition import compose
from mme_vla.errors import UserError, counted
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_policy
from mme_vla.policy.network import NetworkPolicy
from mme_vla.policy.sections import PolicySections
from mme_vla.utils import write_atomically

REPLAN = 16  # frames that pass between two chunks of an episode


@dataclass(frozen=True)
class ModelCost:
    """One model's cost; all but `prompt` (tokens) and `parameters` in FLOPs.

    forward: the loss of one training sample.
    chunk: memory, prefix and ten Euler steps.
    memory: of these, encoding the memory tokens from scratch.
    streamed: instead, a recurrent memory's update by one frame (None for others).
    frames: the vision tower on those of `REPLAN` passing frames that the memory stores.
    """

    model: str
    prompt: int
    parameters: int
    forward: int
    chunk: int
    memory: int
    streamed: int | None
    frames: int


def count_model(model: str, budget: int | None = None, backbone: str | None = None) -> ModelCost:
    """Count a model at a memory budget (None: its own).

    backbone: a file of `configs/backbone`; by default the one that is the model's full size.
    """
    # Not every PyTorch counts attention.
    q, k = torch.empty(1, 8, 20, 32, device="meta"), torch.empty(1, 8, 50, 32, device="meta")
    mask = torch.zeros(1, 1, 20, 50, device="meta")
    attention = flops(lambda: nn.functional.scaled_dot_product_attention(q, k, k, attn_mask=mask))
    if attention != 2 * (2 * 8 * 20 * 50 * 32):
        raise UserError(
            f"This PyTorch ({torch.__version__}) counts {attention} FLOPs for an attention of"
            " 1,024,000."
        )

    policy = on_meta(model, budget, backbone)
    assert isinstance(policy, NetworkPolicy)
    batch, memory = policy.full_batch("meta"), policy.memory
    of_memory = 0
    streamed = None
    frames = 0
    if memory is not None:
        of_memory = flops(lambda: memory(batch.history))
        # The frames between two chunks are encoded.
        stored = memory.storage.stored_frames(2 * REPLAN)
        tower = policy.memory_tower
        image = torch.zeros(1, 3, tower.image_size, tower.image_size, device="meta")
        frames = int((stored >= REPLAN).sum()) * flops(lambda: tower.encode(image))
    if isinstance(memory, RecurrentMemory):
        # A stream reads its last frame alone.
        history: Any = batch.history
        last = slice(-(memory.storage.grid**2), None)
        frame = history.features[:, last], history.positions[:, last], history.mask[:, last]
        streamed = flops(lambda: memory.read(memory.update(memory.init_state(1), *frame)))
    return ModelCost(
        model=model,
        prompt=PolicySections.of(policy.config).processor.get("prompt_length", 0),
        parameters=sum(p.numel() for p in policy.parameters()),
        forward=flops(lambda: policy(batch)),
        chunk=flops(lambda: policy.sample_actions(batch)),
        memory=of_memory,
        streamed=streamed,
        frames=frames,
    )


def flops(work: Callable[[], object]) -> int:
    """FLOPs of a call, forward only."""
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def on_meta(model: str, budget: int | None = None, backbone: str | None = None) -> Policy:
    """A model on the meta device."""
    if backbone is None:
        backbone = str(compose("policy", [f"model={model}"]).full_size)
    policy = build_policy(model, backbone=backbone, device="meta")
    if budget is None:
        return policy
    if policy.memory is None:
        raise UserError(f"{model} has no memory, so no budget of {counted(budget, 'token')}.")
    return build_policy(model, backbone=backbone, device="meta", memory={"budget": budget})


def write_costs(costs: list[ModelCost], path: Path) -> None:
    """Write counts as CSV."""
    with write_atomically(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        columns = [member.name for member in fields(ModelCost)]
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(asdict, costs))
