"""Numbers of a run: `metrics.jsonl` in its folder, a line on the screen, and one of accelerate's
trackers.
"""

import json
import math
import resource
import secrets
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import torch
from accelerate.tracking import (
    GeneralTracker,
    MLflowTracker,
    TensorBoardTracker,
    TrackioTracker,
    WandBTracker,
)
from PIL import Image
from torch import Tensor

from mme_vla.data.console import Bar
from mme_vla.errors import CONSTRAINTS, UserError, missing_extra, require
from mme_vla.registry import Registry
from mme_vla.training.runs import METRICS
from mme_vla.utils import read_lines, write_text


class Window:
    """Sums of what updates report, on their device, and the time they take. Reading them waits for
    the device once.

    A number that only some updates report is averaged over those.
    """

    def __init__(self, batch_size: int) -> None:
        self._batch_size = batch_size
        self.restart()

    def restart(self) -> None:
        self._sums: dict[str, Tensor | float] = {}
        self._counts: dict[str, int] = {}
        self._updates = 0
        self._waited = self._paused = 0.0
        self._begun = time.perf_counter()

    def add(self, metrics: Mapping[str, Tensor | float]) -> None:
        """Take one update's numbers; plain ones, such as the learning rate, are the same in every
        process.
        """
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
            step: updates done.
            reduce: averages a tensor over all processes (`Accelerator.reduce`).
        """
        averages: dict[str, Any] = {}
        for name, total in self._sums.items():
            averages[f"train/{name}"] = total / self._counts[name]
        measured = {name: mean for name, mean in averages.items() if isinstance(mean, Tensor)}
        # One transfer from the device for all of them.
        means = reduce(torch.stack(list(measured.values())), reduction="mean").tolist()
        values: dict[str, float] = averages | dict(zip(measured, means, strict=True))
        seconds = time.perf_counter() - self._begun - self._paused
        values["speed/samples_per_s"] = self._updates * self._batch_size / seconds
        values["speed/waiting_for_data"] = self._waited / seconds
        broken = [name for name, value in values.items() if not math.isfinite(value)]
        require(
            not broken,
            f"{' and '.join(broken)} stopped being a number before step {step}; nothing of it was"
            " saved. Resume from the last checkpoint with a lower train.lr in a new run"
            " (init_from=…), or look for broken values in the data (mme-vla inspect"
            " dataset=…).",
        )
        self.restart()
        return values


class ProgressLine(Bar):
    """Shows the step and the latest numbers. Without a terminal it prints a line whenever numbers
    arrive.
    """

    def __init__(self, total: int, done: int, visible: bool = True) -> None:
        super().__init__(total, done, "starting", visible, stderr=False)

    def numbers(self, step: int, values: Mapping[str, float]) -> None:
        text = (
            f"loss {values['train/loss']:.4f} · lr {values['train/lr']:.1e} · grad"
            f" {values['train/grad_norm']:.2f} · {values['speed/samples_per_s']:.1f} samples/s ·"
            f" {values['memory/gib']:.1f} GiB"
        )
        self.describe(text)
        if self.bar is None:
            self.say(f"step {step}/{self.total} · {text}")


def resident_gib() -> float:
    """Peak resident memory of this process; without /proc it may include the parent's."""
    with suppress(OSError):
        # getrusage begins with what the parent had when it started this process
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024  # getrusage counts bytes on macOS, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


LOGGERS: Registry[Any] = Registry("logger")
"""Makers of accelerate trackers, called with (run folder, configuration, updates already done,
**the section's other keys).
"""


@LOGGERS.register("tensorboard")
def tensorboard_tracker(
    folder: Path, config: Mapping[str, Any], first_step: int, flush_secs: int = 30
) -> GeneralTracker:
    """Event files in `tensorboard/` of the run folder: `tensorboard --logdir outputs`."""
    # Of an interrupted run, be it before its first checkpoint, TensorBoard drops the points that
    # this one writes again.
    return TensorBoardTracker(
        "tensorboard", folder, purge_step=first_step + 1, flush_secs=flush_secs
    )


@LOGGERS.register("wandb")
def wandb_tracker(
    folder: Path,
    config: Mapping[str, Any],
    first_step: int,
    project: str = "mme_vla",
    entity: str | None = None,
    group: str | None = None,
    tags: list[str] | None = None,
    mode: Literal["online", "offline", "disabled"] = "online",
) -> GeneralTracker:
    """A Weights & Biases run under the run folder's name; a resumed run continues the same one."""
    return WandBTracker(
        project,
        entity=entity,
        group=group,
        tags=tags,
        mode=mode,
        dir=str(folder),
        name=_run_name(folder),
        id=_run_id(folder),
        resume="allow",
        config=dict(config),
    )


@LOGGERS.register("trackio")
def trackio_tracker(
    folder: Path,
    config: Mapping[str, Any],
    first_step: int,
    project: str = "mme_vla",
    group: str | None = None,
    space_id: str | None = None,
) -> GeneralTracker:
    """A Trackio run, on this machine or in a Space of the hub; a resumed run continues the same
    one.
    """
    name = f"{_run_name(folder)}-{_run_id(folder)}"
    return TrackioTracker(
        project,
        name=name,
        group=group,
        space_id=space_id,
        resume="allow",
        embed=False,
        config=dict(config),
    )


@LOGGERS.register("mlflow")
def mlflow_tracker(
    folder: Path,
    config: Mapping[str, Any],
    first_step: int,
    project: str = "mme_vla",
    tracking_uri: str | None = None,
) -> GeneralTracker:
    """An MLflow run, in a file of the run folder or on a server; a resumed run continues the same
    one.
    """
    import mlflow

    artifacts = None
    if tracking_uri is None:
        tracking_uri = f"sqlite:///{(folder / 'mlflow.db').absolute()}"
        artifacts = (folder / "mlflow").absolute().as_uri()
    mlflow.set_tracking_uri(tracking_uri)
    record = folder / "mlflow_id"
    run_id = record.read_text(encoding="utf-8") if record.is_file() else None
    return MLflowTracker(project, artifacts, run_id=run_id, run_name=_run_name(folder))


def _run_name(folder: Path) -> str:
    return f"{folder.parent.name}/{folder.name}"


def _run_id(folder: Path) -> str:
    """The tracker's id of this run, made once."""
    record = folder / "wandb_id"
    if not record.is_file():
        write_text(record, secrets.token_hex(4))
    return record.read_text(encoding="utf-8")


class Loggers:
    """`metrics.jsonl` of a run, and its tracker. Processes other than the first have neither and
    record nothing.
    """

    def __init__(self, file: IO[str] | None = None, tracker: GeneralTracker | None = None) -> None:
        self._file, self._tracker = file, tracker

    def write(self, step: int, values: Mapping[str, float]) -> None:
        if self._file is not None:
            self._file.write(json.dumps({"step": step, **values}) + "\n")
        if self._tracker is not None:
            self._tracker.log(dict(values), step=step)

    def log_image(self, step: int, name: str, path: Path) -> None:
        """Record an image file of the run folder."""
        match self._tracker:
            case TensorBoardTracker() as tracker:
                with Image.open(path) as image:
                    pixels = np.asarray(image.convert("RGB"))[None]
                tracker.log_images({name: pixels}, step, dataformats="NHWC")
            case WandBTracker() as tracker:
                tracker.log_images({name: [str(path)]}, step)
            case MLflowTracker() as tracker:
                tracker.log_artifact(str(path))

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        if self._tracker is not None:
            self._tracker.finish()


def check_logger(section: Mapping[str, Any] | None) -> None:
    """Raise an error, before any long work, if the package of the logger that the section `logger`
    names is missing.
    """
    name = (section or {}).get("name")
    if name not in ("wandb", "trackio", "mlflow"):
        return
    with suppress(ValueError):  # a module without a specification
        if find_spec(name) is not None:
            return
    if name == "wandb":
        raise missing_extra("logger=wandb", "wandb")
    pins = "-c constraints.txt " if CONSTRAINTS.is_file() else ""
    raise UserError(f"logger={name} needs the package {name}: pip install {pins}{name}")


def open_loggers(
    folder: Path,
    config: Mapping[str, Any],
    first_step: int,
    section: Mapping[str, Any] | None = None,
) -> Loggers:
    """Open `metrics.jsonl` and the tracker that the section `logger` names, if any.

    A resumed run removes the lines that lie beyond its first step.
    """
    tracker = None
    if section:
        tracker = LOGGERS.build(section, folder, config, first_step=first_step)
        tracker.start()
        if isinstance(tracker, MLflowTracker):
            write_text(folder / "mlflow_id", tracker.tracker.info.run_id)
    lines = [line for line in read_metrics(folder) if line["step"] <= first_step]
    write_text(folder / METRICS, "".join(json.dumps(line) + "\n" for line in lines))
    return Loggers((folder / METRICS).open("a", buffering=1, encoding="utf-8"), tracker)


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    path = folder / METRICS
    return read_lines(path, dict, "metrics", finite=False) if path.exists() else []
