"""What every model costs: FLOPs counted at full size, time and peak memory measured at tiny size.

    # all four without a choice
    python benchmarks/cost.py [--count] [--budgets] [--time] [--memory] [--models …]

FLOPs are counted by `mme_vla.extras.probing.analyses.cost`, which says what counts;
`python -m mme_vla.analyse cost` prints them as well.
"""

import argparse
import subprocess
import sys

import torch
from timing import alternate, machine
from variants import chunk, training_step

from mme_vla import build_policy
from mme_vla.config.composition import compose
from mme_vla.extras.probing.analyses.cost import count_model
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import ALL_BEYOND, ALL_MODELS, NEURAL, random_batch
from mme_vla.training.logging import resident_gib
from mme_vla.types import Batch

TERA = 1e12
BUDGETS = (64, 128, 256, 512, 1024)
OF_BUDGETS = ("framesamp_modul", "tokendrop_expert")


def full_batch(policy: MMEPolicy, batch: int, prompt: int) -> Batch:
    """Noise images, a prompt of `prompt` tokens without padding, and a memory that is full."""
    made = random_batch(policy, batch, valid=policy.memory.capacity if policy.memory else 0)
    made.prompt = torch.full((batch, prompt), 5)
    made.prompt_mask = torch.ones(batch, prompt, dtype=torch.bool)
    return made


def count(models: list[str]) -> None:
    """Parameters and FLOPs of the models at full size."""
    print(
        "| model | prompt | parameters | forward pass | sampled chunk | over `pi05` | memory, of"
        " these | streamed | past frames |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|"
    )
    reference = count_model("pi05").chunk
    for model in models:
        model_cost = count_model(model)
        cells = [
            str(model_cost.prompt),
            f"{model_cost.parameters / 1e6:,.1f} M",
            f"{model_cost.forward / TERA:.3f} T",
            f"{model_cost.chunk / TERA:.3f} T",
            f"{model_cost.chunk / reference:.2f}x",
            f"{model_cost.memory / TERA:.4f} T" if model_cost.memory else "",
            "" if model_cost.streamed is None else f"{model_cost.streamed / TERA:.4f} T",
            f"{model_cost.frames / TERA:.3f} T" if model in (*NEURAL, *ALL_BEYOND) else "",
        ]
        print(f"| `{model}` | {' | '.join(cells)} |")


def budgets() -> None:
    """FLOPs over the memory budget at full size."""
    head = " | ".join(f"{budget:,}" for budget in BUDGETS)
    print(f"| model | | {head} |\n|---|---|{'---:|' * len(BUDGETS)}")
    for model in OF_BUDGETS:
        costs = [count_model(model, budget) for budget in BUDGETS]
        rows = {
            "forward pass": [cost.forward for cost in costs],
            "sampled chunk": [cost.chunk for cost in costs],
        }
        for what, values in rows.items():
            print(
                f"| `{model}` | {what} |"
                f" {' | '.join(f'{value / TERA:.3f} T' for value in values)} |"
            )


def prompt_length(model: str) -> int:
    """Tokens of the prompt, as the model's own file says."""
    return compose("policy", [f"model={model}", "backbone=pi05"]).processor.prompt_length


def tiny(model: str, batch: int) -> tuple[MMEPolicy, Batch]:
    """A tiny model and a full batch: 512 memory tokens, every window full."""
    policy = build_policy(model, backbone="tiny")
    return policy, full_batch(policy, batch, prompt_length(model))


def measure_time(models: list[str], batch: int, rounds: int) -> None:
    """Median times of the models at tiny size, taking turns; those over `pi05` where
    it takes part.
    """
    made = {model: tiny(model, batch) for model in models}
    steps = alternate(
        {model: training_step(*parts) for model, parts in made.items()}, rounds, warmup=1
    )
    chunks = alternate({model: chunk(*parts) for model, parts in made.items()}, rounds, warmup=1)
    print(f"{machine()}; tiny, batch {batch}, median of {rounds}")
    print(
        "| model | training step | over `pi05` | sampled chunk | over `pi05`"
        " |\n|---|---:|---:|---:|---:|"
    )
    for model in models:
        cells = [
            f"{1e3 * t[model]:,.0f} ms | " + (f"{t[model] / t['pi05']:.2f}x" if "pi05" in t else "")
            for t in (steps, chunks)
        ]
        print(f"| `{model}` | {' | '.join(cells)} |", flush=True)


def peak_mib() -> float:
    """Most resident memory this process has had."""
    return resident_gib() * 1024


def peaks_of(model: str, batch: int) -> None:
    """In a process of its own: print the peak with the model built, after a chunk, and after two
    training steps.
    """
    policy, made = tiny(model, batch)
    peaks = [peak_mib()]
    chunk(policy, made)()
    peaks.append(peak_mib())
    step = training_step(policy, made)
    for _ in range(2):  # AdamW makes its moments in the first
        step()
    print(*peaks, peak_mib())


def measure_memory(models: list[str], batch: int, threads: int) -> None:
    """Peak resident memory at tiny size, a process for each model, and what of it came after the
    model was built.
    """
    print(
        "| model | sampled chunk | of this working memory | training step | of this working"
        " memory |"
    )
    print("|---|---:|---:|---:|---:|")
    for model in models:
        command = [
            sys.executable,
            __file__,
            "--child",
            model,
            "--batch",
            str(batch),
            "--threads",
            str(threads),
        ]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        built, *peaks = map(float, done.stdout.split())
        cells = [f"{peak:,.0f} MiB | {peak - built:,.0f} MiB" for peak in peaks]
        print(f"| `{model}` | {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", action="store_true", help="FLOPs of every model at full size")
    parser.add_argument(
        "--budgets", action="store_true", help="FLOPs over the memory budget at full size"
    )
    parser.add_argument("--time", action="store_true", help="times at tiny size")
    parser.add_argument("--memory", action="store_true", help="peak memory at tiny size")
    parser.add_argument("--batch", type=int, default=4, help="of what is measured")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--models",
        nargs="+",
        default=ALL_MODELS,
        choices=[*ALL_MODELS, *ALL_BEYOND],
        metavar="NAME",
    )
    parser.add_argument("--child", help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.child:
        peaks_of(args.child, args.batch)
        return
    every = not (args.count or args.budgets or args.time or args.memory)
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
