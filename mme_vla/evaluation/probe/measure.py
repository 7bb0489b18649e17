"""How much an answer changes, beside how much it varies by itself."""

from dataclasses import dataclass

import numpy as np
from torch import Tensor


@dataclass(frozen=True)
class Change:
    """What became of a chunk, in normalised actions (1: half of what the training data span), root mean square.

    change: mean distance of two chunks of the same noise. spread: mean distance of two chunks that differ in noise
    alone, unprobed. distance: energy distance of the two distributions, 0 where they are one.
    """

    change: float
    spread: float
    distance: float


def compare_chunks(before: Tensor, after: Tensor) -> Change:
    """Compare chunks [n, h, w] before and after an intervention, row by row of the same noise."""
    first, second = (x.double().flatten(1).numpy() for x in (before, after))
    across, within, inside = _distances(first, second), _distances(first, first), _distances(second, second)
    energy = 2 * across.mean() - within.mean() - inside.mean()
    return Change(float(np.diagonal(across).mean()), spread_of(within), float(max(energy, 0.0)))


def spread_of(distances: np.ndarray) -> float:
    """Mean of the distances [n, n] between different rows; 0 for one row."""
    n = len(distances)
    return float(distances.sum() / (n * (n - 1))) if n > 1 else 0.0


def _distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(first[:, None] - second[None]).mean(-1))
