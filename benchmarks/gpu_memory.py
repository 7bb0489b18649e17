"""Memory that a full-size policy takes on a GPU, as PyTorch's allocator counts it: the tables of
the pages on hardware.

    python benchmarks/gpu_memory.py chunk pi05
    python benchmarks/gpu_memory.py update pi05:8
    # model:processes:samples a process
    python benchmarks/gpu_memory.py shared tokendrop_expert:8:8
    # … :recomputation (all, selective)
    python benchmarks/gpu_memory.py shared pi05:4:16:all

One process a figure, one line of JSON. Weights hold whatever was in memory: nothing is learned,
only counted. It asks for one GPU, or (with --no-cudnn) for a stand-in that computes nothing, as
docs/evidence has it; `shared` is one of so many processes of one machine, and communicates with
none.
"""

import argparse
import gc
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import distributed

from mme_vla import MMEPolicy, build_policy
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.training import parallel
from mme_vla.training.checkpoint import trainable
from mme_vla.training.optim import EMA, WeightUpdate, make_optimizer
from mme_vla.training.settings import ParallelSettings, TrainSettings
from mme_vla.types import Batch

GIB = 2**30
DEVICE = torch.device("cuda")


def on_meta(model: str, backbone: str) -> MMEPolicy:
    """A policy without memory for its weights; bfloat16 compute."""
    options: dict[str, Any] = {"policy.augment": False, "policy.compute_dtype": "bfloat16"}
    policy = build_policy(model, backbone=backbone, device="meta", **options)
    assert isinstance(policy, MMEPolicy)
    return policy


def batch_of(policy: MMEPolicy, size: int) -> Batch:
    """A batch at its fullest, with vision tokens as a cache stores them."""
    full = policy.full_batch(DEVICE)
    if full.history is not None:
        full = replace(
            full,
            history=replace(
                full.history, features=full.history.features.to(policy.info.history_dtype)
            ),
        )
    return full.rows(torch.zeros(size, dtype=torch.int64, device=DEVICE))


def chunk(model: str, backbone: str = "pi05") -> dict[str, float]:
    """A chunk of one episode, bfloat16 weights, captured as one graph and played again."""
    policy = (
        on_meta(model, backbone)
        .to(torch.bfloat16)
        .to_empty(device=DEVICE)
        .eval()
        .requires_grad_(False)
    )
    weights = torch.cuda.memory_allocated()
    policy.compile_sampling()
    batch, noise = (
        batch_of(policy, 1),
        torch.zeros(1, policy.horizon, policy.action_dim, device=DEVICE),
    )
    with torch.no_grad(), policy.autocast():
        memory = policy.model.memory_tokens(batch)
    # an episode's tokens are counted where episodes are
    batch = replace(batch, history=None, actions=None)
    gc.collect()  # a policy and its model refer to each other
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    for _ in range(2):
        policy.sample_actions(batch, noise, memory=memory)
    return {"weights": weights / GIB, **_peaks()}


def update(model: str, samples: int, backbone: str = "pi05") -> dict[str, float]:
    """Updates of one process that has all weights: AdamW and EMA, frozen tower."""
    policy = on_meta(model, backbone).to_empty(device=DEVICE)
    apply_finetuning(policy)
    return _updates(policy.train(), samples, lambda: None)


def shared(
    model: str,
    processes: int,
    samples: int,
    recompute: str = "",
    backbone: str = "pi05",
    mode: str = "full",
    frozen_dtype: str | None = None,
) -> dict[str, float]:
    """The same in one of so many processes that share weights, gradients, moments and averages."""
    from torch.testing._internal.distributed.fake_pg import FakeStore

    distributed.init_process_group("fake", rank=0, world_size=processes, store=FakeStore())
    os.environ.setdefault("LOCAL_WORLD_SIZE", str(processes))
    policy = on_meta(model, backbone)
    apply_finetuning(policy, mode, frozen_dtype=frozen_dtype)
    policy.train().recompute(recompute == "all" or recompute or False)  # type: ignore[arg-type]
    mesh = ParallelSettings("fsdp").mesh("cuda")
    # No process has weights to send: what comes after the sharding is left out.
    original, parallel.set_model_state_dict = parallel.set_model_state_dict, lambda *_, **__: None
    rank, distributed.get_rank = distributed.get_rank, lambda *_: 1
    try:
        parallel.shard(policy, mesh, policy.compute_dtype)
    finally:
        parallel.set_model_state_dict, distributed.get_rank = original, rank
    return _updates(policy, samples, partial(parallel.reshard, policy))


def _updates(policy: MMEPolicy, samples: int, reshard: Callable[[], None]) -> dict[str, float]:
    learning = trainable(policy)
    optimizer = make_optimizer(
        learning.values(), TrainSettings(steps=10, batch_size=samples, lr=1e-4)
    )
    ema = EMA(learning, 0.999, reshard=reshard)
    batch = batch_of(policy, samples)
    draws = {
        name: value.to(DEVICE)
        for name, value in policy.training_noise(samples, torch.Generator()).items()
    }
    allocated = torch.cuda.memory_allocated()
    update_weights = WeightUpdate(learning, optimizer, ema, 1.0)
    for done in range(3):  # moments come with the first
        torch.cuda.reset_peak_memory_stats()
        policy(batch, draws)[0].backward()
        update_weights(done)
    return {"held before": allocated / GIB, **_peaks()}


def _peaks() -> dict[str, float]:
    return {
        "peak": torch.cuda.max_memory_allocated() / GIB,
        "reserved": torch.cuda.max_memory_reserved() / GIB,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Count and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("chunk", "update", "shared"))
    parser.add_argument("of", help="the model and its numbers, as above")
    parser.add_argument("--backbone", default="pi05", help="a file of configs/backbone")
    parser.add_argument(
        "--mode", default="full", help="of `shared`: finetune (full, expert_only, lora)"
    )
    parser.add_argument("--frozen-dtype", help="of `shared`: finetune.frozen_dtype")
    parser.add_argument(
        "--no-cudnn", action="store_true", help="leave cuDNN out: a stand-in has none"
    )
    args = parser.parse_args(arguments)
    if not torch.cuda.is_available():
        parser.error("there is no GPU, nor one that computes nothing")
    torch.backends.cudnn.enabled = not args.no_cudnn
    model, *numbers = args.of.split(":")
    if args.what == "chunk":
        peaks = chunk(model, args.backbone)
    elif args.what == "update":
        peaks = update(model, int(numbers[0]), args.backbone)
    else:
        peaks = shared(
            model,
            int(numbers[0]),
            int(numbers[1]),
            *numbers[2:3],
            backbone=args.backbone,
            mode=args.mode,
            frozen_dtype=args.frozen_dtype,
        )
    print(
        json.dumps(
            {
                "what": args.what,
                "of": args.of,
                **{name: round(gib, 2) for name, gib in peaks.items()},
            }
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
