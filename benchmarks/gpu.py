r"""What this GPU does with the library: a table, a JSON file, and exit code 1 where it is below the
goals.

    python benchmarks/gpu.py [--models pi05 tokendrop_expert] [--batch 8] [--attention auto] \
        [--output gpu.json]
    # adds what many processes take to that file
    torchrun --nproc-per-node 8 benchmarks/gpu.py --output gpu.json
    # tries the program out; judges nothing
    python benchmarks/gpu.py --backbone tiny --device cpu --rounds 2

For each model: an update (forward, backward, clipping, AdamW, EMA; layers compiled unless --eager)
with its model and hardware FLOP utilisation, samples/s and peak memory, and the share of time that
updates wait for the embedded demonstrations; a chunk eager, with compiled layers, and as one CUDA
graph of these (p50, p99), and how far they lie apart. LeRobot's PI05 beside it, where it is
installed. For attention alone: every backend's time and error against float32, and a sweep over
lengths for numbers that are none. Under a launcher: an update over all processes, weights whole
(ddp) and shared (fsdp), one line each. Goals: 50 % of the peak in training, 15 ms a chunk.
"""

import argparse
import gc
import json
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from gpu_setup import Setup, batch_of, built, draws_of, join_processes, milliseconds
from gpu_training import feeding, training
from timing import machine
from torch import Tensor, distributed
from torch.nn import functional

from mme_vla.backbone.layers import MaskLayout, Span, attend, build_mask
from mme_vla.integration.base import MEMORY_VISIBILITY

GOAL_MFU, GOAL_CHUNK_MS = 0.5, 15.0
NOT_MEASURED = "not measured"
PARTS = ("training", "feeding", "chunk", "lerobot", "attention")
Projections = tuple[Tensor, Tensor, Tensor]  # queries, keys, values


def chunks(model: str, setup: Setup) -> dict[str, Any]:
    """A chunk of one episode each way: p50 and p99, and the largest difference from
    the eager one.
    """
    device = setup.device
    policy = built(model, setup.backbone, device).to(setup.dtype).eval().requires_grad_(False)
    batch = replace(batch_of(policy, 1, device), actions=None)
    noise = draws_of(policy, 1, device)["noise"]
    with torch.no_grad(), policy.autocast():
        memory = policy.encode_memory(batch.history)
    rows: dict[str, Any] = {}
    reference: Tensor | None = None

    def measure(way: str) -> None:
        nonlocal reference
        took = milliseconds(
            lambda: policy.sample_actions(batch, noise, memory=memory), setup.rounds, 3, device
        )
        chunk = policy.sample_actions(batch, noise, memory=memory).float()
        reference = chunk if reference is None else reference
        rows[way] = {
            "p50_ms": statistics.median(took),
            "p99_ms": took[min(int(0.99 * len(took)), len(took) - 1)],
            "difference": float((chunk - reference).abs().max()),
        }

    measure("eager")
    if device.type == "cuda":
        policy.compile_sampling()
        measure("graph")
    if setup.compiled:
        policy.compile_sampling(layers=True)
        if device.type == "cuda":
            policy._sampler, captured = None, policy._sampler
            measure("compiled")
            policy._sampler = captured
            measure("compiled graph")
        else:
            measure("compiled")
    return rows


def attention_rows(
    setup: Setup, lengths: Sequence[int] = (512, 512, 64, 20), width: int = 256
) -> dict[str, Any]:
    """Attention alone, with memory, images, prompt and actions so long: each backend's time and
    error.
    """
    spans = [Span(name, length) for name, length in zip(MEMORY_VISIBILITY, lengths, strict=True)]
    rows: dict[str, Any] = {}
    for backend in ("sdpa", "flex", "varlen"):
        if backend == "flex" and setup.device.type != "cuda":
            rows[backend] = NOT_MEASURED  # it has no backward pass there
            continue
        mask_layout, tensors, exact, gradients = _attention_case(spans, setup, width)
        mask = build_mask(mask_layout, setup.dtype, backend, compiled=False)

        def both(tensors: Projections = tensors, mask: Any = mask) -> Tensor:
            for x in tensors:
                x.grad = None
            output = attend(*tensors, mask)
            output.sum().backward()
            return output

        output = both().detach()
        rows[backend] = {
            "ms": statistics.median(milliseconds(both, setup.rounds, 2, setup.device)),
            "error": float((output.float() - exact).abs().max()),
            "gradient_error": max(
                float((x.grad.float() - expected).abs().max() / expected.abs().max())
                for x, expected in zip(tensors, gradients, strict=True)
                if x.grad is not None
            ),
        }
    return rows


def _attention_case(
    spans: Sequence[Span], setup: Setup, width: int
) -> tuple[MaskLayout, Projections, Tensor, list[Tensor]]:
    """Rows that attend, their queries, keys and values, and in float32 the answers and the
    gradients of their sum.
    """
    n = sum(span.length for span in spans)
    generator = torch.Generator().manual_seed(n)
    valid = (torch.rand(setup.batch, n, generator=generator) < 0.8).to(setup.device)
    mask_layout = MaskLayout.of(spans, spans, valid, MEMORY_VISIBILITY)
    sizes = [(setup.batch, n, heads, width) for heads in (8, 1, 1)]
    first, second, third = (
        torch.randn(size, generator=generator).to(setup.device, setup.dtype) for size in sizes
    )
    leaves = [x.float().requires_grad_() for x in (first, second, third)]
    q, k, v = (x.transpose(1, 2) for x in leaves)
    logits = (q @ k.transpose(-1, -2) * width**-0.5).masked_fill(
        ~mask_layout.expand(mask_layout.visible)[:, None], -torch.inf
    )
    exact = (logits.softmax(-1) @ v).transpose(1, 2).flatten(2)
    exact.sum().backward()
    tensors = (first.requires_grad_(), second.requires_grad_(), third.requires_grad_())
    return mask_layout, tensors, exact.detach(), [x.grad for x in leaves if x.grad is not None]


def nan_sweep(setup: Setup, lengths: Sequence[int], width: int = 256) -> list[str]:
    """Where an answer or a gradient is no number: backend and number of keys."""
    broken = []
    for n_images in lengths:
        spans = [
            Span("memory", 64),
            Span("images", n_images),
            Span("prompt", 48),
            Span("action", 16),
        ]
        for backend in (
            ("sdpa", "varlen") if setup.device.type != "cuda" else ("sdpa", "flex", "varlen")
        ):
            mask_layout, tensors, *_ = _attention_case(spans, setup, width)
            output = attend(*tensors, build_mask(mask_layout, setup.dtype, backend, compiled=False))
            functional.mse_loss(output, torch.zeros_like(output)).backward()
            if not all(
                torch.isfinite(x).all()
                for x in (output, *(x.grad for x in tensors if x.grad is not None))
            ):
                broken.append(f"{backend} at {64 + n_images + 48 + 16} keys")
    return broken


def judge(result: dict[str, Any]) -> list[str]:
    """What is below the goals."""
    failures = [f"NaN: {where}" for where in result.get("nan", ())]
    for model, row in result["models"].items():
        update = row.get("training")
        if update and not update["finite"]:
            failures.append(f"{model}: a loss is no number")
        if update and update["mfu"] is not None and update["mfu"] < GOAL_MFU:
            failures.append(f"{model}: MFU {update['mfu']:.0%} is below {GOAL_MFU:.0%}")
        best = min((way["p50_ms"] for way in row.get("chunk", {}).values()), default=0.0)
        if result["device"] == "cuda" and best > GOAL_CHUNK_MS:
            failures.append(f"{model}: a chunk takes {best:.1f} ms, more than {GOAL_CHUNK_MS:.0f}")
    return failures


def show_model(model: str, row: dict[str, Any]) -> None:
    """Print what of one model was measured."""
    if "training" in row:
        print(_of_update(model, row["training"]))
    if "feeding" in row:
        fed = row["feeding"]
        print(
            f"{model}: from {fed['workers']} reading processes {fed['samples_per_s']:.1f}"
            f" samples/s, {fed['waiting']:.0%} of the time waiting for data"
        )
    for way, took in row.get("chunk", {}).items():
        apart = f", differs by {took['difference']:.1e}" if "difference" in took else ""
        print(
            f"{model}: chunk, {way}: p50 {took['p50_ms']:.1f} ms, p99 {took['p99_ms']:.1f}{apart}",
            flush=True,
        )


def show_attention(result: dict[str, Any]) -> None:
    """Print what attention alone takes, and where it fails."""
    for backend, row in result["attention"].items():
        text = row
        if not isinstance(row, str):
            errors = f"error {row['error']:.1e}, of gradients {row['gradient_error']:.1e}"
            text = f"{row['ms']:.2f} ms forward and backward, {errors}"
        print(f"attention, {backend}: {text}")
    print("NaN sweep:", ", ".join(result["nan"]) or "none", flush=True)


def _of_update(who: str, update: dict[str, Any]) -> str:
    mfu = (
        NOT_MEASURED
        if update.get("mfu") is None
        else f"{update['mfu']:.1%} (HFU {update['hfu']:.1%})"
    )
    gib = NOT_MEASURED if update["peak_gib"] is None else f"{update['peak_gib']:.1f} GiB"
    return (
        f"{who}: update {update['ms']:.1f} ms, {update['samples_per_s']:.1f} samples/s, MFU {mfu},"
        f" peak {gib}"
    )


def alone(
    result: dict[str, Any], models: Sequence[str], parts: Sequence[str], setup: Setup, workers: int
) -> Iterator[None]:
    """Add to `result` what one process measures, one row at a time."""
    result |= {
        "machine": machine(),
        "device": setup.device.type,
        "cudnn": torch.backends.cudnn.version(),
    }
    rows: dict[str, dict[str, Any]] = result.setdefault("models", {})
    print(f"{result['machine']}; cuDNN {result['cudnn']}", flush=True)
    measures: dict[str, Callable[[str], dict[str, Any]]] = {
        "training": lambda model: training(model, setup),
        "feeding": lambda model: feeding(model, setup, workers),
        "chunk": lambda model: chunks(model, setup),
    }
    for model in models:
        for part in (part for part in measures if part in parts):
            rows.setdefault(model, {})[part] = measures[part](model)
            gc.collect()
            show_model(model, {part: rows[model][part]})
            yield
    if "lerobot" in parts and not find_spec("transformers"):
        print(
            "LeRobot's PI05: not measured, since transformers is not installed (the extra `vlm`"
            " has it)"
        )
    elif "lerobot" in parts:
        from gpu_lerobot import lerobot_row

        result["lerobot"] = lerobot_row(setup)
        gc.collect()
        show_model("LeRobot's PI05", result["lerobot"])
        yield
    if "attention" in parts:
        small = setup.device.type != "cuda"
        result["attention"] = (
            attention_rows(setup, (32, 32, 8, 4), 32) if small else attention_rows(setup)
        )
        result["nan"] = nan_sweep(
            setup, range(8, 24, 8) if small else range(256, 640, 4), 32 if small else 256
        )
        show_attention(result)
        yield


def together(models: Sequence[str], setup: Setup) -> dict[str, Any]:
    """An update over all processes, of each model and each way to share it."""
    rows: dict[str, Any] = {}
    for model in models:
        for strategy in ("ddp", "fsdp"):
            rows[f"{model}, {strategy}"] = training(model, setup, strategy)
            gc.collect()
    return rows


def write(output: Path | None, result: dict[str, Any]) -> None:
    """Keep what was measured so far."""
    if output is not None:
        output.write_text(json.dumps(result, indent=2) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, write; 1 where a goal is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", nargs="+", default=["pi05", "tokendrop_expert"])
    parser.add_argument("--backbone", default="pi05", help="a file of configs/backbone")
    parser.add_argument("--batch", type=int, default=8, help="samples a process")
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument(
        "--workers", type=int, default=8, help="processes that read the demonstrations"
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--attention", default="auto", help="backend in training: auto, sdpa, flex or varlen"
    )
    parser.add_argument("--eager", action="store_true", help="compile no layers")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what is measured")
    parser.add_argument(
        "--output", type=Path, help="a JSON file, written after each row; rows that it has are kept"
    )
    args = parser.parse_args(arguments)
    device, rank, processes = join_processes(args.device)
    setup = Setup(
        args.backbone, args.batch, args.rounds, device, not args.eager, args.attention, processes
    )
    result: dict[str, Any] = {}
    if args.output is not None and args.output.exists():
        result = json.loads(args.output.read_text())
    failures = []
    if processes == 1:
        for _ in alone(result, args.models, args.parts, setup, args.workers):
            write(args.output, result)
        failures = judge(result)
    else:
        rows = together(args.models, setup)
        result.setdefault("processes", {})[str(processes)] = rows
        failures = [f"{who}: a loss is no number" for who, row in rows.items() if not row["finite"]]
        if rank == 0:
            for who, row in rows.items():
                print(_of_update(f"{who}, {processes} processes", row), flush=True)
            write(args.output, result)
        distributed.destroy_process_group()
    for failure in failures if rank == 0 else ():
        print("BELOW THE GOAL:", failure)
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
