"""Discs that show what would otherwise have to be remembered: on the table under a thing, wherever it is."""

from typing import TYPE_CHECKING

import sapien

from mme_vla.envs.scene.objects import Disc, build_highlight
from mme_vla.envs.scene.objects.solids import COLOURS
from mme_vla.envs.scene.things import Thing

if TYPE_CHECKING:
    from mme_vla.envs.scene.stage import Stage

RADIUS, HALF_LENGTH = 0.06, 0.001
HEIGHT = 0.0015  # metres above the table: above it, and below what lies on it
WHITE = (1.0, 1.0, 1.0)


def build_cue(env: "Stage", name: str, colour: str) -> Disc:
    """A disc that nothing can touch, waiting below the table; `colour` is one of the cubes' or white."""
    return build_highlight(env, name, RADIUS, HALF_LENGTH, COLOURS.get(colour, WHITE))


def show_cue(disc: Disc, thing: Thing) -> None:
    """Lay a disc under a thing."""
    disc.move_to(sapien.Pose([*thing.position[:2], HEIGHT], disc.pose.q))
