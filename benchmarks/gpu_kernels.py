"""Kernels that a chunk or an update launches at full size: their number is most of a chunk's time.

    python benchmarks/gpu_kernels.py pi05 framesamp_modul
    python benchmarks/gpu_kernels.py pi05 --ways eager --steps 1
    python benchmarks/gpu_kernels.py pi05 --what update --batch 8

One line of JSON for each model and way: launches and matrix products, of a chunk after the memory
tokens. It needs a mock CUDA driver, as docs/evidence/hardware.md has it: the driver counts, and
computes nothing. Weights hold whatever was in memory.
"""

import argparse
import ctypes
import gc
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace

import torch
from gpu_memory import DEVICE, batch_of, on_meta
from gpu_setup import Setup, draws_of
from gpu_training import updating

from mme_vla import MMEPolicy
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.policy.mme import named_noise
from mme_vla.speed.compiler import CACHE_VARIABLE

WAYS = ("eager", "compiled")
COUNTERS = {"launches": "n_launch", "products": "n_gemm", "waits": "n_sync"}
"""What is counted, and the name of the mock driver's counter."""


def counted() -> dict[str, int]:
    """The counters of the mock driver."""
    driver = ctypes.CDLL(None)
    return {what: ctypes.c_long.in_dll(driver, counter).value for what, counter in COUNTERS.items()}


def full_size(model: str, way: str, backbone: str = "pi05") -> MMEPolicy:
    """A policy in bfloat16 whose sampler keeps time modulations; with `compiled` its layers are
    compiled.
    """
    policy = on_meta(model, backbone).to(torch.bfloat16).to_empty(device=DEVICE)
    policy.eval().requires_grad_(False)
    policy.processor = None  # without prompts to come, no graph is captured beforehand
    policy.compile_sampling(layers=way == "compiled")
    policy._sampler = None
    return policy


@torch.no_grad()
def kernels_of_chunk(policy: MMEPolicy, steps: int = 10) -> dict[str, int]:
    """Counts of the second chunk of one episode; the first one compiles, and keeps modulations."""
    batch = batch_of(policy, 1)
    noise = named_noise(torch.zeros(1, policy.horizon, policy.action_dim, device=DEVICE))
    with policy.autocast():
        memory = policy.model.memory_tokens(batch)
    batch = replace(batch, history=None, actions=None)
    policy.model.sample(batch, noise, steps, memory)
    before = counted()
    policy.model.sample(batch, noise, steps, memory)
    after = counted()
    return {what: after[what] - before[what] for what in COUNTERS}


def kernels_of_update(model: str, way: str, samples: int, backbone: str) -> dict[str, int]:
    """Counts of the third update of one process; the first ones compile."""
    policy = on_meta(model, backbone).to_empty(device=DEVICE)
    apply_finetuning(policy)
    setup = Setup(backbone, samples, 1, DEVICE, way == "compiled", "auto")
    update, _ = updating(policy.train(), setup)
    batch, draws = batch_of(policy, samples), draws_of(policy, samples, DEVICE)
    for _ in range(2):
        update(batch, draws)
    before = counted()
    update(batch, draws)
    after = counted()
    return {what: after[what] - before[what] for what in COUNTERS}


def main(arguments: Sequence[str] | None = None) -> int:
    """Count and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="+")
    parser.add_argument("--backbone", default="pi05", help="a file of configs/backbone")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--what", choices=("chunk", "update"), default="chunk")
    parser.add_argument("--steps", type=int, default=10, help="Euler steps of a chunk")
    parser.add_argument("--batch", type=int, default=8, help="samples of an update")
    args = parser.parse_args(arguments)
    # The mock driver has no cuDNN. It computes no constant either: its code would be wrong on the
    # GPU that it stands for, and is not kept.
    torch.backends.cudnn.enabled = False
    temporary = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
    os.environ.setdefault(CACHE_VARIABLE, temporary.name)
    for model in args.models:
        for way in args.ways:
            if args.what == "update":
                numbers = kernels_of_update(model, way, args.batch, args.backbone)
            else:
                numbers = kernels_of_chunk(full_size(model, way, args.backbone), args.steps)
            print(json.dumps({"model": model, "way": way, **numbers}), flush=True)
            gc.collect()
            torch.compiler.reset()
    return 0


if __name__ == "__main__":
    sys.exit(main())
