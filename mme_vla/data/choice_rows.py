"""Episodes as a sequence of choices: which letter was chosen where, with which point."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mme_vla.data.waypoints import Motions
from mme_vla.embodiment.robomme import LETTERS, choice_row
from mme_vla.errors import UserError, brief
from mme_vla.files import parse_json

CHOICE_ACTIONS = "choice_actions"
CHOICE_NUMBERS = [*(f"choice_{letter}" for letter in LETTERS), "point_y", "point_x"]
"""A row of the column: at the frame where what was chosen began; all zeros at every other."""


def row_of(text: str) -> np.ndarray | None:
    """A recorded choice, `{"choice": "A", "point": [y, x]}` in pixels, as a row; None where no letter was chosen.

    Raises:
        UserError: something else.
    """
    try:
        found = parse_json(text, "a recorded choice")
        letter, point = found["choice"].strip().lower(), np.asarray(found.get("point") or (), np.float64)
    except (UserError, ValueError, TypeError, KeyError, AttributeError):
        letter, point = None, np.zeros(0)
    right = letter == "" or (letter is not None and len(letter) == 1 and letter in LETTERS)
    if not right or point.shape not in ((0,), (2,)) or not np.isfinite(point).all():
        raise UserError(f'{brief(text)} is no choice; expected {{"choice": "A", "point": [y, x]}}, letters A to H.')
    return choice_row(letter, point.tolist()) if letter else None


def find_choices(rows: np.ndarray, first: int, letters: Sequence[int]) -> Motions:
    """The choices of an execution, each decided on the frame before the one it began at, the first one at the start.

    Unlike a waypoint a choice may be made twice in a row.

    Args:
        rows: [t, w] of the execution frames. first: number of their first frame. letters: which numbers are letters.
    """
    begun: Any = np.flatnonzero(rows[:, list(letters)].any(1))
    decisions = np.maximum(begun - 1, np.arange(len(begun)))
    decisions[:1] = 0
    return Motions(decisions.astype(np.int64) + first, rows[begun].astype(np.float32))
