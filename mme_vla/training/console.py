"""What a person sees while training: one moving line on a terminal, plain lines elsewhere."""

import resource
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class ProgressLine:
    """Shows the step and the latest numbers. Without a terminal it prints a line whenever numbers arrive."""

    def __init__(self, total: int, done: int, shown: bool = True) -> None:
        self.console = Console(quiet=not shown, highlight=False, soft_wrap=True)
        self._total = total
        self._bar: Progress | None = None
        if self.console.is_terminal and shown:
            columns = (BarColumn(24), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
            self._bar = Progress(*columns, console=self.console, transient=True)
            self._task = self._bar.add_task("starting", total=total, completed=done)

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self) -> None:
        """One update is done."""
        if self._bar is not None:
            self._bar.advance(self._task)

    def numbers(self, step: int, values: Mapping[str, float]) -> None:
        """Show the latest training numbers."""
        text = (
            f"loss {values['train/loss']:.4f} · lr {values['train/lr']:.1e} · grad {values['train/grad_norm']:.2f} · "
            f"{values['speed/samples_per_s']:.1f} samples/s · {values['memory/gib']:.1f} GiB"
        )
        if self._bar is not None:
            self._bar.update(self._task, description=text)
        else:
            self.console.print(f"step {step}/{self._total} · {text}", markup=False)

    def say(self, text: str) -> None:
        """Print a line that stays."""
        self.console.print(text, markup=False)


def memory_gib(device: torch.device) -> float:
    """Most memory used so far: allocated on a GPU, else this process's resident memory."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**30
    return resident_gib()


def resident_gib() -> float:
    """Most resident memory this process has had, or, where the system does not say so, it or its parent before it."""
    with suppress(OSError):  # on Linux; getrusage begins with what the parent had when it started this process
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024  # getrusage counts bytes on macOS, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30
