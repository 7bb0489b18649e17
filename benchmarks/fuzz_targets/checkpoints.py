"""Checkpoints of every kind the library opens, as small as they can be, with and without checksums."""

import tempfile
from pathlib import Path

import huggingface_hub.serialization  # noqa: F401  (loaded once here, not again by every process that reads)
import numpy as np
import sentencepiece  # noqa: F401
import torch
from torch import Tensor, nn

from benchmarks.fuzz_targets.base import Target, digest, every_file
from mme_vla import MMEPolicy
from mme_vla.cli.weights import convert
from mme_vla.policy.tensor_files import WEIGHTS, save_tensors
from mme_vla.testing.small import SMALL_VISION, small_policy
from mme_vla.training.checkpoint import read_state, restore, save_checkpoint, trainable
from mme_vla.training.optim import EMA
from mme_vla.training.settings import KeepRule
from mme_vla.utils import SUMS, write_sums
from mme_vla.weights import load_weights, read_stats

_CONFIG = {"train": {"steps": 1}, "seed": 1}
_UNREAD = ("README.md",)


def _policy(model: str = "framesamp_context") -> MMEPolicy:
    return small_policy(model, backbone={"depth": 1, "vision": {**SMALL_VISION, "patch_size": 16}})


def _files(folder: Path) -> list[Path]:
    return [path for path in every_file(folder) if path.name not in _UNREAD]


def _arrays(tensors: dict[str, Tensor]) -> list[object]:
    return [value for name in sorted(tensors) for value in (name, _array(tensors[name]))]


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to(torch.float32).cpu().numpy()


def _of_policy(policy: MMEPolicy) -> list[object]:
    processor = policy.require_processor()
    stats = None if processor.stats is None else processor.stats.to_dict()
    decisive = {key: value for key, value in policy.config.items() if key != "card"}
    tokens = processor.prompt("pick up the red cube", state=np.zeros(8, np.float32))
    return [*_arrays(policy.state_dict()), decisive, processor.embodiment.to_dict(), stats, *map(_array, tokens)]


def write_sharded(folder: Path) -> None:
    """A policy in shards, with checksums."""
    policy = _policy()
    policy.save_pretrained(folder)
    (folder / WEIGHTS).unlink()
    save_tensors(policy.state_dict(), folder, max_shard_size="200KB")
    write_sums(folder, [file.name for file in _files(folder) if file.name != SUMS])


def write_without_sums(folder: Path) -> None:
    """The same as it was written before there were checksums, or by somebody else."""
    write_sharded(folder)
    (folder / SUMS).unlink()


def read_policy(folder: Path) -> object:
    """Everything that acts: weights, statistics, prompts."""
    return digest(*_of_policy(MMEPolicy.from_pretrained(folder)))


def _training() -> tuple[MMEPolicy, EMA, torch.optim.Optimizer]:
    policy = _policy("pi05")
    parameters: dict[str, nn.Parameter] = trainable(policy)
    return policy, EMA(parameters, 0.9), torch.optim.AdamW(parameters.values(), 1e-3)


def write_training(folder: Path) -> None:
    """A training checkpoint after one update."""
    policy, ema, optimizer = _training()
    for parameter in policy.parameters():
        parameter.grad = torch.full_like(parameter, 1e-3)
    optimizer.step()
    ema.update()
    save_checkpoint(folder, 1, policy, ema, optimizer, _CONFIG, KeepRule())


def read_training(folder: Path) -> object:
    """As a resumed run reads it: the state, the processor, then weights, averages and moments."""
    checkpoint = folder / "step_000001"
    state = read_state(checkpoint)
    opened = MMEPolicy.from_pretrained(checkpoint)
    policy, ema, optimizer = _training()
    restore(checkpoint, policy, ema, optimizer)
    moments = [_array(value) for entry in optimizer.state_dict()["state"].values() for value in entry.values()]
    averages = _arrays(ema.tensors())
    return digest(
        state["step"], state["config"], *_of_policy(opened), *_arrays(policy.state_dict()), *averages, *moments
    )


def _write_as(folder: Path, fmt: str) -> None:
    with tempfile.TemporaryDirectory() as place:
        _policy("pi05").save_pretrained(Path(place) / "ours")
        convert(Path(place) / "ours", folder / fmt, to=fmt)


def _read_as(folder: Path, fmt: str) -> object:
    policy = load_weights(_policy("pi05"), folder / fmt)
    stats = read_stats(folder / fmt / "0" if fmt == "released" else folder / fmt)
    return digest(*_arrays(policy.state_dict()), None if stats is None else stats.to_dict())


def write_released(folder: Path) -> None:
    """A run of the released JAX code (Orbax)."""
    _write_as(folder, "released")


def read_released(folder: Path) -> object:
    """Weights and statistics."""
    return _read_as(folder, "released")


def write_lerobot(folder: Path) -> None:
    """LeRobot's format."""
    _write_as(folder, "lerobot")


def read_lerobot(folder: Path) -> object:
    """Weights and statistics."""
    return _read_as(folder, "lerobot")


def _always(valid: object, result: object) -> bool:
    return True


TARGETS = [
    Target("checkpoint", write_sharded, _files, read_policy),
    Target("training-checkpoint", write_training, _files, read_training),
    Target("checkpoint-without-sums", write_without_sums, _files, read_policy, _always),
    Target("lerobot-checkpoint", write_lerobot, _files, read_lerobot, _always),
    Target("released-checkpoint", write_released, _files, read_released, _always),
]
