"""Random numbers of a scene, and random places on the table that keep clear of the objects there.

The same seed samples the same layout as the official benchmark. All layout randomness comes from
CPU torch generators seeded with the episode's seed; the order of the samples is part of the
benchmark's definition. So are the tests for a free place: an obstacle is the shadow of the first
two axes of its bounding box, whichever these are, and what counts as the gap depends on what is
placed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from mani_skill.utils.geometry.trimesh_utils import get_component_meshes, merge_meshes
from sapien import physx
from torch import Tensor

from mme_vla.envs.robomme.scene.arithmetic import matrix_product
from mme_vla.envs.robomme.scene.articulated import BUTTON_BASE, Button
from mme_vla.envs.robomme.scene.bounding_box import shadow_of_smallest_box
from mme_vla.envs.robomme.scene.objects import Board, Disc, H
from mme_vla.envs.robomme.scene.things import Thing
from mme_vla.errors import SceneError


class Draws:
    """One generator, with the few kinds of samples that scenes need."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def uniform(self) -> float:
        """One number in [0, 1)."""
        return torch.rand(1, generator=self._generator).item()

    def uniforms(self, n: int) -> Tensor:
        """`n` numbers in [0, 1) in one call, float32 [n]; not the same stream as `n` single
        samples.
        """
        return torch.rand(n, generator=self._generator)

    def between(self, low: float, high: float) -> float:
        """One number in [low, high), as torch's `uniform_` gives it where it multiplies and adds at
        once.
        """
        low_bound, high_bound = np.float32(low), np.float32(high)
        # Exact in double precision but for the last addition, so that the float32 is rounded once
        # on every CPU.
        width = np.float64(high_bound - low_bound)
        return float(np.float32(np.float64(self.uniform()) * width + np.float64(low_bound)))

    def integer(self, low: int, high: int) -> int:
        """One integer in low … high - 1."""
        return int(torch.randint(low, high, (1,), generator=self._generator).item())

    def permutation(self, n: int) -> list[int]:
        """The numbers 0 … n - 1 in random order."""
        return torch.randperm(n, generator=self._generator).tolist()

    def coin(self) -> bool:
        """True in half of the cases: one uniform below 0.5."""
        return self.uniform() < 0.5

    def state(self) -> Tensor:
        """Where the stream stands, for `restore`."""
        return self._generator.get_state()

    def restore(self, state: Tensor) -> None:
        """Go back to where the stream stood when `state` was taken."""
        self._generator.set_state(state)


TRIALS = 256
CONTAINER_HALF = 0.0275
"""Half the width of a container as the placement counts it, metres."""
BUTTON_CLEARANCE = 1.5 * BUTTON_BASE[0]


@dataclass(frozen=True)
class Region:
    """A rectangle along the table's axes; `half` is half its width, one number or one per axis;
    metres.
    """

    centre: tuple[float, float]
    half: float | tuple[float, float]

    def place(self, draws: Draws, margin: float) -> np.ndarray:
        """Sample a point that keeps `margin` from the edges [2]; x comes first."""
        half = self.half
        if not isinstance(half, tuple):
            half = (half, half)
        point = []
        for centre, extent in zip(self.centre, half, strict=True):
            low = centre - extent + margin
            high = centre + extent - margin
            point.append(low + draws.uniform() * (high - low))
        return np.array(point)


@dataclass(frozen=True, eq=False)
class Box2D:
    """A rectangle on the table in any direction; an axis of length zero makes it a line.

    centre: [2].
    axes: [2, 2], one direction a row.
    half: half its width along each axis [2]; metres.
    """

    centre: np.ndarray
    axes: np.ndarray
    half: np.ndarray

    @classmethod
    def aligned(cls, centre: Sequence[float] | np.ndarray, half: Sequence[float]) -> "Box2D":
        """A rectangle along the table's axes."""
        return cls(np.array(centre, float)[:2], np.eye(2), np.array(half, float))

    @classmethod
    def square(cls, centre: np.ndarray, half: float, yaw: float) -> "Box2D":
        """A square turned by `yaw` radians."""
        cos, sin = math.cos(yaw), math.sin(yaw)
        return cls(centre, np.array([[cos, sin], [-sin, cos]]), np.array([half, half]))

    def grown(self, gap: float) -> "Box2D":
        """The rectangle with `gap` more on every side."""
        return Box2D(self.centre, self.axes, self.half + gap)

    def distance(self, point: np.ndarray) -> float:
        """From a point to the nearest point of the rectangle, metres."""
        offset = point - self.centre
        nearest = np.zeros(2)
        for axis, half in zip(self.axes, self.half, strict=True):
            nearest = nearest + np.clip(_dot(axis, offset), -half, half) * axis
        return _length(offset - nearest)

    def intersects(self, other: "Box2D") -> bool:
        """Whether the two overlap or touch: no side of either separates them."""
        offset = other.centre - self.centre
        for axis in (*self.axes, *other.axes):
            if abs(_dot(offset, axis)) > self._reach(axis) + other._reach(axis):
                return False
        return True

    def _reach(self, direction: np.ndarray) -> float:
        """How far the rectangle extends from its centre along a direction, metres."""
        along = self.half[0] * abs(_dot(self.axes[0], direction))
        across = self.half[1] * abs(_dot(self.axes[1], direction))
        return along + across


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Inner product of two vectors [2]; that of BLAS is rounded otherwise on some CPUs."""
    return a[0] * b[0] + a[1] * b[1]


def _length(a: np.ndarray) -> float:
    return math.sqrt(_dot(a, a))


type Avoid = Thing | Box2D


def obstacle_box(thing: Thing) -> Box2D:
    """What an object occupies: its bounding box's first two axes on the table.

    The axes of a smallest bounding box come in no particular order. Where one of the first two is
    the vertical, the obstacle is only a line.

    Raises:
        SceneError: nothing of the object can be touched.
    """
    body = thing.entity._objs[0].find_component_by_type(physx.PhysxRigidDynamicComponent)
    mesh = merge_meshes(get_component_meshes(body))
    if mesh is None:
        raise SceneError(f"{thing.name} has no collision shape; it cannot be an obstacle.")
    pose = body.pose.to_transformation_matrix().astype(np.float64)
    vertices = matrix_product(pose[:3, :3], np.asarray(mesh.vertices).T).T + pose[:3, 3]
    return Box2D(*shadow_of_smallest_box(vertices.tobytes(), mesh.faces.tobytes()))


def button_box(button: Button) -> Box2D:
    """What a button occupies: its base and half as much around it."""
    return Box2D.aligned(button.pose.p, (BUTTON_CLEARANCE, BUTTON_CLEARANCE))


def board_boxes(board: Board) -> list[Box2D]:
    """What the board with a hole occupies: its four strips, as if it were not turned."""
    x, y = board.position[:2]
    return [
        Box2D.aligned((x, y + 0.045), (0.05, 0.005)),
        Box2D.aligned((x, y - 0.045), (0.05, 0.005)),
        Box2D.aligned((x + 0.045, y), (0.005, 0.04)),
        Box2D.aligned((x - 0.045, y), (0.005, 0.04)),
    ]


def draw_cube(
    draws: Draws,
    region: Region,
    avoid: Sequence[Avoid] = (),
    gap: float = 0.005,
    what: str = "A cube",
) -> tuple[np.ndarray, float]:
    """Sample the position and the yaw of a cube; targets are no obstacles.

    Args:
        region: the cube keeps inside it, as if it were not turned.
        avoid: what it keeps clear of.
        gap: metres.
        what: names the cube in the error.

    Returns:
        Centre [2] and yaw in radians.

    Raises:
        SceneError: 256 trials have failed.
    """
    obstacles = _obstacles(avoid)
    for _ in range(TRIALS):
        xy = region.place(draws, H)
        angle = 2 * np.pi * draws.uniform()
        cube = Box2D.square(xy, H + gap, angle)
        if not any(cube.intersects(obstacle) for obstacle in obstacles):
            return xy, angle
    raise SceneError(f"{what} finds no place.")


def draw_disc(
    draws: Draws,
    region: Region,
    radius: float,
    avoid: Sequence[Avoid] = (),
    gap: float = 0.005,
    what: str = "A target",
) -> np.ndarray:
    """Sample the centre of a target [2].

    Args:
        region: the target lies wholly inside it.
        radius: metres.
        avoid: what it keeps clear of; other targets are circles.
        gap: metres.
        what: names the target in the error.

    Raises:
        SceneError: 256 trials have failed.
    """
    circles = [(disc.position[:2], disc.radius) for disc in avoid if isinstance(disc, Disc)]
    obstacles = _obstacles(avoid)
    for _ in range(TRIALS):
        xy = region.place(draws, radius)
        clear = all(obstacle.distance(xy) >= radius + gap for obstacle in obstacles)
        if clear and all(_length(xy - centre) >= radius + gap + other for centre, other in circles):
            return xy
    raise SceneError(f"{what} finds no place.")


def draw_container(
    draws: Draws,
    region: Region,
    avoid: Sequence[Avoid] = (),
    gap: float = 0.005,
    what: str = "A container",
) -> tuple[np.ndarray, float]:
    """Sample the position of a container and then its yaw, 0 … 90°; the gap to other objects counts
    twice.

    Args:
        region: the container lies inside it.
        avoid: what it keeps clear of.
        gap: metres.
        what: names the container in the error.

    Returns:
        Centre [2] and yaw in degrees, as rows have it.

    Raises:
        SceneError: 256 trials have failed.
    """
    obstacles = _obstacles(avoid, grow=gap)
    for _ in range(TRIALS):
        xy = region.place(draws, CONTAINER_HALF)
        if all(obstacle.distance(xy) >= CONTAINER_HALF + gap for obstacle in obstacles):
            return xy, 90 * draws.uniform()
    raise SceneError(f"{what} finds no place.")


def draw_button(
    draws: Draws, centre: tuple[float, float], range: tuple[float, float] = (0.1, 0.4)
) -> tuple[float, float]:
    """Sample the centre of a button in a rectangle of these widths, metres."""
    x, y = (draws.uniforms(2) - 0.5).tolist()
    return centre[0] + x * range[0], centre[1] + y * range[1]


def _obstacles(avoid: Sequence[Avoid], grow: float = 0.0) -> list[Box2D]:
    """What things other than targets occupy; objects without a rule of their own grow by `grow`."""
    boxes: list[Box2D] = []
    for item in avoid:
        if isinstance(item, Disc):
            continue
        if isinstance(item, Box2D):
            boxes.append(item)
        elif isinstance(item, Button):
            boxes.append(button_box(item))
        elif isinstance(item, Board):
            boxes += board_boxes(item)
        else:
            boxes.append(obstacle_box(item).grown(grow))
    return boxes


type Point = tuple[float, float]

ANCHOR_HALF = 0.07
"""Half the side of the square around an anchor in which an object is placed, metres."""
ANGLE_RANGE = 180
"""Radians, although meant as degrees: in effect any angle."""
SHIFT = 0.1
"""How far anchors that are not rotated may be shifted, metres."""


def rotated_anchors(draws: Draws, count: int) -> list[Point]:
    """Three anchors in a triangle or on a line, or four in a square, rotated about the table's
    middle.
    """
    on_line = draws.integer(0, 2)  # sampled for four anchors, too
    angle = draws.uniforms(1) * ANGLE_RANGE
    triangle = [(-0.05, -0.1), (-0.05, 0.1), (0.1, 0.0)]
    line = [(0.0, -0.15), (0.0, 0.15), (0.0, 0.0)]
    square = [(-0.05, -0.1), (-0.05, 0.1), (0.1, 0.1), (0.1, -0.1)]
    if count == len(square):
        anchors = square
    elif on_line:
        anchors = line
    else:
        anchors = triangle
    cos, sin = angle.cos(), angle.sin()  # in single precision, as the benchmark has it
    return [((cos * x - sin * y).item(), (sin * x + cos * y).item()) for x, y in anchors]


def shifted_anchors(draws: Draws, count: int) -> list[Point]:
    """Three anchors in a triangle or on a line, each shifted forward, or four of which pairs are
    shifted sideways.
    """
    left = draws.uniform() * SHIFT
    right = draws.uniform() * SHIFT
    a = [draws.uniform() * SHIFT for _ in range(3)]
    b = [draws.uniform() * SHIFT for _ in range(3)]
    on_line = draws.integer(0, 2)
    triangle = [(-0.05 + a[0], -0.15), (-0.05 + a[1], 0.15), (0.05 + a[2], 0.0)]
    line = [(-0.05 + b[0], -0.15), (-0.05 + b[1], 0.15), (-0.05 + b[2], 0.0)]
    square = [(0.0, -0.1 + left), (0.0, 0.1 + left), (0.1, 0.1 + right), (0.1, -0.1 + right)]
    if count == len(square):
        return square
    return line if on_line else triangle
