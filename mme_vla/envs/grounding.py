"""Pixels of objects in the front image, and the sub-task texts that contain them."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mme_vla.envs.observations import INTRINSIC, front_extrinsic

if TYPE_CHECKING:
    from mme_vla.envs.robomme.scene.things import Thing
    from mme_vla.envs.subtasks import SubTask

PLACE = "<>"
"""Placeholder in a text for the pixel of an object."""


def project(point: np.ndarray) -> np.ndarray:
    """Pixel [y, x] (float64) of a point [3] of the world in the front image."""
    in_camera = front_extrinsic().astype(np.float64) @ np.append(np.asarray(point, np.float64), 1.0)
    x, y, depth = INTRINSIC.astype(np.float64) @ in_camera
    return np.array([y, x]) / depth


def centroid(segmentation: np.ndarray, ids: Sequence[int]) -> tuple[int, int] | None:
    """Mean row and mean column, cut to integers, of the pixels with one of the ids; None where
    there is no such pixel.

    Args:
        segmentation: object ids [height, width].
        ids: of the objects that share a placeholder.
    """
    rows, columns = np.nonzero(np.isin(segmentation, list(ids)))
    if not len(rows):
        return None
    return int(rows.mean()), int(columns.mean())


def ground(text: str, targets: Sequence["Thing"], segmentation: np.ndarray) -> str | None:
    """Fill each `<>` of a text with the pixel of its object, `<y, x>`; None if one of them is
    hidden.

    A single `<>` takes all targets together; several take one target each, in order.
    """
    places = text.count(PLACE)
    groups = [[target] for target in targets]
    if places == 1:
        groups = [list(targets)]
    if len(groups) != places or not all(groups):
        raise ValueError(f"{text!r} has {places} places for {len(targets)} targets")
    for group in groups:
        pixel = centroid(segmentation, [i for target in group for i in target.segmentation_ids])
        if pixel is None:
            return None
        text = text.replace(PLACE, f"<{pixel[0]}, {pixel[1]}>", 1)
    return text


class Grounding:
    """The grounded text of an episode's sub-tasks: computed when a sub-task begins, and kept until
    the next one.

    Args:
        retry: while an object is hidden, try again at each frame; otherwise keep the text without
            pixels.
    """

    def __init__(self, retry: bool = True) -> None:
        self.retry = retry
        self._subtask: SubTask | None = None
        self._text: str | None = None
        self._settled = False

    def update(self, subtask: "SubTask", segmentation: Callable[[], np.ndarray] | None) -> str:
        """The text at this frame.

        Args:
            subtask: whose text is shown now.
            segmentation: reads the object ids of the present image; called only when needed. None:
                no images.
        """
        if subtask is not self._subtask:
            self._subtask, self._text = subtask, None
            self._settled = PLACE not in subtask.grounded_text
            if self._settled:
                self._text = subtask.grounded_text
        if not self._settled and segmentation is not None:
            self._text = ground(subtask.grounded_text, subtask.targets, segmentation())
            self._settled = self._text is not None or not self.retry
        return subtask.text if self._text is None else self._text
