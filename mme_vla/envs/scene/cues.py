"""Discs that show what would otherwise have to be remembered: under a thing, where to go, or how often still.

Nothing can touch them, and where they lie follows from the state of the task alone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import sapien

from mme_vla.envs.scene.objects import COLOURS, RGB, WHITE, Disc, build_highlight
from mme_vla.envs.scene.objects.shapes import BELOW_TABLE
from mme_vla.envs.scene.things import Thing

if TYPE_CHECKING:
    from mme_vla.envs.scene.stage import Stage

type Place = Sequence[float] | np.ndarray

RADIUS, HALF_LENGTH = 0.06, 0.001
HEIGHT = 0.0015  # metres above the table: above it, and below what lies on it
CUE_COLOURS: dict[str, RGB] = {**COLOURS, "white": WHITE, "yellow": (1.0, 0.8, 0.0)}
TALLY_X, TALLY_RADIUS, TALLY_SPACING = 0.34, 0.015, 0.045
"""Of the row of a tally: nearer to the front camera than anything that is drawn or moved; metres."""


@dataclass(frozen=True)
class Cue:
    """One disc. colour: of `CUE_COLOURS`. radius: metres."""

    colour: str
    place: Callable[[], Place | None]
    """Where its centre is now [3], metres; None: not to be seen."""
    radius: float = RADIUS


def on_table(place: Place) -> tuple[float, float, float]:
    """Where a disc lies that is centred at a place [2] or [3]."""
    return float(place[0]), float(place[1]), HEIGHT


def under(thing: Thing, colour: str = "white") -> Cue:
    """A disc that lies under a thing, wherever it is."""
    return Cue(colour, lambda: on_table(thing.position))


def row(count: int) -> list[float]:
    """Where so many discs of a tally lie across the table, about its middle; metres."""
    return [TALLY_SPACING * (i - (count - 1) / 2) for i in range(count)]


def tally(places: Sequence[float], left: Callable[[], int], colour: str = "yellow") -> list[Cue]:
    """Discs at the front of the table, of which as many are to be seen as repetitions are left.

    Args:
        places: across the table, in metres; the last disc goes first.
        left: counts the repetitions that are still to be done.
        colour: of `CUE_COLOURS`.
    """

    def lie(i: int, y: float) -> Callable[[], Place | None]:
        return lambda: on_table((TALLY_X, y)) if i < left() else None

    return [Cue(colour, lie(i, y), TALLY_RADIUS) for i, y in enumerate(places)]


def build_cue(env: "Stage", name: str, cue: Cue) -> Disc:
    """A cue's disc, waiting below the table."""
    return build_highlight(env, name, cue.radius, HALF_LENGTH, CUE_COLOURS[cue.colour])


def show_cue(disc: Disc, cue: Cue) -> None:
    """Move a disc to where its cue is now."""
    place = cue.place()
    disc.move_to(sapien.Pose(BELOW_TABLE if place is None else place, disc.pose.q))
