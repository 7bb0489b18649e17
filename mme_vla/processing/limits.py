"""What a robot cannot have said: numbers far beyond everything the statistics know."""

import numpy as np

from mme_vla.errors import UserError, brief
from mme_vla.processing.normalisers import QuantileStats

REACH = 100  # multiples of the widest range; a broken driver says 1e30, a robot never leaves its joints' limits by that


def finite_array(values: object, what: str) -> np.ndarray:
    """`values` as float32.

    Raises:
        UserError: they are not numbers, not all finite, or not as many in every row.
    """
    try:
        array = np.asarray(values, np.float32)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{what} must be numbers, got {brief(values)}.") from None
    if not np.isfinite(array).all():
        raise UserError(f"{what} must be finite numbers, got {brief(array[~np.isfinite(array)][:4].tolist())}.")
    return array


def check_reach(values: np.ndarray, stats: QuantileStats | None, what: str) -> None:
    """Refuse values [..., d] that lie further from the middle than `REACH` times the widest range q01…q99.

    The widest range of all dimensions counts, so that one which hardly moved in training (a gripper) may move.

    Raises:
        UserError: one does; it is named.
    """
    if stats is None or values.shape[-1] != len(stats):
        return
    reach = REACH * max(float((stats.q99 - stats.q01).max()), 1e-3)
    beyond = np.abs(values.astype(np.float64) - (stats.q01 + stats.q99) / 2) > reach
    if beyond.any():
        place = tuple(int(i) for i in np.argwhere(beyond)[0])
        d = place[-1]
        raise UserError(
            f"{what} has {values[place]:.4g} for number {d + 1} of {values.shape[-1]}; in the training data it lies "
            f"within {stats.q01[d]:.4g} and {stats.q99[d]:.4g}. Check the driver and the units (radians)."
        )
