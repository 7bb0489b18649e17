"""Episodes as a sequence of planned motions: where each was decided, and where it was to end."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mme_vla.embodiment.robomme import CHOICE_SPACE, LETTERS, SIDE, choice_action
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.utils import parse_json


@dataclass(frozen=True)
class Motions:
    """The motions of one episode's execution.

    decisions: [m] int64, ascending; the last frame seen before each motion began.
    targets: [m, w] float32.
    """

    decisions: np.ndarray
    targets: np.ndarray

    def chunk(self, frame: int | np.ndarray, horizon: int) -> tuple[np.ndarray, np.ndarray]:
        """The motions decided at `frame` and after it, the last one repeated; see
        `EpisodeSource.action_chunk`.

        Returns:
            [horizon, w] float32, and [horizon] bool that is False on repeated ones.
        """
        places = np.searchsorted(self.decisions, frame)[..., None] + np.arange(horizon)
        return self.targets[np.minimum(places, len(self.targets) - 1)], places < len(self.targets)

    def before(self, frame: int, most: int) -> np.ndarray:
        """The last motions, at most so many, that were decided before `frame`; [n, w]."""
        stop = int(np.searchsorted(self.decisions, frame))
        return self.targets[max(stop - most, 0) : stop]


def find_motions(rows: np.ndarray, first: int, letters: Sequence[int] = ()) -> Motions:
    """Take apart a column of planned motions: targets of the motion under way at every frame, or
    choices at the frames where they began.

    A motion begins where its target first is in the column: that frame was seen when it had already
    begun, so it was decided one frame before. The first one was decided at the first execution
    frame. Unlike a target, a choice may be made twice in a row.

    Args:
        rows: [t, w] of the execution frames; targets are NaN where no motion was noted yet.
        first: number of their first frame.
        letters: of choices, which numbers are letters; a row without one is no choice.
    """
    if letters:
        begun: Any = np.flatnonzero(rows[:, list(letters)].any(1))
    else:
        noted = np.flatnonzero(np.isfinite(rows).all(1))
        targets = rows[noted]
        new = np.ones(len(noted), bool)
        new[1:] = (targets[1:] != targets[:-1]).any(1)
        begun = noted[new]
    decisions = np.maximum(begun - 1, np.arange(len(begun)))
    decisions[:1] = 0
    return Motions(decisions.astype(np.int64) + first, rows[begun].astype(np.float32))


def known_poses(
    noted: np.ndarray, exec_start: int, reached: Callable[[int], np.ndarray]
) -> np.ndarray:
    """Poses of every step from those that were noted; see `RawEpisode.pose_actions`.

    Args:
        noted: [t, 7], NaN where there was none yet.
        exec_start: the first execution step.
        reached: the pose [7] that a step's action commands, by its number.

    Returns:
        [t, 7] float32.
    """
    rows = noted.astype(np.float32)
    for part in (slice(0, exec_start), slice(exec_start, len(rows))):
        unknown = np.count_nonzero(np.isfinite(rows[part]), axis=1) < rows.shape[1]
        if part.stop > part.start and unknown.all():
            rows[part] = reached(part.stop - 1)
        elif unknown.any():
            rows[part][unknown] = rows[part][~unknown][0]
    return rows


CHOICE_ACTIONS = "choice_actions"
CHOICE_NUMBERS = [*LETTERS, "y", "x"]
"""A row of the column: at the frame where what was chosen began; all zeros at every other."""


def row_of(text: str, options: Sequence[Mapping[str, Any]] | None = None) -> np.ndarray | None:
    """A recorded choice, `{"choice": "A", "point": [y, x]}` in pixels, as a row; None where no
    letter was chosen.

    Args:
        options: what the episode offers, each with `label` and `need_parameter`; None where that
            is not known.
    """
    try:
        choice = parse_json(text, "a recorded choice")
        letter = choice["choice"].strip().lower()
        point = np.asarray(choice.get("point") or (), np.float64)
        is_valid = point.shape in ((0,), (2,)) and bool(((point >= 0) & (point <= SIDE)).all())
    except (UserError, ValueError, TypeError, KeyError, AttributeError):
        is_valid = False
    require(
        is_valid and letter in ("", *LETTERS),
        f'{brief(text)} is no choice; expected {{"choice": "A", "point": [y, x]}}, letters A to H'
        f" and pixels to {SIDE}.",
    )
    if not letter:
        return None
    if options is not None:
        needs_point = {str(option["label"]): option["need_parameter"] for option in options}
        require(
            letter in needs_point,
            f"{brief(text)} chooses {letter!r}, but the episode offers {listed(needs_point)}.",
        )
        require(
            len(point) or not needs_point[letter],
            f"{brief(text)} has no point, which the option {letter!r} needs.",
        )
    return choice_action(CHOICE_SPACE, {"choice": letter, "point": point.tolist()})
