"""Normalisation statistics that lie beside foreign checkpoints."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from mme_vla.errors import UserError, brief, listed, require
from mme_vla.policy.tensor_files import read_safetensors
from mme_vla.processing.base import STATS_FILE
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.utils import checked_file, read_json
from mme_vla.weights.source import method_formats

_PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_STATE, _ACTION = "observation.state", "action"


def read_stats(folder: Path | str, asset: str | None = None) -> NormStats | None:
    """The statistics in a checkpoint folder, or None where it has none.

    Read in this order: openpi's `assets/<asset>/norm_stats.json`, `norm_stats.json` itself, the
    files of formats that extensions add, and the file that LeRobot's processor description names as
    the state of its normaliser. LeRobot's describe the actions it was trained on: they fit this
    library's joint deltas if that policy used relative actions with an absolute gripper.

    Args:
        folder: the checkpoint (for released runs: the step).
        asset: which of several datasets' statistics.
    """
    folder = Path(folder)
    files = stats_files(folder)
    if asset is not None or len(files) > 1:
        if asset not in files:
            if asset:
                reason = f"none of {brief(asset)}."
            else:
                reason = "say which: --asset, or read_stats(folder, asset)."
            raise UserError(
                f"{folder} holds statistics of {listed(files) or 'no dataset'}: {reason}"
            )
        return NormStats.load(_local_file(folder, files[asset]))
    for file in (*files.values(), folder / STATS_FILE):
        if file.is_file():
            return NormStats.load(_local_file(folder, file))
    for fmt in method_formats().values():
        if fmt.stats is not None and (stats := fmt.function("stats")(folder)) is not None:
            return stats
    return _lerobot_stats(folder)


def stats_files(folder: Path) -> dict[str, Path]:
    """The statistics that openpi keeps in a checkpoint, by the name of their dataset."""
    assets = folder / "assets"
    files = sorted(assets.glob("**/norm_stats.json"))
    return {file.parent.relative_to(assets).as_posix(): file for file in files}


def _lerobot_stats(folder: Path) -> NormStats | None:
    for name in _PROCESSORS:
        if not (folder / name).is_file():
            continue
        steps = read_json(_local_file(folder, folder / name), "a LeRobot processor").get("steps")
        if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
            raise UserError(
                f"{folder / name} does not describe a LeRobot processor: `steps` must list objects."
            )
        for step in steps:
            file = step.get("state_file")
            if not file:
                continue
            require(
                isinstance(file, str),
                f"{folder / name}: state_file={brief(file)} must be the name of a file.",
            )
            tensors = read_safetensors(checked_file(folder, file, "statistics"))
            if all(f"{feature}.q01" in tensors for feature in (_STATE, _ACTION)):
                return NormStats(
                    state=_quantiles(tensors, _STATE), actions=_quantiles(tensors, _ACTION)
                )
    return None


def _local_file(folder: Path, file: Path) -> Path:
    """A file of a checkpoint, which must lie in it, compared with its checksum where
    there is one.
    """
    return checked_file(folder, file.relative_to(folder).as_posix(), "statistics")


def _quantiles(tensors: Mapping[str, Tensor], feature: str) -> QuantileStats:
    values: dict[str, Any] = {}
    for key in ("mean", "std", "q01", "q99"):
        tensor = tensors.get(f"{feature}.{key}")
        values[key] = None if tensor is None else np.asarray(tensor.double().flatten()).tolist()
    return QuantileStats.from_dict(values, feature)
