"""Where the few objects that change places stand: each near an anchor of a triangle, a line or a square."""

import math
from collections.abc import Sequence

from mme_vla.envs.scene.draws import Draws
from mme_vla.envs.scene.motions import SWAP_STEPS, Swap
from mme_vla.envs.scene.things import Thing

type Point = tuple[float, float]

ANCHOR_HALF = 0.07
"""Half the side of the square around an anchor in which an object is placed, metres."""
ANGLE_RANGE = 180
"""Radians, although meant as degrees: in effect any angle."""
SHIFT = 0.1
"""How far anchors that are not rotated may be shifted, metres."""


def rotated_anchors(draws: Draws, count: int) -> list[Point]:
    """Three anchors in a triangle or on a line, or four in a square, rotated about the table's middle."""
    on_line = draws.integer(0, 2)  # drawn for four anchors, too
    angle = draws.uniform() * ANGLE_RANGE
    triangle = [(-0.05, -0.1), (-0.05, 0.1), (0.1, 0.0)]
    line = [(0.0, -0.15), (0.0, 0.15), (0.0, 0.0)]
    square = [(-0.05, -0.1), (-0.05, 0.1), (0.1, 0.1), (0.1, -0.1)]
    anchors = square if count == len(square) else line if on_line else triangle
    cos, sin = math.cos(angle), math.sin(angle)
    return [(cos * x - sin * y, sin * x + cos * y) for x, y in anchors]


def shifted_anchors(draws: Draws, count: int) -> list[Point]:
    """Three anchors in a triangle or on a line, each shifted forward, or four of which pairs are shifted sideways."""
    left, right = (draws.uniform() * SHIFT for _ in range(2))
    a, b = ([draws.uniform() * SHIFT for _ in range(3)] for _ in range(2))
    on_line = draws.integer(0, 2)
    triangle = [(-0.05 + a[0], -0.15), (-0.05 + a[1], 0.15), (0.05 + a[2], 0.0)]
    line = [(-0.05 + b[0], -0.15), (-0.05 + b[1], 0.15), (-0.05 + b[2], 0.0)]
    square = [(0.0, -0.1 + left), (0.0, 0.1 + left), (0.1, 0.1 + right), (0.1, -0.1 + right)]
    return square if count == len(square) else line if on_line else triangle


def swaps_in_turn(initiators: Sequence[Thing], group: Sequence[Thing], start: int) -> list[Swap]:
    """One swap after another, the first at step `start`; each initiator's partner is who is nearest then."""
    return [Swap(thing, group, start + i * SWAP_STEPS) for i, thing in enumerate(initiators)]
