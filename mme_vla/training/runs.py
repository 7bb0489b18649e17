"""Run folders: which one this run writes to, what it may resume from, and which settings it may change then."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError
from mme_vla.training.checkpoint import checkpoints_in, read_state, resolve_checkpoint, step_of

CONFIG, METRICS, SUMMARY, PLOT = "config.yaml", "metrics.jsonl", "summary.json", "open_loop.png"
CHECKPOINTS = "checkpoints"

MAY_DIFFER = (
    "output", "resume", "init_from", "logger", "train.steps", "train.log_every", "train.val_every",
    "train.save_every", "train.keep", "train.workers", "train.open_loop_chunks", "train.device",
    "data.cache",
)  # fmt: skip
"""Keys (and all below them) that a resumed run may change: how long, how often, where; nothing that changes a loss."""


@dataclass(frozen=True)
class Run:
    """Where a run writes, and the checkpoint it goes on from with the updates already done (None: from nothing)."""

    folder: Path
    checkpoint: Path | None = None
    step: int = 0

    @property
    def checkpoints(self) -> Path:
        return self.folder / CHECKPOINTS


def open_run(folder: Path, resume: str | None, config: Mapping[str, Any]) -> Run:
    """Decide where this run writes and where it starts; nothing is written yet.

    Args:
        folder: of a new run. resume: None, `auto`, or the path of a run or one of its checkpoints.
        config: the composed configuration, plain.

    Raises:
        UserError: `folder` holds another run, there is nothing to resume, or the configuration differs where it may
            not.
    """
    if resume is None:
        if any((folder / name).exists() for name in (CHECKPOINTS, METRICS, SUMMARY)):
            raise UserError(
                f"{folder} already holds a training run, which is never overwritten: "
                f"continue it with resume={folder}, or choose another output."
            )
        return Run(folder)
    checkpoint = _newest_unfinished(folder) if resume == "auto" else resolve_checkpoint(Path(resume))
    if checkpoint is None:
        return Run(folder)
    state = read_state(checkpoint)
    then, now = ({**c, "embodiment": embodiment_of(c).to_dict()} for c in (state["config"], config))
    changed = differing_keys(then, now)
    if changed:
        lines = "\n".join(f"  {key}: {old!r} then, {new!r} now" for key, (old, new) in changed.items())
        raise UserError(
            f"{checkpoint} was trained with other settings, so going on from it would be another run:\n{lines}\n"
            f"Repeat the settings of {checkpoint.parent.parent / CONFIG}, or start anew with init_from={checkpoint}."
        )
    steps = config["train"]["steps"]
    if state["step"] >= steps:
        raise UserError(f"{checkpoint} has already reached train.steps={steps}: give a larger train.steps to go on.")
    newer = [path.name for path in checkpoints_in(checkpoint.parent) if step_of(path) > state["step"]]
    if newer:
        raise UserError(
            f"{checkpoint.parent} holds newer checkpoints ({', '.join(newer)}), which going on from {checkpoint.name} "
            "would overwrite: resume from the newest, or move those away."
        )
    return Run(checkpoint.parent.parent, checkpoint, state["step"])


def differing_keys(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Dotted keys whose values differ and must not, with both values."""
    before, after = (_flat(json.loads(json.dumps(values))) for values in (old, new))
    return {
        key: (before.get(key), after.get(key))
        for key in sorted(before.keys() | after.keys())
        if before.get(key) != after.get(key) and not any(f"{key}.".startswith(f"{free}.") for free in MAY_DIFFER)
    }


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _newest_unfinished(folder: Path) -> Path | None:
    """The last checkpoint in `folder`, else of the run beside it that wrote last, unless that run is finished."""
    beside = [path for path in folder.parent.glob("*") if (path / CHECKPOINTS).is_dir()]
    runs = [folder, *sorted(beside, key=lambda path: (path / CHECKPOINTS).stat().st_mtime, reverse=True)]
    for run in runs:
        found = checkpoints_in(run / CHECKPOINTS)
        if found:
            return None if (run / SUMMARY).is_file() and run != folder else found[-1]
    return None
