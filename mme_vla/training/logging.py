"""Where the numbers go: a JSON-lines file in every run folder, TensorBoard by default, Weights & Biases on request."""

import json
import math
import resource
import secrets
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, Self

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from mme_vla.errors import UserError, missing_extra
from mme_vla.registry import Registry
from mme_vla.training.runs import METRICS
from mme_vla.utils import parse_json, read_text, write_atomically


class Window:
    """Sums what updates report, on their device, and the time they take; reading it waits for the device once.

    A number that only some updates report is averaged over those.
    """

    def __init__(self, batch_size: int) -> None:
        self._batch_size = batch_size
        self.restart()

    def restart(self) -> None:
        """Begin anew."""
        self._sums: dict[str, Tensor | float] = {}
        self._counts: dict[str, int] = {}
        self._updates = 0
        self._waited = self._paused = 0.0
        self._begun = time.perf_counter()

    def add(self, metrics: Mapping[str, Tensor | float]) -> None:
        """Take one update's numbers; plain ones, such as the learning rate, are the same in every process."""
        for name, value in metrics.items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value
            self._counts[name] = self._counts.get(name, 0) + 1
        self._updates += 1

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Time spent here is waiting for data."""
        begun = time.perf_counter()
        yield
        self._waited += time.perf_counter() - begun

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Time spent here (validation, checkpoints) is not training."""
        begun = time.perf_counter()
        yield
        self._paused += time.perf_counter() - begun

    def close(self, step: int, reduce: Callable[..., Any]) -> dict[str, float]:
        """The averages, and the speed; then begin anew.

        Args:
            step: updates done. reduce: averages a tensor over all processes (`Accelerator.reduce`).
        """
        averages = {name: total / self._counts[name] for name, total in self._sums.items()}
        measured = {name: average for name, average in averages.items() if isinstance(average, Tensor)}
        means = reduce(torch.stack(list(measured.values())), reduction="mean").tolist()
        known = averages | dict(zip(measured, means, strict=True))
        values = {f"train/{name}": float(mean) for name, mean in known.items()}
        seconds = time.perf_counter() - self._begun - self._paused
        values["speed/samples_per_s"] = self._updates * self._batch_size / seconds
        values["speed/waiting_for_data"] = self._waited / seconds
        broken = [name for name, value in values.items() if not math.isfinite(value)]
        if broken:
            raise UserError(
                f"{' and '.join(broken)} stopped being a number before step {step}; nothing of it was saved. "
                "Resume from the last checkpoint with a lower train.lr in a new run (init_from=…), "
                "or look for broken values in the data (python -m mme_vla.inspect dataset=…)."
            )
        self.restart()
        return values


class ProgressLine:
    """Shows the step and the latest numbers. Without a terminal it prints a line whenever numbers arrive."""

    def __init__(self, total: int, done: int, visible: bool = True) -> None:
        self.console = Console(quiet=not visible, highlight=False, soft_wrap=True)
        self._total = total
        self._bar: Progress | None = None
        if self.console.is_terminal and visible:
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


LOGGERS: Registry[Any] = Registry("logger")
"""Constructors called with (run folder, configuration, **the section's other keys)."""


class Logger(Protocol):
    """A place for numbers."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Record values after `step` updates."""
        ...

    def log_image(self, step: int, name: str, path: Path) -> None:
        """Record an image file."""
        ...

    def close(self) -> None:
        """Have everything on disk, or sent."""
        ...


class JsonLines:
    """`metrics.jsonl`: one object a line, first `step`. A resumed run cuts off what lies beyond its first step."""

    def __init__(self, folder: Path, first_step: int) -> None:
        path = folder / METRICS
        lines = [line for line in read_metrics(folder) if line["step"] <= first_step]
        with write_atomically(path) as draft:
            draft.write_text("".join(json.dumps(line) + "\n" for line in lines))
        self._file = path.open("a", buffering=1)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        self._file.write(json.dumps({"step": step, **values}) + "\n")

    def log_image(self, step: int, name: str, path: Path) -> None:
        """Images lie in the run folder already."""

    def close(self) -> None:
        self._file.close()


@LOGGERS.register("tensorboard")
class TensorBoard:
    """Event files in `tensorboard/` of the run folder: `tensorboard --logdir outputs`."""

    def __init__(self, folder: Path, config: Mapping[str, Any], first_step: int = 0, flush_secs: int = 30) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # Of an interrupted run, TensorBoard drops the points that this one writes again.
        self._writer = SummaryWriter(
            str(folder / "tensorboard"), purge_step=first_step + 1 if first_step else None, flush_secs=flush_secs
        )

    def write(self, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def log_image(self, step: int, name: str, path: Path) -> None:
        import numpy as np
        from PIL import Image

        with Image.open(path) as image:
            self._writer.add_image(name, np.asarray(image.convert("RGB")), step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


@LOGGERS.register("wandb")
class WeightsAndBiases:
    """A Weights & Biases run under the run folder's name; a resumed run continues in the same one."""

    def __init__(
        self,
        folder: Path,
        config: Mapping[str, Any],
        first_step: int = 0,
        project: str = "mme_vla",
        entity: str | None = None,
        group: str | None = None,
        tags: list[str] | None = None,
        mode: Literal["online", "offline", "disabled"] = "online",
    ) -> None:
        self.check()
        import wandb

        record = folder / "wandb_id"
        if not record.is_file():
            with write_atomically(record) as draft:
                draft.write_text(secrets.token_hex(4))
        self._wandb = wandb
        self._run = wandb.init(
            project=project, entity=entity, group=group, tags=tags, mode=mode, dir=str(folder),
            name=f"{folder.parent.name}/{folder.name}", id=record.read_text(), resume="allow", config=dict(config),
        )  # fmt: skip

    @staticmethod
    def check() -> None:
        """Find out early whether the package is there."""
        try:
            import wandb  # noqa: F401
        except ImportError:
            # TensorBoard, the default, needs nothing more.
            raise missing_extra("logger=wandb", "wandb") from None

    def write(self, step: int, values: Mapping[str, float]) -> None:
        self._run.log(dict(values), step=step)

    def log_image(self, step: int, name: str, path: Path) -> None:
        self._run.log({name: self._wandb.Image(str(path))}, step=step)

    def close(self) -> None:
        self._run.finish()


class Loggers:
    """Several loggers as one; on processes other than the first, none."""

    def __init__(self, loggers: list[Logger]) -> None:
        self._loggers = loggers

    def write(self, step: int, values: Mapping[str, float]) -> None:
        for logger in self._loggers:
            logger.write(step, values)

    def log_image(self, step: int, name: str, path: Path) -> None:
        for logger in self._loggers:
            logger.log_image(step, name, path)

    def close(self) -> None:
        for logger in self._loggers:
            logger.close()


def check_logger(config: Mapping[str, Any]) -> None:
    """Make sure, before any long work, that the logger which the section `logger` names can be used."""
    section = config.get("logger") or {}
    if section:
        getattr(LOGGERS[section["name"]], "check", lambda: None)()


def open_loggers(folder: Path, config: Mapping[str, Any], first_step: int) -> Loggers:
    """The JSON-lines file and the logger that the section `logger` names, if any."""
    section = dict(config.get("logger") or {})
    folder.mkdir(parents=True, exist_ok=True)
    loggers: list[Logger] = []
    if section:
        loggers.append(LOGGERS.build(section, folder, config, first_step=first_step))
    return Loggers([JsonLines(folder, first_step), *loggers])


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """The lines of a run's `metrics.jsonl`; a last line cut off by a kill is left out."""
    path = folder / METRICS
    lines = []
    for line in read_text(path, "metrics", limit=2**30).splitlines() if path.exists() else []:
        try:
            lines.append(parse_json(line, str(path), finite=False))
        except UserError:
            break
    return lines
