"""Golden cases of SAM2Act+: their files, random weights and inputs, and networks built to their
sizes.
"""

import json
import zlib
from typing import Any

import numpy as np
import torch
from torch import Tensor

from helpers.baselines import baselines_folder


def load(name: str) -> dict[str, np.ndarray]:
    """The arrays of one golden file."""
    with np.load(baselines_folder("sam2act_plus") / f"{name}.npz") as file:
        return dict(file)


def meta() -> dict[str, Any]:
    """Sizes, names of parameters, norms of gradients."""
    described: dict[str, Any] = json.loads(
        (baselines_folder("sam2act_plus") / "meta.json").read_text()
    )
    return described


def sample_array(name: str, shape: tuple[int, ...] | list[int], seed: int) -> np.ndarray:
    """The standard normal numbers that belong to a name."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())]).standard_normal(tuple(shape))


def sample_weight(name: str, shape: list[int], seed: int) -> Tensor:
    """A weight by the rule of the golden cases' README."""
    x = sample_array(f"net.{name}", shape, seed)
    last = name.rsplit(".", 1)[-1]
    if last == "gamma":
        value = 0.3 + 0.1 * x
    elif last in ("pos_encoding", "maskmem_tpos_enc"):
        value = 0.5 * x
    elif len(shape) == 1:
        value = 0.2 * x + (last == "weight")
    else:
        value = x / np.sqrt(np.prod(shape[1:]))
    if last == "running_var":
        value = 1 + np.abs(value)
    return torch.from_numpy(np.asarray(value, np.float32))


def relative_error(actual: Any, expected: np.ndarray) -> float:
    """The largest difference, relative to the largest expected entry."""
    array = actual.detach().numpy() if isinstance(actual, Tensor) else np.asarray(actual)
    assert array.shape == expected.shape, (array.shape, expected.shape)
    return float(np.abs(array - expected).max() / max(np.abs(expected).max(), 1e-30))
