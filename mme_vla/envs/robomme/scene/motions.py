"""What the script of a task moves: containers, swaps, highlights, marks, traces, and the cue discs
of twin scenes.

Motions are functions of the number of control steps done, or of the state of the task.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import sapien

from mme_vla.envs.facts import VisibleFact
from mme_vla.envs.robomme.scene.arithmetic import norm
from mme_vla.envs.robomme.scene.objects import (
    BELOW_TABLE,
    COLOURS,
    RGB,
    WHITE,
    Disc,
    build_highlight,
    build_sphere,
)
from mme_vla.envs.robomme.scene.things import AWAY, Thing, distance_xy

if TYPE_CHECKING:
    from mme_vla.envs.robomme.scene.stage import Stage


type Place = Sequence[float] | np.ndarray

PARKED_ROW = 16
UNCOVERED_STEPS = 32
"""The first half of the covering window: containers are away and the cubes lie open."""
COVER_STEPS = 64
SWAP_STEPS = 50


def smoothstep(x: float) -> float:
    """x²(3 - 2x): from 0 to 1 with no speed at either end."""
    return x * x * (3 - 2 * x)


def parked(group: int | None, i: int) -> Place:
    """Where object `i` of a group is out of the scene: at `AWAY`, or, in a group with a number, at
    a place of its own, since many at one place press against each other.
    """
    if group is None:
        return AWAY
    return 20 + 0.5 * (i % PARKED_ROW), 20 + 0.5 * (4 * group + i // PARKED_ROW), 10.0


class Motion(Protocol):
    """What the script moves before the physics of a step."""

    def apply(self, k: int) -> None:
        """Move the objects for the step before which `k` steps were done."""


class Appear:
    """An object is away for a number of steps, then appears at its place."""

    def __init__(self, thing: Thing, until: int, away: Place = AWAY) -> None:
        self.thing = thing
        self.until = until
        self.away = away
        self.home = thing.pose

    def apply(self, k: int) -> None:
        """Move the object for the step before which `k` steps were done."""
        if k < self.until:
            self.thing.move_to(sapien.Pose(self.away, self.home.q))
        elif k == self.until:
            self.thing.move_to(self.home)


class Cover:
    """Containers are away for half of a window and then stand over what lay open. active: they are
    away.
    """

    active = False

    def __init__(
        self,
        containers: Sequence[Thing],
        group: int | None = None,
        contents: "Mapping[str, Thing] | None" = None,
    ) -> None:
        """`group`: park each container at a place of its own (`parked`); None: all at one.
        `contents`: what lay open → the container that will stand over it.
        """
        self._contents = contents or {}
        self._parts = []
        for i, container in enumerate(containers):
            self._parts.append(Appear(container, UNCOVERED_STEPS, parked(group, i)))

    def apply(self, k: int) -> None:
        """Move the containers for the step before which `k` steps were done."""
        self.active = k < UNCOVERED_STEPS
        for part in self._parts:
            part.apply(k)

    def fact(self) -> VisibleFact:
        """What lies open, and where."""
        texts, names = [], []
        for cube, container in self._contents.items():
            texts.append(f"{cube}: {container.name}")
            names.append(container.name)
        return VisibleFact(", ".join(texts), frozenset(names))


class Swap:
    """Two objects change places on arcs around each other while all others stand still. active:
    they move.

    Args:
        initiator: one of the two; the other is `partner`, by default the nearest one when the swap
            begins.
        group: every object that takes part or is to be kept in its place.
        start: step at which it begins.
        lane: how far the two evade each other sideways, metres.
        steps: how long it takes.
    """

    active = False

    def __init__(
        self,
        initiator: Thing,
        group: Sequence[Thing],
        start: int,
        lane: float = 0.07,
        partner: Thing | None = None,
        steps: int = SWAP_STEPS,
    ) -> None:
        self.initiator = initiator
        self.partner = partner
        self.start = start
        self.lane = lane
        self.steps = steps
        self._group = list(group)
        self._poses: dict[Thing, sapien.Pose] = {}

    @property
    def end(self) -> int:
        """The step at which the two have changed places."""
        return self.start + self.steps

    def apply(self, k: int) -> None:
        """Move the objects for the step before which `k` steps were done."""
        self.active = self.start <= k <= self.end
        if not self.active:
            return
        if k == self.start:
            self._poses = {thing: thing.pose for thing in self._group}
            if self.partner is None:
                origin = self.initiator.position
                others = [thing for thing in self._group if thing is not self.initiator]
                self.partner = min(others, key=lambda thing: distance_xy(thing.position, origin))
        assert self.partner is not None
        a, b = self._poses[self.initiator], self._poses[self.partner]
        alpha = smoothstep((k - self.start) / self.steps)
        way = b.p[:2] - a.p[:2]
        aside = np.array([-way[1], way[0]]) / max(float(np.linalg.norm(way)), 1e-9)
        arc = way * alpha + aside * self.lane * math.sin(math.pi * (k - self.start) / self.steps)
        if k == self.end:
            arc = way
        poses = dict(self._poses)
        poses[self.initiator] = sapien.Pose([*(a.p[:2] + arc), a.p[2]], blend(a.q, b.q, alpha))
        poses[self.partner] = sapien.Pose([*(b.p[:2] - arc), b.p[2]], blend(b.q, a.q, alpha))
        for thing, pose in poses.items():
            thing.move_to(pose)

    def fact(self) -> VisibleFact:
        """Which two change places."""
        assert self.partner is not None
        names = (self.initiator.name, self.partner.name)
        return VisibleFact(" and ".join(names), frozenset(names), replaces=True)


def consecutive_swaps(
    pairs: Sequence[tuple[Thing, Thing | None]],
    group: Sequence[Thing],
    start: int,
    steps: int = SWAP_STEPS,
) -> list[Swap]:
    """One swap after another, the first at step `start`.

    pairs: of each swap its initiator and its partner, as `Swap` takes them.
    """
    swaps = []
    for initiator, partner in pairs:
        swaps.append(Swap(initiator, group, start, partner=partner, steps=steps))
        start += steps
    return swaps


def blend(a: np.ndarray, b: np.ndarray, alpha: float) -> np.ndarray:
    """Linear mixture of two quaternions, normalised."""
    mixed = (1 - alpha) * np.asarray(a) + alpha * np.asarray(b)
    return mixed / norm(mixed)


def active_motions(motions: "Sequence[Cover | Swap | Highlight]") -> dict[str, VisibleFact]:
    """The motions that take place, each a fact named by its kind and number: `swap 0`."""
    facts = {}
    for i, motion in enumerate(motions):
        if motion.active:
            facts[f"{type(motion).__name__.lower()} {i}"] = motion.fact()
    return facts


class Hide:
    """Hidden objects are away during a window; at its end each lies under its container again."""

    def __init__(
        self, hidden: Sequence[tuple[Thing, Thing]], start: int, end: int, group: int | None = None
    ) -> None:
        """`group`: park each object at a place of its own (`parked`); None: all at one."""
        self._hidden = list(hidden)
        self._start = start
        self._end = end
        self._homes = [thing.pose for thing, _ in self._hidden]
        self._away = [parked(group, i) for i in range(len(self._hidden))]

    def apply(self, k: int) -> None:
        """Move the hidden objects for the step before which `k` steps were done."""
        rows = zip(self._hidden, self._homes, self._away, strict=True)
        for (thing, container), home, away in rows:
            if self._start <= k < self._end:
                thing.move_to(sapien.Pose(away, home.q))
            elif k == self._end:
                thing.move_to(sapien.Pose([*container.position[:2], home.p[2]], home.q))


class Highlight:
    """A white disc under an object from one step to another, both included. active: it
    is visible.
    """

    active = False
    DEPTH = 0.01
    """How far below the object's origin the disc lies, metres."""

    def __init__(self, disc: Thing, thing: Thing, start: int, end: int) -> None:
        self._disc = disc
        self._thing = thing
        self._start = start
        self._end = end

    def apply(self, k: int) -> None:
        """Move the disc for the step before which `k` steps were done."""
        self.active = self._start <= k <= self._end
        place: Place = BELOW_TABLE
        if self.active:
            place = self._thing.position - [0, 0, self.DEPTH]
        self._disc.move_to(sapien.Pose(place, self._disc.pose.q))

    def fact(self) -> VisibleFact:
        """Which object is highlighted."""
        return VisibleFact(self._thing.name, {self._thing.name})


def build_mark(env: "Stage", name: str, radius: float, half_length: float) -> Disc:
    """Red rings that cover a target's own, for `Mark`; metres."""
    return build_highlight(env, name, radius, half_length, COLOURS["red"], rings=True)


class Mark:
    """A red disc over a target for a number of steps after it was last touched.

    Args:
        disc: what marks the target.
        place: the origin of what is marked, [3]; the disc's centre lies `Highlight.DEPTH` below it.
        steps: how long it stays, beside the step of the touch itself.
    """

    def __init__(self, disc: Thing, place: np.ndarray, steps: int) -> None:
        self._disc = disc
        self._place = place - [0, 0, Highlight.DEPTH]
        self._steps = steps
        self._until = -1
        self._visible = False
        self._move(BELOW_TABLE)

    def update(self, k: int, touched: bool) -> None:
        """Show or hide the disc after step `k`."""
        if touched:
            self._until = k + self._steps
        if (k <= self._until) != self._visible:
            self._visible = not self._visible
            self._move(self._place if self._visible else BELOW_TABLE)

    def _move(self, place: Sequence[float] | np.ndarray) -> None:
        self._disc.move_to(sapien.Pose(place, self._disc.pose.q))


class Trace:
    """White dots where the tip of the stick went, each for 40 steps."""

    STEPS, RADIUS, HEIGHT, BELOW = 40, 0.005, 0.01, 0.1

    def __init__(self, env: "Stage") -> None:
        self._env = env
        self._dots = [build_sphere(env, f"trace_{i}", self.RADIUS) for i in range(self.STEPS)]

    def restart(self) -> None:
        """Forget every dot."""
        for dot in self._dots:
            dot.move_to(sapien.Pose(BELOW_TABLE))

    def update(self, k: int) -> None:
        """Place the dot of step `k`; it replaces that of 40 steps before."""
        x, y, z = self._env.tcp_pose.p
        place = BELOW_TABLE
        if z < self.BELOW:
            place = (x, y, self.HEIGHT)
        self._dots[k % self.STEPS].move_to(sapien.Pose(place))


CUE_RADIUS, CUE_HALF_LENGTH = 0.06, 0.001
CUE_HEIGHT = 0.0015  # metres above the table: above it, and below what lies on it
CUE_COLOURS: dict[str, RGB] = {**COLOURS, "white": WHITE, "yellow": (1.0, 0.8, 0.0)}
TALLY_X, TALLY_RADIUS, TALLY_SPACING = 0.34, 0.015, 0.045
"""Of the row of a tally: nearer to the front camera than any other object; metres."""


@dataclass(frozen=True)
class Cue:
    """One disc. colour: of `CUE_COLOURS`. radius: metres."""

    colour: str
    place: Callable[[], Place | None]
    """Where its centre is now [3], metres; None: not to be seen."""
    radius: float = CUE_RADIUS


def on_table(place: Place) -> tuple[float, float, float]:
    """Where a disc lies that is centred at a place [2] or [3]."""
    return float(place[0]), float(place[1]), CUE_HEIGHT


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
