"""What this GPU does with the library: a table, a JSON file, and exit code 1 where it is below the goals.

    python benchmarks/gpu.py [--models pi05 tokendrop_expert] [--batch 8] [--attention auto] [--output gpu.json]
    python benchmarks/gpu.py --backbone tiny --device cpu --rounds 2     # tries the program out; judges nothing

For each model: an update (forward, backward, clipping, AdamW, EMA; layers compiled unless --eager) with its model and
hardware FLOP utilisation, samples/s and peak memory; a chunk eager, with compiled layers, and as one CUDA graph of
these (p50, p99), and how far they lie apart. For attention alone: every backend's time and error against float32, and
a sweep over lengths for numbers that are none. Goals: 50 % of the peak in training, 15 ms a chunk.
"""

import argparse
import gc
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from timing import machine
from torch import Tensor
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from mme_vla import MMEPolicy, build_policy
from mme_vla.backbone.layers.attention import attend, look
from mme_vla.backbone.layers.blocks import Span
from mme_vla.backbone.layers.sight import Sight
from mme_vla.evaluation.analyses.cost import flops
from mme_vla.integration.base import MEMORY_VISIBILITY
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.training.ema import EMA
from mme_vla.training.optim import clip_gradients, make_optimizer
from mme_vla.training.settings import TrainSettings
from mme_vla.types import Batch

GOAL_MFU, GOAL_CHUNK_MS = 0.5, 15.0
PEAKS = {"H100 PCIe": 756, "H100": 989, "H200": 989, "GH200": 989, "B200": 2250, "A100": 312, "A40": 150, "L40S": 362,
         "RTX 4090": 165, "RTX 3090": 71}  # fmt: skip
"""Dense bfloat16 TFLOP/s by a part of the device's name, the first that fits; vendors' data sheets."""
NOT_MEASURED = "not measured"


@dataclass
class Setup:
    """What is measured: sizes, device and how often."""

    backbone: str
    batch: int
    rounds: int
    device: torch.device
    compiled: bool
    attention: str

    @property
    def dtype(self) -> torch.dtype:
        return torch.bfloat16 if self.device.type == "cuda" else torch.float32


def peak_flops(device: torch.device) -> float | None:
    """FLOP/s of this GPU's tensor cores in bfloat16; None where the table does not know it."""
    if device.type != "cuda":
        return None
    name = torch.cuda.get_device_name(device)
    return next((1e12 * peak for part, peak in PEAKS.items() if part in name), None)


def milliseconds(work: Callable[[], object], rounds: int, warmup: int, device: torch.device) -> list[float]:
    """How long each round takes, the device's work included."""
    found = []
    for index in range(warmup + rounds):
        _wait(device)
        begun = time.perf_counter()
        work()
        _wait(device)
        if index >= warmup:
            found.append(1e3 * (time.perf_counter() - begun))
    return sorted(found)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def sample_flops(model: str, backbone: str) -> tuple[int, int]:
    """FLOPs of a sample's forward and backward pass with a frozen tower, counted on the meta device.

    Returns:
        What the model needs, and what is computed: recurrent memories compute their window twice.
    """
    policy = _built(model, backbone, torch.device("meta"))
    batch = policy.full_batch("meta")
    with FlopCounterMode(display=False) as counter:
        policy(batch, _draws(policy, 1, torch.device("meta")))[0].backward()
    computed = counter.get_total_flops()
    again = 0
    if isinstance(policy.memory, RecurrentMemory):
        memory, history = policy.memory, batch.history
        again = flops(lambda: memory(history))
    return computed - again, computed


def _built(model: str, backbone: str, device: torch.device, attention: str = "auto") -> MMEPolicy:
    options: dict[str, Any] = {"policy.augment": False}
    if device.type == "cuda":
        options["policy.compute_dtype"] = "bfloat16"
    policy = build_policy(model, backbone=backbone, device=device, **options)
    assert isinstance(policy, MMEPolicy)
    policy.backbone.choose_attention(attention)
    policy.backbone.vision.requires_grad_(False)
    return policy.train()


def _batch(policy: MMEPolicy, size: int, device: torch.device) -> Batch:
    full = policy.full_batch(device)
    batch = full.rows(torch.zeros(size, dtype=torch.int64, device=device))
    mask = batch.prompt_mask.clone()
    mask[:, -3:] = False  # prompts have padding, as they do in training
    return replace(batch, prompt_mask=mask)


def _draws(policy: MMEPolicy, size: int, device: torch.device) -> dict[str, Tensor]:
    drawn = policy.loss_draws(size, torch.Generator().manual_seed(0))
    return {name: value.to(device) for name, value in drawn.items()}


def training(model: str, setup: Setup) -> dict[str, Any]:
    """An update of one model, and what of the GPU it uses."""
    device = setup.device
    policy = _built(model, setup.backbone, device, setup.attention)
    if setup.compiled:
        policy.compile()
    batch, draws = _batch(policy, setup.batch, device), _draws(policy, setup.batch, device)
    learning = {name: p for name, p in policy.named_parameters() if p.requires_grad}
    optimizer = make_optimizer(learning.values(), TrainSettings(steps=1, batch_size=setup.batch, lr=1e-5))
    ema, losses = EMA(learning, 0.999), []

    def update() -> None:
        loss, _ = policy(batch, draws)
        loss.backward()
        clip_gradients([p.grad for p in learning.values() if p.grad is not None], 1.0)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        ema.update(0)
        losses.append(loss.detach())

    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    took = milliseconds(update, setup.rounds, 3, device)
    median, peak = statistics.median(took), peak_flops(device)
    needed, computed = sample_flops(model, setup.backbone)
    per_flop = None if peak is None else setup.batch / (median / 1e3) / peak
    return {
        "ms": median, "samples_per_s": 1e3 * setup.batch / median, "tflop_per_sample": needed / 1e12,
        "mfu": None if per_flop is None else needed * per_flop,
        "hfu": None if per_flop is None else computed * per_flop,
        "peak_gib": torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else None,
        "finite": bool(torch.isfinite(torch.stack(losses)).all()),
    }  # fmt: skip


def chunks(model: str, setup: Setup) -> dict[str, Any]:
    """A chunk of one episode each way: p50 and p99, and the largest difference from the eager one."""
    device = setup.device
    policy = _built(model, setup.backbone, device).to(setup.dtype).eval().requires_grad_(False)
    batch = replace(_batch(policy, 1, device), actions=None)
    noise = _draws(policy, 1, device)["noise"]
    with torch.no_grad(), policy.autocast():
        memory = policy.encode_memory(batch.history)
    found: dict[str, Any] = {}
    reference: Tensor | None = None

    def measure(way: str) -> None:
        nonlocal reference
        took = milliseconds(lambda: policy.sample_actions(batch, noise, memory=memory), setup.rounds, 3, device)
        chunk = policy.sample_actions(batch, noise, memory=memory).float()
        reference = chunk if reference is None else reference
        found[way] = {
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
    return found


def attention_rows(setup: Setup, lengths: Sequence[int] = (512, 512, 64, 20), width: int = 256) -> dict[str, Any]:
    """Attention alone, with memory, pictures, prompt and actions so long: each backend's time and error."""
    spans = [Span(name, length) for name, length in zip(MEMORY_VISIBILITY, lengths, strict=True)]
    found: dict[str, Any] = {}
    for backend in ("sdpa", "flex", "varlen"):
        if backend == "flex" and setup.device.type != "cuda":
            found[backend] = NOT_MEASURED  # it has no backward pass there
            continue
        sight, tensors, exact = _attention_case(spans, setup, width)
        seen = look(sight, setup.dtype, backend, compiled=False)

        def both(tensors: list[Tensor] = tensors, seen: Any = seen) -> Tensor:
            for x in tensors:
                x.grad = None
            answer = attend(*tensors, seen)
            answer.sum().backward()
            return answer

        answer = both().detach()
        found[backend] = {
            "ms": statistics.median(milliseconds(both, setup.rounds, 2, setup.device)),
            "error": float((answer.float() - exact).abs().max()),
        }
    return found


def _attention_case(spans: Sequence[Span], setup: Setup, width: int) -> tuple[Sight, list[Tensor], Tensor]:
    n = sum(span.length for span in spans)
    generator = torch.Generator().manual_seed(n)
    valid = (torch.rand(setup.batch, n, generator=generator) < 0.8).to(setup.device)
    sight = Sight.of(spans, spans, valid, MEMORY_VISIBILITY)
    sizes = [(setup.batch, n, heads, width) for heads in (8, 1, 1)]
    drawn = [torch.randn(size, generator=generator).to(setup.device, setup.dtype) for size in sizes]
    q, k, v = (x.float().transpose(1, 2) for x in drawn)
    logits = (q @ k.transpose(-1, -2) * width**-0.5).masked_fill(~sight.spread(sight.seen)[:, None], -torch.inf)
    exact = (logits.softmax(-1) @ v).transpose(1, 2).flatten(2)
    return sight, [x.requires_grad_() for x in drawn], exact


def nan_sweep(setup: Setup, lengths: Sequence[int], width: int = 256) -> list[str]:
    """Where an answer or a gradient is no number: backend and number of keys."""
    broken = []
    for pictures in lengths:
        spans = [Span("memory", 64), Span("images", pictures), Span("prompt", 48), Span("action", 16)]
        for backend in ("sdpa", "varlen") if setup.device.type != "cuda" else ("sdpa", "flex", "varlen"):
            sight, tensors, _ = _attention_case(spans, setup, width)
            answer = attend(*tensors, look(sight, setup.dtype, backend, compiled=False))
            functional.mse_loss(answer, torch.zeros_like(answer)).backward()
            if not all(torch.isfinite(x).all() for x in (answer, *(x.grad for x in tensors if x.grad is not None))):
                broken.append(f"{backend} at {64 + pictures + 48 + 16} keys")
    return broken


def judge(result: dict[str, Any]) -> list[str]:
    """What is below the goals."""
    failures = [f"NaN: {where}" for where in result["nan"]]
    for model, row in result["models"].items():
        update, ways = row["training"], row["chunk"]
        if not update["finite"]:
            failures.append(f"{model}: a loss is no number")
        if update["mfu"] is not None and update["mfu"] < GOAL_MFU:
            failures.append(f"{model}: MFU {update['mfu']:.0%} is below {GOAL_MFU:.0%}")
        best = min(way["p50_ms"] for way in ways.values())
        if result["device"] == "cuda" and best > GOAL_CHUNK_MS:
            failures.append(f"{model}: a chunk takes {best:.1f} ms, more than {GOAL_CHUNK_MS:.0f}")
    return failures


def show(result: dict[str, Any]) -> None:
    """The table."""
    print(f"{result['machine']}; cuDNN {result['cudnn']}")
    for model, row in result["models"].items():
        update = row["training"]
        mfu = NOT_MEASURED if update["mfu"] is None else f"{update['mfu']:.1%} (HFU {update['hfu']:.1%})"
        gib = NOT_MEASURED if update["peak_gib"] is None else f"{update['peak_gib']:.1f} GiB"
        print(f"{model}: update {update['ms']:.1f} ms, {update['samples_per_s']:.1f} samples/s, MFU {mfu}, peak {gib}")
        for way, took in row["chunk"].items():
            print(f"  chunk, {way}: p50 {took['p50_ms']:.1f} ms, p99 {took['p99_ms']:.1f}, "
                  f"differs by {took['difference']:.1e}")  # fmt: skip
    for backend, row in result["attention"].items():
        told = row if isinstance(row, str) else f"{row['ms']:.2f} ms forward and backward, error {row['error']:.1e}"
        print(f"attention, {backend}: {told}")
    print("NaN sweep:", ", ".join(result["nan"]) or "none")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, write; 1 where a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=["pi05", "tokendrop_expert"])
    parser.add_argument("--backbone", default="pi05", help="a file of configs/backbone")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--attention", default="auto", help="backend in training: auto, sdpa, flex or varlen")
    parser.add_argument("--eager", action="store_true", help="compile no layers")
    parser.add_argument("--output", type=Path, help="a JSON file")
    given = parser.parse_args(arguments)
    setup = Setup(given.backbone, given.batch, given.rounds, torch.device(given.device), not given.eager,
                  given.attention)  # fmt: skip
    result: dict[str, Any] = {"machine": machine(), "device": setup.device.type, "models": {}}
    result["cudnn"] = torch.backends.cudnn.version()
    for model in given.models:
        result["models"][model] = {"training": training(model, setup)}
        gc.collect()
        result["models"][model]["chunk"] = chunks(model, setup)
        gc.collect()
    small = setup.device.type != "cuda"
    result["attention"] = attention_rows(setup, (32, 32, 8, 4), 32) if small else attention_rows(setup)
    result["nan"] = nan_sweep(setup, range(8, 24, 8) if small else range(256, 640, 4), 32 if small else 256)
    show(result)
    if given.output is not None:
        given.output.write_text(json.dumps(result, indent=2) + "\n")
    failures = judge(result)
    for failure in failures:
        print("BELOW THE GOAL:", failure)
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
