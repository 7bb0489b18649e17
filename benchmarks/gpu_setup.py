"""What the parts of `gpu.py` share: what is measured and how, and policies, batches and FLOPs for
it.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor, distributed
from torch.utils.flop_counter import FlopCounterMode

from mme_vla import MMEPolicy, build_policy
from mme_vla.extras.probing.analyses.cost import flops
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.speed import HasAttentionBackends
from mme_vla.testing.small import open_gates
from mme_vla.types import Batch

PEAKS = {
    "H100 PCIe": 756,
    "H100": 989,
    "H200": 989,
    "GH200": 989,
    "B200": 2250,
    "A100": 312,
    "NVIDIA A40": 150,  # no RTX A4000
    "L40S": 362,
    "RTX 4090": 165,
    "RTX 3090": 71,
}
"""Dense bfloat16 TFLOP/s by a part of the device's name, the first that fits; vendors'
data sheets.
"""


OPENPI = "pi05 with openpi's settings"
OPENPI_OPTIONS = {"processor.prompt_length": 200, "embodiment.action.horizon": 50}
"""What openpi configures for π0.5, beside training every weight."""


@dataclass
class Setup:
    """What is measured: sizes, device and how often.

    backbone: a file of configs/backbone.
    batch: samples a process.
    processes: how many share an update.
    """

    backbone: str
    batch: int
    rounds: int
    device: torch.device
    compiled: bool
    attention: str
    processes: int = 1

    @property
    def dtype(self) -> torch.dtype:
        return torch.bfloat16 if self.device.type == "cuda" else torch.float32


def join_processes(device: str) -> tuple[torch.device, int, int]:
    """This process's device, its rank and how many there are; a process that a launcher started
    joins the others.
    """
    rank, processes = (
        int(os.environ.get(name, default)) for name, default in (("RANK", 0), ("WORLD_SIZE", 1))
    )
    place = torch.device(device)
    if place.type == "cuda":
        place = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.cuda.set_device(place)
    if processes > 1:
        distributed.init_process_group("nccl" if place.type == "cuda" else "gloo")
    return place, rank, processes


def peak_flops(device: torch.device) -> float | None:
    """FLOP/s of this GPU's tensor cores in bfloat16; None where the table does not know it."""
    if device.type != "cuda":
        return None
    name = torch.cuda.get_device_name(device)
    return next((1e12 * peak for part, peak in PEAKS.items() if part in name), None)


def peak_gib(device: torch.device) -> float | None:
    """Most that was allocated since `reset_peak_memory_stats`; None on a CPU."""
    return torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else None


def milliseconds(
    work: Callable[[], object], rounds: int, warmup: int, device: torch.device
) -> list[float]:
    """How long each round takes, the device's work included; ascending. A CPU is warmed up once at
    most.
    """
    times = []
    warmup = warmup if device.type == "cuda" else min(warmup, 1)
    for index in range(warmup + rounds):
        wait(device)
        begun = time.perf_counter()
        work()
        wait(device)
        if index >= warmup:
            times.append(1e3 * (time.perf_counter() - begun))
    return sorted(times)


def wait(device: torch.device) -> None:
    """Wait for all that the device was asked to do."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@cache
def sample_flops(model: str, backbone: str) -> tuple[int, int]:
    """FLOPs of a sample's forward and backward pass with a frozen tower, counted on the meta
    device.

    Returns:
        What the model needs, and what is computed: recurrent memories compute their window twice.
    """
    policy = built(model, backbone, torch.device("meta"))
    batch = policy.full_batch("meta")
    with FlopCounterMode(display=False) as counter:
        policy(batch, draws_of(policy, 1, torch.device("meta")))[0].backward()
    computed = counter.get_total_flops()
    again = 0
    if isinstance(policy.memory, RecurrentMemory):
        memory, history = policy.memory, batch.history
        again = flops(lambda: memory(history))
    return computed - again, computed


def built(model: str, backbone: str, device: torch.device, attention: str = "auto") -> MMEPolicy:
    """A policy as it is trained, its tower frozen; or `OPENPI`, with all weights trained. Its gates
    are open: with those of fresh weights, which are shut, no layer reaches a chunk.
    """
    # PaliGemma's tokenizer is gated, and no text is measured.
    options: dict[str, Any] = {"policy.augment": False, "processor.tokenizer": "sample"}
    as_openpi = model == OPENPI
    if as_openpi:
        model, options = "pi05", options | OPENPI_OPTIONS
    if device.type == "cuda":
        options["policy.compute_dtype"] = "bfloat16"
    policy = build_policy(model, backbone=backbone, device=device, **options)
    assert isinstance(policy, MMEPolicy)
    open_gates(policy)
    backbone_module = policy.backbone
    assert isinstance(backbone_module, HasAttentionBackends)
    backbone_module.set_attention_backend(attention)
    policy.backbone.vision.requires_grad_(as_openpi)
    return policy.train()


def batch_of(policy: MMEPolicy, size: int, device: torch.device) -> Batch:
    """A full batch of random content, whose prompts have some padding, as they do in training."""
    full = policy.full_batch(device)
    batch = full.rows(torch.zeros(size, dtype=torch.int64, device=device))
    mask = batch.prompt_mask.clone()
    mask[:, -3:] = False
    history = batch.history
    if history is not None:
        history = replace(history, features=torch.randn_like(history.features))
    return replace(
        batch,
        images=torch.randint_like(batch.images, 256),
        prompt=torch.randint_like(batch.prompt, 2, 200),
        prompt_mask=mask,
        history=history,
    )


def draws_of(policy: MMEPolicy, size: int, device: torch.device) -> dict[str, Tensor]:
    """Random numbers of its loss."""
    sampled = policy.training_noise(size, torch.Generator().manual_seed(0))
    return {name: value.to(device) for name, value in sampled.items()}
