r"""What this GPU does with the library: a table, a JSON file, and exit code 1 where it is below the
goals.

    # begins no row after nine minutes; once more: the next rows
    python benchmarks/gpu.py --output gpu.json
    python benchmarks/gpu.py --parts chunk --models pi05
    # adds what many processes take to that file
    torchrun --nproc-per-node 8 benchmarks/gpu.py --output gpu.json
    # tries the program out, on a CPU or a mock driver; judges nothing
    python benchmarks/gpu.py --rehearse --backbone tiny --rounds 1 --batch 1

Rows, most valuable first: `attention` (time and error of every backend against float32, and a sweep
over lengths for numbers that are none); `chunk` of each model (eager, one CUDA graph, a graph of
compiled layers: p50, p99, how far apart, and how long the first chunk took); `profile`, the ten
slowest kernels of a compiled chunk; `training`, an update (forward, backward, clipping, AdamW, EMA)
at each batch, compiled, with model and hardware FLOP utilisation, samples/s and peak memory;
`tuned`, a compiled chunk with one more switch of Inductor; `start`, how long a server compiles, and
once more with the code on disk; `lerobot`, its PI05 beside these; `openpi`, `pi05` with the
settings of openpi (prompt of 200, chunk of 50, all weights trained); the updates once more, eager;
`feeding`, the share of time that updates wait for the embedded demonstrations. No row begins after
`--minutes`, nor where one as long as the longest of its kind would end later; what was not reached
is named. Rows that the output file has are kept, except those that failed. Under a launcher: an
update over all processes, weights whole (ddp) and shared (fsdp). Goals: 50 % of the peak in
training, 15 ms a chunk.
"""

import argparse
import gc
import json
import math
import os
import statistics
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import torch
import torch._inductor.config as inductor_config
from gpu_setup import OPENPI, Setup, batch_of, built, draws_of, join_processes, milliseconds, wait
from gpu_training import feeding, training
from timing import machine
from torch import Tensor, distributed
from torch.autograd import DeviceType
from torch.nn import functional
from torch.nn.attention import (
    activate_flash_attention_impl,
    list_flash_attention_impls,
    restore_flash_attention_impl,
)

from mme_vla import MMEPolicy
from mme_vla.backbone.layers import MaskLayout, Span, attend, build_mask
from mme_vla.integration.base import MEMORY_VISIBILITY
from mme_vla.speed.compiler import CACHE_VARIABLE, keep_compiled_code

GOAL_MFU, GOAL_CHUNK_MS = 0.5, 15.0
NOT_MEASURED = "not measured"
NO_MEMORY = "not enough memory"
PARTS = (
    "attention",
    "chunk",
    "profile",
    "training",
    "tuned",
    "start",
    "lerobot",
    "openpi",
    "feeding",
)
MODELS = ("pi05", "framesamp_modul", "tokendrop_expert", "ttt_expert", "rmt_context")
TUNINGS: dict[str, dict[str, Any]] = {
    "autotuned products": {"max_autotune_gemm": True},
    "dependent launch": {"triton.enable_pdl": True},
}
"""Switches of Inductor that `sampling=compiled` leaves off: each chooses or starts the kernels of a
chunk otherwise. `TORCHINDUCTOR_MAX_AUTOTUNE_GEMM=1` and `TORCHINDUCTOR_ENABLE_PDL=1` set them.
"""
Projections = tuple[Tensor, Tensor, Tensor]  # queries, keys, values


def sampler_of(model: str, setup: Setup) -> tuple[MMEPolicy, Callable[[], Tensor]]:
    """A policy, and what samples a chunk of one episode from its ready memory tokens."""
    device = setup.device
    policy = built(model, setup.backbone, device).to(setup.dtype).eval().requires_grad_(False)
    batch = replace(batch_of(policy, 1, device), actions=None)
    noise = draws_of(policy, 1, device)["noise"]
    with torch.no_grad(), policy.autocast():
        memory = policy.model.memory_tokens(batch)
    return policy, partial(policy.sample_actions, batch, noise, memory=memory)


def timed_chunk(
    policy: MMEPolicy,
    sample: Callable[[], Tensor],
    reference: Tensor,
    setup: Setup,
    layers: bool | None = None,
) -> dict[str, float]:
    """p50 and p99 of a chunk, its largest difference from the eager one, and the seconds until the
    first one is there.

    Args:
        layers: compile the sampler with its layers or without; None leaves it as it is.
    """
    begun = time.perf_counter()
    if layers is not None:
        processor = policy.processor
        policy.processor = None  # no length of prompt is compiled beforehand
        policy.compile_sampling(layers)
        policy.processor = processor
    chunk = sample().float()
    difference = float((chunk - reference).abs().max())  # waits for the device
    start_s = time.perf_counter() - begun
    took = milliseconds(sample, setup.rounds, 3, setup.device)
    return {
        "p50_ms": statistics.median(took),
        "p99_ms": took[min(int(0.99 * len(took)), len(took) - 1)],
        "difference": difference,
        "largest": float(reference.abs().max()),
        "start_s": start_s,
    }


def chunks(model: str, setup: Setup) -> dict[str, Any]:
    """A chunk of one episode each way: eager, one CUDA graph, a graph of compiled layers."""
    policy, sample = sampler_of(model, setup)
    reference = sample().float()
    rows = {"eager": timed_chunk(policy, sample, reference, setup)}
    on_gpu = setup.device.type == "cuda"
    if on_gpu:
        rows["graph"] = timed_chunk(policy, sample, reference, setup, layers=False)
    if setup.compiled:
        way = "compiled graph" if on_gpu else "compiled"
        rows[way] = timed_chunk(policy, sample, reference, setup, layers=True)
    return rows


def tuned_chunk(model: str, setup: Setup, options: dict[str, Any]) -> dict[str, Any]:
    """A chunk of compiled layers, compiled with further `options` of Inductor."""
    policy, sample = sampler_of(model, setup)
    reference = sample().float()
    with inductor_config.patch(options):
        return timed_chunk(policy, sample, reference, setup, layers=True)


def server_start(model: str, setup: Setup) -> dict[str, float]:
    """Seconds that a server compiles its sampler for every length of prompt: with the code that
    rows before this one left on disk, and with all of it there.
    """
    policy, _ = sampler_of(model, setup)
    seconds = []
    for _ in range(2):
        torch.compiler.reset()
        begun = time.perf_counter()
        policy.compile_sampling(layers=True)
        wait(setup.device)
        seconds.append(time.perf_counter() - begun)
    return {"first_s": seconds[0], "again_s": seconds[1]}


def slowest_kernels(model: str, setup: Setup, count: int = 10) -> list[dict[str, Any]] | str:
    """The kernels of one compiled chunk that take most of its time, and their share of it."""
    policy, sample = sampler_of(model, setup)
    policy.processor = None
    policy.compile_sampling(layers=setup.compiled)
    sample()
    with torch.profiler.profile() as profile:
        sample()
        wait(setup.device)
    on_gpu = setup.device.type == "cuda"
    times: dict[str, tuple[float, int]] = {}
    for event in profile.key_averages():
        took = event.self_device_time_total if on_gpu else event.self_cpu_time_total
        # A GPU's time is also that of the operation on the CPU which launched the kernel.
        on_device = event.device_type != DeviceType.CPU
        if took > 0 and on_device == on_gpu:
            times[event.key] = (took, event.count)
    total = sum(took for took, _ in times.values())
    slowest = sorted(times, key=lambda name: times[name], reverse=True)[:count]
    if not slowest:
        return f"{NOT_MEASURED}: the profiler saw no kernel, as on a mock driver"
    rows = []
    for name in slowest:
        took, calls = times[name]
        rows.append({"kernel": name, "calls": calls, "ms": took / 1e3, "share": took / total})
    return rows


def attention_rows(
    setup: Setup, lengths: Sequence[int] = (512, 512, 64, 20), width: int = 256
) -> dict[str, Any]:
    """Attention alone, with memory, images, prompt and actions so long: each backend's time and
    error, and those of `varlen` with other kernels of flash attention where their package is.
    """
    spans = [Span(name, length) for name, length in zip(MEMORY_VISIBILITY, lengths, strict=True)]
    on_gpu = setup.device.type == "cuda"
    rows: dict[str, Any] = {}
    for backend in ("sdpa", "flex", "varlen"):
        if backend == "flex" and not on_gpu:
            rows[backend] = NOT_MEASURED  # it has no backward pass there
            continue
        rows[backend] = timed_attention(backend, spans, setup, width)
    for kernels in list_flash_attention_impls() if on_gpu else ():
        row = f"varlen, {kernels}"
        try:
            activate_flash_attention_impl(kernels)
            rows[row] = timed_attention("varlen", spans, setup, width)
        except (ImportError, RuntimeError) as error:  # no package, or not for this GPU or width
            rows[row] = f"{NOT_MEASURED}: {error}"
        finally:
            restore_flash_attention_impl(_raise_warn=False)
    return rows


def timed_attention(
    backend: str, spans: Sequence[Span], setup: Setup, width: int
) -> dict[str, float]:
    """Forward and backward of one attention: milliseconds, and the error against float32."""
    mask_layout, tensors, exact, gradients = _attention_case(spans, setup, width)
    mask = build_mask(mask_layout, setup.dtype, backend, compiled=False)

    def both() -> Tensor:
        for x in tensors:
            x.grad = None
        output = attend(*tensors, mask)
        output.sum().backward()
        return output

    output = both().detach()
    return {
        "ms": statistics.median(milliseconds(both, setup.rounds, 2, setup.device)),
        "error": float((output.float() - exact).abs().max()),
        "gradient_error": max(
            float((x.grad.float() - expected).abs().max() / expected.abs().max())
            for x, expected in zip(tensors, gradients, strict=True)
            if x.grad is not None
        ),
    }


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
    broken = result.get("nan", ())
    failures = [] if _error_of(broken) else [f"NaN: {where}" for where in broken]
    for model, row in result["models"].items():
        updates = [one for one in row.get("training", {}).values() if "error" not in one]
        if not all(update["finite"] for update in updates):
            failures.append(f"{model}: a loss is no number")
        reached = [update["mfu"] for update in updates if update["mfu"] is not None]
        if reached and max(reached) < GOAL_MFU:
            failures.append(f"{model}: MFU {max(reached):.0%} is below {GOAL_MFU:.0%}")
        ways = [way for way in row.get("chunk", {}).values() if isinstance(way, dict)]
        if not all(math.isfinite(way["difference"]) for way in ways):
            failures.append(f"{model}: a chunk holds what is no number")
        best = min((way["p50_ms"] for way in ways), default=0.0)
        if result["device"] == "cuda" and best > GOAL_CHUNK_MS:
            failures.append(f"{model}: a chunk takes {best:.1f} ms, more than {GOAL_CHUNK_MS:.0f}")
    return failures


def show_model(model: str, row: dict[str, Any]) -> None:
    """Print what of one model was measured."""
    for how, update in row.get("training", {}).items():
        print(_of_update(f"{model}, {how}", update), flush=True)
    slowest = row.get("profile", [])
    if isinstance(slowest, str):
        print(f"{model}: profile: {slowest}", flush=True)
        slowest = []
    for kernel in slowest:
        print(
            f"{model}: {kernel['share']:.1%}, {kernel['ms']:.2f} ms in {kernel['calls']} ×"
            f" {kernel['kernel'][:90]}",
            flush=True,
        )
    if "start" in row:
        start = row["start"]
        print(
            f"{model}: a server compiles for {start['first_s']:.1f} s, with its code on disk"
            f" {start['again_s']:.1f} s",
            flush=True,
        )
    if "feeding" in row:
        fed = row["feeding"]
        print(
            f"{model}: from {fed['workers']} reading processes {fed['samples_per_s']:.1f}"
            f" samples/s, {fed['waiting']:.0%} of the time waiting for data"
        )
    tuned = {f"compiled, {name}": took for name, took in row.get("tuned", {}).items()}
    for way, took in {**row.get("chunk", {}), **tuned}.items():
        apart = ""
        if "difference" in took:
            apart = f", differs by {took['difference']:.1e} of {took['largest']:.1e}"
            apart += f", first after {took['start_s']:.1f} s"
        print(
            f"{model}: chunk, {way}: p50 {took['p50_ms']:.1f} ms, p99 {took['p99_ms']:.1f}{apart}",
            flush=True,
        )


def show_attention(rows: dict[str, Any]) -> None:
    """Print what attention alone takes."""
    for backend, row in rows.items():
        text = row
        if not isinstance(row, str):
            errors = f"error {row['error']:.1e}, of gradients {row['gradient_error']:.1e}"
            text = f"{row['ms']:.2f} ms forward and backward, {errors}"
        print(f"attention, {backend}: {text}", flush=True)


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


Row = tuple[list[str], Callable[[], Any], Callable[[Any], None]]
"""Where a row is in the result, how it is measured, and how it is printed."""


def rows_of(
    models: Sequence[str],
    parts: Sequence[str],
    setup: Setup,
    batches: Sequence[int],
    workers: int,
) -> list[Row]:
    """All rows that one process measures, the most valuable first."""
    small = setup.backbone != "pi05"
    rows: list[Row] = []

    def attention() -> dict[str, Any]:
        if small:
            return attention_rows(setup, (64, 40, 24, 8), 32)
        return attention_rows(setup)

    def sweep() -> list[str]:
        if small:
            return nan_sweep(setup, range(8, 24, 8), 32)
        return nan_sweep(setup, range(256, 640, 4))

    def of_model(model: str, part: str, how: str | None = None) -> Callable[[Any], None]:
        def show(value: Any) -> None:
            show_model(model, {part: value if how is None else {how: value}})

        return show

    if "attention" in parts:
        rows.append((["attention"], attention, show_attention))
        rows.append((["nan"], sweep, lambda broken: print("NaN sweep:", broken or "none")))
    if "chunk" in parts:
        for model in models:
            place = ["models", model, "chunk"]
            rows.append((place, partial(chunks, model, setup), of_model(model, "chunk")))
    if "profile" in parts:
        place = ["models", models[0], "profile"]
        slowest = partial(slowest_kernels, models[0], setup)
        rows.append((place, slowest, of_model(models[0], "profile")))
    updates: dict[bool, list[Row]] = {True: [], False: []}
    ways = (True, False) if setup.compiled else (False,)
    cases = list(product(ways, batches, models)) if "training" in parts else []
    for compiled, batch, model in cases:
        how = f"batch {batch}, {'compiled' if compiled else 'eager'}"
        measure = partial(training, model, replace(setup, batch=batch, compiled=compiled))
        place = ["models", model, "training", how]
        updates[compiled].append((place, measure, of_model(model, "training", how)))
    rows += updates[True]
    tunings = TUNINGS.items() if "tuned" in parts and setup.compiled else ()
    for name, options in tunings:
        place = ["models", models[0], "tuned", name]
        measure = partial(tuned_chunk, models[0], setup, options)
        rows.append((place, measure, of_model(models[0], "tuned", name)))
    if "start" in parts and setup.compiled:
        place = ["models", models[0], "start"]
        measure = partial(server_start, models[0], setup)
        rows.append((place, measure, of_model(models[0], "start")))
    if "lerobot" in parts and find_spec("lerobot") and find_spec("transformers"):
        rows.append((["lerobot"], partial(_beside, setup), partial(show_model, "LeRobot's PI05")))
    elif "lerobot" in parts:
        print("LeRobot's PI05: not measured, since LeRobot or transformers (`vlm`) is missing")
    if "openpi" in parts:
        measure_chunk = partial(chunks, OPENPI, setup)
        rows.append((["openpi", "chunk"], measure_chunk, of_model(OPENPI, "chunk")))
        how = f"batch {setup.batch}, {'compiled' if setup.compiled else 'eager'}"
        measure = partial(training, OPENPI, setup)
        rows.append((["openpi", "training", how], measure, of_model(OPENPI, "training", how)))
    rows += updates[False]
    if "feeding" in parts:
        place = ["models", models[0], "feeding"]
        measure = partial(feeding, models[0], setup, workers)
        rows.append((place, measure, of_model(models[0], "feeding")))
    return rows


def _beside(setup: Setup) -> dict[str, Any]:
    from gpu_lerobot import lerobot_row

    row = lerobot_row(setup)
    return {**row, "training": {f"batch {setup.batch}, eager": row["training"]}}


def alone(
    result: dict[str, Any], rows: Sequence[Row], minutes: float, output: Path | None
) -> list[str]:
    """Add the rows that `result` does not have, and write it after each.

    Name those not reached, and return those that failed: the next call measures them again.
    """
    begun = time.monotonic()
    missing, failures = [], []
    longest: dict[str, float] = {}  # seconds, by the kind of row
    for place, measure, show in rows:
        *above, name = place
        section = result
        for key in above:
            section = section.setdefault(key, {})
        if name in section and _error_of(section[name]) in (None, NO_MEMORY):
            continue
        row = " ".join(place)
        kind = place[2] if len(place) > 2 else row
        row_begun = time.monotonic()
        if row_begun - begun + longest.get(kind, 0.0) > 60 * minutes:
            missing.append(row)
            continue
        try:
            section[name] = measure()
        except torch.OutOfMemoryError:
            section[name] = {"error": NO_MEMORY}
        except Exception as error:  # the rows that follow are worth as much
            traceback.print_exc()
            section[name] = {"error": f"{type(error).__name__}: {error}"[:500]}
            failures.append(row)
        torch.compiler.reset()  # its code holds on to weights
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        seconds = time.monotonic() - row_begun
        longest[kind] = max(longest.get(kind, 0.0), seconds)
        print(f"[{row}: {seconds:.0f} s]", flush=True)
        if (failed := _error_of(section[name])) is None:
            show(section[name])
        else:
            print(f"{row}: {failed}", flush=True)
        write(output, result)
    for row in missing:
        print(f"not reached in {minutes:g} minutes: {row}. The same command resumes there.")
    return failures


def _error_of(row: Any) -> str | None:
    return row.get("error") if isinstance(row, dict) else None


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
    parser.add_argument("--models", nargs="+", default=MODELS)
    parser.add_argument("--backbone", default="pi05", help="a file of configs/backbone")
    parser.add_argument(
        "--batch", type=int, nargs="+", default=(8, 32, 16, 64), help="samples a process, in turn"
    )
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=9, help="after these no row begins")
    parser.add_argument(
        "--rehearse",
        action="store_true",
        help="judge nothing, and leave cuDNN out: a mock driver has none, and its numbers mean"
        " nothing",
    )
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
    torch.backends.cudnn.enabled = not args.rehearse
    if args.rehearse:
        inductor_config.test_configs.max_mm_configs = 1  # tries one kernel of each product
        # A mock driver computes no constant: its code would be wrong on the GPU that it stands for.
        temporary = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        os.environ.setdefault(CACHE_VARIABLE, temporary.name)
    keep_compiled_code()
    device, rank, processes = join_processes(args.device)
    setup = Setup(
        args.backbone, args.batch[0], args.rounds, device, not args.eager, args.attention, processes
    )
    result: dict[str, Any] = {}
    if args.output is not None and args.output.exists():
        result = json.loads(args.output.read_text())
    failures = []
    if processes == 1:
        result |= {
            "machine": machine(),
            "device": setup.device.type,
            "cudnn": torch.backends.cudnn.version(),
        }
        result.setdefault("models", {})
        print(f"{result['machine']}; cuDNN {result['cudnn']}", flush=True)
        rows = rows_of(args.models, args.parts, setup, args.batch, args.workers)
        failures = alone(result, rows, args.minutes, args.output)
        failures += [] if args.rehearse else judge(result)
    else:
        shared = together(args.models, setup)
        result.setdefault("processes", {})[str(processes)] = shared
        failures = [
            f"{who}: a loss is no number" for who, row in shared.items() if not row["finite"]
        ]
        if rank == 0:
            for who, row in shared.items():
                print(_of_update(f"{who}, {processes} processes", row), flush=True)
            write(args.output, result)
        distributed.destroy_process_group()
    for failure in failures if rank == 0 else ():
        print("FAILED:", failure)
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
