"""What a request holds beside pictures: depth and poses of cameras, for policies that read them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError

POSE = (3, 4)
DEEPEST = 32_767  # millimetres: the benchmark's depth is int16


def read_beside(
    robot: Embodiment, pictures: Mapping[str, np.ndarray], message: Mapping[str, Any], key: str
) -> dict[str, np.ndarray]:
    """Depth and poses of every camera that has them, one for each of its pictures.

    Args:
        pictures: [t, H, W, 3] by camera. message: lists (or arrays) of t readings. key: how it spells their names.

    Returns:
        By the robot's names: depth float32 [t, H, W, 1] in millimetres, poses float32 [t, 3, 4] from the world to the
        camera.

    Raises:
        UserError: one is missing or has another form; it names the key.
    """
    found = {}
    for camera in robot.cameras:
        for name, shape in zip(camera.readings, (pictures[camera.name].shape[1:3], POSE), strict=False):
            found[name] = _rows(key.format(name), message, len(pictures[camera.name]), shape)
        if camera.readings:
            depth = camera.readings[0]
            if (found[depth] < 0).any() or (found[depth] > DEEPEST).any():
                raise UserError(f"{key.format(depth)} must be millimetres from 0 to {DEEPEST}.")
            found[depth] = found[depth][..., None]
    return found


def _rows(key: str, message: Mapping[str, Any], count: int, shape: tuple[int, ...]) -> np.ndarray:
    if key not in message:
        wanted = "one pose [3, 4] from the world to the camera" if shape == POSE else "depth in millimetres"
        raise UserError(f"The request lacks {key}: this policy reads {wanted} beside every picture of the camera.")
    given = message[key]
    rows = list(given) if isinstance(given, list) or (isinstance(given, np.ndarray) and given.ndim) else None
    if rows is None or len(rows) != count:
        got = type(given).__name__ if rows is None else f"{len(rows)} entries"
        raise UserError(f"{key} must have one entry for each of {count} frames, got {got}.")
    return np.stack([_reading(key, row, shape) for row in rows])


def _reading(key: str, row: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        value = np.asarray(row)
        fits = value.dtype.kind in "fiu" and value.shape in (shape, (*shape, 1))
    except ValueError:  # rows of different lengths
        fits = False
    if not fits:
        got = f"{value.dtype} {list(value.shape)}" if isinstance(row, np.ndarray) else type(row).__name__
        raise UserError(f"{key} must hold arrays {list(shape)} of numbers, got {got}.")
    numbers = value.astype(np.float32).reshape(shape)
    if not np.isfinite(numbers).all():
        raise UserError(f"{key} holds numbers that are not finite.")
    return numbers
