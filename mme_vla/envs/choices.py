"""The multi-choice action space: what can be chosen in a task, and which object a pixel means."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mme_vla.envs.robot.stick_skills import Demonstrator
    from mme_vla.envs.scene.things import Thing


@dataclass(frozen=True)
class Choice:
    """One option: its letter (lower case), its text, and the motion it means."""

    label: str
    action: str
    run: Callable[["Demonstrator", Any], None]
    """Gets the object the point chose, or None where the option needs no point."""
    candidates: Callable[[], Sequence["Thing"]] | None = None
    """Objects a point may choose among; an option with candidates needs a point."""

    @property
    def needs_point(self) -> bool:
        """Whether a pixel of the front image must come with the choice."""
        return self.candidates is not None


def nearest_to_pixel(
    point: Sequence[float], candidates: Sequence["Thing"], project: Callable[[np.ndarray], np.ndarray]
) -> "Thing":
    """The candidate whose projected origin lies nearest to the pixel [y, x]."""
    return min(candidates, key=lambda thing: float(np.linalg.norm(project(thing.position) - np.asarray(point))))
