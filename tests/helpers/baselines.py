"""Golden cases of the prior methods' original code: where they lie, and their weights by rule."""

import json
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers import REPOSITORY
from helpers.golden import ERRORS

SHARED = REPOSITORY.parent / "shared" / "parity_baselines"


def baselines_folder(method: str) -> Path:
    """The folder of one method's golden cases; skips the test where there is none.

    `MME_VLA_PARITY_BASELINES` names the folder above it, `../shared/parity_baselines` by default.
    """
    folder = Path(os.environ.get("MME_VLA_PARITY_BASELINES", SHARED)) / method
    if not folder.is_dir():
        pytest.skip(f"no golden cases of {method} at {folder} (set MME_VLA_PARITY_BASELINES)")
    return folder


def arrays(folder: Path, name: str) -> dict[str, Tensor]:
    """Arrays of one golden file."""
    with np.load(folder / f"{name}.npz") as archive:
        return {key: torch.from_numpy(archive[key]) for key in archive.files}


def case(folder: Path, name: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Arrays and description of one golden file."""
    return arrays(folder, name), json.loads((folder / f"{name}.json").read_text())


def rule_uniform(name: str, shape: tuple[int, ...], seed: int) -> Tensor:
    """The float32 numbers in [−1, 1) that the cases' READMEs call u(name, shape, seed): splitmix64
    of whole numbers.
    """
    count = int(np.prod(shape, dtype=np.int64))
    with np.errstate(over="ignore"):
        z = np.arange(count, dtype=np.uint64) + (
            np.uint64(zlib.crc32(f"{seed}/{name}".encode())) << np.uint64(32)
        )
        z += np.uint64(0x9E3779B97F4A7C15)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
            z ^= z >> np.uint64(shift)
            z *= np.uint64(factor)
    z >>= np.uint64(40)
    values = z.astype(np.float32)
    values /= np.float32(2**23)
    values -= np.float32(1)
    return torch.from_numpy(values.reshape(shape))


def rule_weight(name: str, shape: tuple[int, ...], seed: int) -> Tensor:
    """A parameter by rule: small biases, norm weights about one, matrices of unit gain for their
    fan-in.
    """
    uniform = rule_uniform(name, shape, seed)
    if name.endswith("bias"):
        return 0.1 * uniform
    if len(shape) < 2:
        return 1 + 0.2 * uniform
    fan = int(np.prod(shape[1:], dtype=np.int64))
    return uniform.mul_(torch.tensor(np.float32(np.sqrt(3 / fan))))


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest expected number; also kept under the running test's name
    (docs/evidence).
    """
    assert actual.shape == expected.shape, (actual.shape, expected.shape)
    worst = (actual.detach().double() - expected.double()).abs().max().item()
    worst /= expected.abs().max().item() or 1.0
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rsplit(" ", 1)[0].rsplit("::", 1)[-1]
    ERRORS[test] = max(worst, ERRORS.get(test, 0.0))
    return worst
