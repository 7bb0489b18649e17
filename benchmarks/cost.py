"""What each of the 17 models costs: FLOPs counted at full size, time and peak memory measured at tiny size.

    python benchmarks/cost.py [--count] [--budgets] [--time] [--memory] [--models …]     (all four without a choice)

FLOPs are those of PyTorch's `FlopCounterMode` over the real code on the meta device: two for each multiply-add of
linear layers, convolutions, matrix products and attention (on meta its kernel is taken apart into counted products;
`check_attention_is_counted` holds that). Elementwise work, norms, softmax and embedding look-ups are not counted.
Batch 1, two cameras, every prompt as long as its model's config allows, a full memory of 512 tokens; recurrent
memories read a full window of 64 frames. Past frames arrive as stored tokens, as they do in training; what the vision
tower spends on them in an episode is a column of its own.
"""

import argparse
import resource
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import torch
from timing import alternate, machine
from torch import nn
from torch.utils.flop_counter import FlopCounterMode
from variants import chunk, training_step

from mme_vla import build_policy
from mme_vla.config import compose
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.policy import MMEPolicy
from mme_vla.testing import ALL_MODELS, NEURAL, random_batch
from mme_vla.types import Batch

TERA, MIB = 1e12, 2**20
REPLAN = 16  # frames that pass between two chunks of an episode
BUDGETS = (64, 128, 256, 512, 1024)
OF_BUDGETS = ("framesamp_modul", "tokendrop_expert")


def flops(work: Callable[[], object]) -> int:
    """FLOPs of a call, forward only."""
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def check_attention_is_counted() -> None:
    """Stop if this version of PyTorch does not count masked attention on the meta device."""
    q, k = torch.empty(1, 8, 20, 32, device="meta"), torch.empty(1, 8, 50, 32, device="meta")
    mask = torch.zeros(1, 1, 20, 50, device="meta")
    counted = flops(lambda: nn.functional.scaled_dot_product_attention(q, k, k, attn_mask=mask))
    assert counted == 2 * (2 * 8 * 20 * 50 * 32), f"attention counts {counted} FLOPs on meta"


def prompt_length(model: str) -> int:
    """Tokens of the prompt, as the model's own file says."""
    return compose("policy", [f"model={model}", "backbone=pi05"]).processor.prompt_length


def full_batch(policy: MMEPolicy, batch: int, prompt: int) -> Batch:
    """Noise pictures, a prompt of `prompt` tokens without padding, and a memory that is full."""
    made = random_batch(policy, batch, valid=policy.memory.capacity if policy.memory else 0)
    made.prompt = torch.full((batch, prompt), 5)
    made.prompt_mask = torch.ones(batch, prompt, dtype=torch.bool)
    return made


def full_size(model: str, budget: int = 512) -> tuple[MMEPolicy, Batch]:
    """A model at full size and a batch of one, both on meta."""
    overrides: dict[str, Any] = {} if model not in NEURAL else {"memory": {"budget": budget}}
    policy = build_policy(model, backbone="pi05", device="meta", **overrides)
    policy.augment = False  # elementwise, and it draws numbers
    return policy, full_batch(policy, 1, prompt_length(model)).to("meta")


def forward_pass(policy: MMEPolicy, batch: Batch) -> Callable[[], object]:
    """The loss of one training sample."""
    return lambda: policy(batch)


def sampling(policy: MMEPolicy, batch: Batch) -> Callable[[], object]:
    """One chunk: memory, prefix and ten Euler steps."""
    return lambda: policy.sample_actions(batch)


def memory_flops(policy: MMEPolicy, batch: Batch) -> int:
    """Encoding the memory tokens from scratch."""
    return flops(lambda: policy.encode_memory(batch.history))


def streamed_flops(policy: MMEPolicy, batch: Batch) -> int | None:
    """A recurrent memory's one update when its frame list grows by one; None for other memories."""
    memory, history = policy.memory, batch.history
    if not isinstance(memory, RecurrentMemory) or history is None:
        return None
    last = slice(-(memory.storage.grid**2), None)
    frame = history.features[:, last], history.positions[:, last], history.mask[:, last]
    return flops(lambda: memory.read(memory.update(memory.init_state(1), *frame)))


def frames_flops(policy: MMEPolicy) -> int:
    """The vision tower on those of `REPLAN` passing frames that the memory wants stored."""
    if policy.memory is None:
        return 0
    size = policy.backbone.config.vision.image_size
    image = torch.empty(1, 3, size, size, device="meta")
    wanted = sum(policy.memory.storage.keeps(frame) for frame in range(REPLAN, 2 * REPLAN))
    return wanted * flops(lambda: policy.backbone.encode_images(image))


def count(models: list[str]) -> None:
    """Parameters and FLOPs of the models at full size."""
    print("| model | prompt | parameters | forward pass | sampled chunk | over `pi05` | memory, of these | streamed "
          "| past frames |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|")  # fmt: skip
    reference = flops(sampling(*full_size("pi05")))
    for model in models:
        policy, batch = full_size(model)
        parameters = sum(p.numel() for p in policy.parameters()) / 1e6
        forward, sampled = flops(forward_pass(policy, batch)), flops(sampling(policy, batch))
        memory, streamed = memory_flops(policy, batch), streamed_flops(policy, batch)
        cells = [
            str(batch.prompt.shape[1]), f"{parameters:,.1f} M", f"{forward / TERA:.3f} T", f"{sampled / TERA:.3f} T",
            f"{sampled / reference:.2f}x", f"{memory / TERA:.4f} T" if memory else "",
            "" if streamed is None else f"{streamed / TERA:.4f} T",
            f"{frames_flops(policy) / TERA:.3f} T" if policy.memory else "",
        ]  # fmt: skip
        print(f"| `{model}` | {' | '.join(cells)} |")


def budgets() -> None:
    """FLOPs over the memory budget at full size."""
    head = " | ".join(f"{budget:,}" for budget in BUDGETS)
    print(f"| model | | {head} |\n|---|---|{'---:|' * len(BUDGETS)}")
    for model in OF_BUDGETS:
        made = [full_size(model, budget) for budget in BUDGETS]
        rows = {
            "forward pass": [flops(forward_pass(*parts)) for parts in made],
            "sampled chunk": [flops(sampling(*parts)) for parts in made],
        }
        for what, values in rows.items():
            print(f"| `{model}` | {what} | {' | '.join(f'{value / TERA:.3f} T' for value in values)} |")


def tiny(model: str, batch: int) -> tuple[MMEPolicy, Batch]:
    """A tiny model and a full batch: 512 memory tokens, every window full."""
    policy = build_policy(model, backbone="tiny")
    return policy, full_batch(policy, batch, prompt_length(model))


def measure_time(models: list[str], batch: int, rounds: int) -> None:
    """Median times of the models at tiny size, taking turns; those over `pi05` where it takes part."""
    made = {model: tiny(model, batch) for model in models}
    steps = alternate({model: training_step(*parts) for model, parts in made.items()}, rounds, warmup=1)
    chunks = alternate({model: chunk(*parts) for model, parts in made.items()}, rounds, warmup=1)
    print(f"{machine()}; tiny, batch {batch}, median of {rounds}")
    print("| model | training step | over `pi05` | sampled chunk | over `pi05` |\n|---|---:|---:|---:|---:|")
    for model in models:
        cells = [
            f"{1e3 * t[model]:,.0f} ms | " + (f"{t[model] / t['pi05']:.2f}x" if "pi05" in t else "")
            for t in (steps, chunks)
        ]
        print(f"| `{model}` | {' | '.join(cells)} |", flush=True)


def peak_mib() -> float:
    """Most resident memory this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MIB


def peaks_of(model: str, batch: int) -> None:
    """In a process of its own: print the peak with the model built, after a chunk, and after two training steps."""
    policy, made = tiny(model, batch)
    peaks = [peak_mib()]
    chunk(policy, made)()
    peaks.append(peak_mib())
    step = training_step(policy, made)
    for _ in range(2):  # AdamW makes its moments in the first
        step()
    print(*peaks, peak_mib())


def measure_memory(models: list[str], batch: int, threads: int) -> None:
    """Peak resident memory at tiny size, a process for each model, and what of it came after the model was built."""
    print("| model | sampled chunk | of this working memory | training step | of this working memory |")
    print("|---|---:|---:|---:|---:|")
    for model in models:
        command = [sys.executable, __file__, "--child", model, "--batch", str(batch), "--threads", str(threads)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        built, *peaks = map(float, done.stdout.split())
        cells = [f"{peak:,.0f} MiB | {peak - built:,.0f} MiB" for peak in peaks]
        print(f"| `{model}` | {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", action="store_true", help="FLOPs of every model at full size")
    parser.add_argument("--budgets", action="store_true", help="FLOPs over the memory budget at full size")
    parser.add_argument("--time", action="store_true", help="times at tiny size")
    parser.add_argument("--memory", action="store_true", help="peak memory at tiny size")
    parser.add_argument("--batch", type=int, default=4, help="of what is measured")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--models", nargs="+", default=ALL_MODELS, choices=ALL_MODELS, metavar="NAME")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.child:
        peaks_of(args.child, args.batch)
        return
    every = not (args.count or args.budgets or args.time or args.memory)
    check_attention_is_counted()
    if args.count or every:
        count(args.models)
    if args.budgets or every:
        budgets()
    if args.time or every:
        measure_time(args.models, args.batch, args.rounds)
    if args.memory or every:
        measure_memory(args.models, args.batch, args.threads)


if __name__ == "__main__":
    main()
