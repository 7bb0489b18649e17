"""Shared by the benchmarks: timing that alternates between contestants, and a line about the
machine.
"""

import platform
import statistics
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path

import torch


def synchronize() -> None:
    """Wait for the GPU, where there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def alternate(
    contestants: Mapping[str, Callable[[], object]],
    rounds: int,
    warmup: int = 2,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median seconds of each, one call of each per round, so that a slow moment of the machine
    meets all alike.

    Where others use the machine too, `clock=time.process_time` counts this process's CPU time, of
    all its threads.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for index in range(warmup + rounds):
        for name, call in contestants.items():
            synchronize()
            start = clock()
            call()
            synchronize()
            if index >= warmup:
                seconds[name].append(clock() - start)
    return {name: statistics.median(values) for name, values in seconds.items()}


def machine() -> str:
    """What the figures were measured on."""
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else f"CPU ({_cpu()})"
    return (
        f"{device}, {torch.get_num_threads()} threads, torch {version('torch')}, Python"
        f" {platform.python_version()}"
    )


def _cpu() -> str:
    try:
        with Path("/proc/cpuinfo").open() as info:
            return next(
                line.split(":")[1].strip() for line in info if line.startswith("model name")
            )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
