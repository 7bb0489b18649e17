r"""What each memory variant adds to `pi05`, for a training step and for a sampled chunk, at one
backbone size.

    python benchmarks/variants.py [--backbone tiny] [--batch 4] [--threads 2] [--rounds 7] \
        [--cpu-time]
    python benchmarks/variants.py --models rmt_modul --memory attention_dtype=float32

All variants take turns in one process. The modulator's line also counts how often memory keys are
computed per chunk.
"""

import argparse
import time

import torch
from timing import alternate, machine

from mme_vla import build_policy
from mme_vla.testing.small import NEURAL, random_batch


def training_step(policy, batch):
    """One step of AdamW on a frozen tower."""
    policy.backbone.vision.requires_grad_(False)
    optimizer = torch.optim.AdamW(
        [p for p in policy.parameters() if p.requires_grad], lr=1e-5, fused=True
    )

    def step() -> None:
        policy.train()
        optimizer.zero_grad(set_to_none=True)
        policy(batch)[0].backward()
        optimizer.step()

    return step


def chunk(policy, batch):
    """One sampled chunk of ten Euler steps."""

    def sample() -> None:
        policy.eval()
        policy.sample_actions(batch)

    return sample


def memory_key_computations(policy, batch) -> int:
    """How often the modulator projects memory to keys and values while a chunk is sampled."""
    calls = []
    handle = policy.integration.layers[0].kv.register_forward_hook(lambda *_: calls.append(1))
    chunk(policy, batch)()
    handle.remove()
    return len(calls)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backbone", default="tiny")
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument(
        "--models", nargs="+", default=NEURAL, choices=NEURAL, metavar="NAME", help="besides pi05"
    )
    parser.add_argument(
        "--memory", nargs="*", default=[], metavar="KEY=VALUE", help="options of their memories"
    )
    parser.add_argument(
        "--cpu-time", action="store_true", help="of the process, where others use the machine too"
    )
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    models = ["pi05", *args.models]
    memory = dict(o.split("=") for o in args.memory)
    options = {name: {"memory": memory} if name != "pi05" else {} for name in models}
    policies = {
        name: build_policy(name, backbone=args.backbone, device=device, **options[name])
        for name in models
    }
    batches = {
        name: random_batch(p, args.batch, valid=p.memory.capacity if p.memory else 0).to(device)
        for name, p in policies.items()
    }
    clock, kind = (time.process_time, "CPU time") if args.cpu_time else (time.perf_counter, "time")
    print(
        f"{machine()}; backbone {args.backbone}, batch {args.batch}, {kind}, median of"
        f" {args.rounds}"
    )
    steps = alternate(
        {n: training_step(p, batches[n]) for n, p in policies.items()}, args.rounds, clock=clock
    )
    chunks = alternate(
        {n: chunk(p, batches[n]) for n, p in policies.items()}, args.rounds, clock=clock
    )
    print(
        "| model | training step | over pi05 | sampled chunk | over pi05"
        " |\n|---|---:|---:|---:|---:|"
    )
    for name in models:
        cells = [f"{1e3 * t[name]:.0f} ms | {t[name] / t['pi05']:.2f}x" for t in (steps, chunks)]
        print(f"| `{name}` | {' | '.join(cells)} |")
    for name in (name for name in models if name.endswith("modul")):
        count = memory_key_computations(policies[name], batches[name])
        print(
            f"{name} computes memory keys and values {count} time(s) per chunk of 10 steps (first"
            " layer)"
        )


if __name__ == "__main__":
    main()
