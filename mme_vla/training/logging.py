"""Where the numbers go: a JSON-lines file in every run folder, TensorBoard by default, Weights & Biases on request."""

import json
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Protocol

from mme_vla.errors import UserError, missing_extra
from mme_vla.files import parse_json, read_text, write_atomically
from mme_vla.registry import Registry
from mme_vla.training.runs import METRICS

LOGGERS: Registry[Any] = Registry("logger")
"""Constructors called with (run folder, configuration, **the section's other keys)."""


class Logger(Protocol):
    """A place for numbers."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Record values after `step` updates."""
        ...

    def picture(self, step: int, name: str, path: Path) -> None:
        """Record a picture file."""
        ...

    def close(self) -> None:
        """Have everything on disk, or sent."""
        ...


class JsonLines:
    """`metrics.jsonl`: one object a line, first `step`. A resumed run cuts off what lies beyond its first step."""

    def __init__(self, folder: Path, first_step: int) -> None:
        path = folder / METRICS
        kept = [line for line in read_metrics(folder) if line["step"] <= first_step]
        with write_atomically(path) as draft:
            draft.write_text("".join(json.dumps(line) + "\n" for line in kept))
        self._file = path.open("a", buffering=1)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        self._file.write(json.dumps({"step": step, **values}) + "\n")

    def picture(self, step: int, name: str, path: Path) -> None:
        """Pictures lie in the run folder already."""

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

    def picture(self, step: int, name: str, path: Path) -> None:
        import numpy as np
        from PIL import Image

        with Image.open(path) as image:
            self._writer.add_image(name, np.asarray(image.convert("RGB")), step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


@LOGGERS.register("wandb")
class WeightsAndBiases:
    """A Weights & Biases run under the run folder's name; a resumed run goes on in the same one."""

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
        """Find out early whether the package is there.

        Raises:
            UserError: it is not; says how to install it.
        """
        try:
            import wandb  # noqa: F401
        except ImportError:
            # TensorBoard, the default, needs nothing more.
            raise missing_extra("logger=wandb", "wandb") from None

    def write(self, step: int, values: Mapping[str, float]) -> None:
        self._run.log(dict(values), step=step)

    def picture(self, step: int, name: str, path: Path) -> None:
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

    def picture(self, step: int, name: str, path: Path) -> None:
        for logger in self._loggers:
            logger.picture(step, name, path)

    def close(self) -> None:
        for logger in self._loggers:
            logger.close()


def check_logger(config: Mapping[str, Any]) -> None:
    """Make sure, before any long work, that the logger which the section `logger` names can be used.

    Raises:
        UserError: an unknown logger, or its package is not installed.
    """
    section = config.get("logger") or {}
    if section:
        getattr(LOGGERS[section["name"]], "check", lambda: None)()


def open_loggers(folder: Path, config: Mapping[str, Any], first_step: int) -> Loggers:
    """The JSON-lines file and the logger that the section `logger` names, if any.

    Raises:
        UserError: an unknown logger or option, or its package is not installed.
    """
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
