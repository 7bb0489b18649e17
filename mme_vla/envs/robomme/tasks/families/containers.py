"""What the four Unmask tasks share: containers over cubes, picking them up and putting
them down.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from mme_vla.envs.facts import VisibleFact
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import (
    COVER_STEPS,
    SWAP_STEPS,
    Cover,
    Cue,
    Hide,
    Swap,
    active_motions,
    consecutive_swaps,
    under,
)
from mme_vla.envs.robomme.scene.objects import (
    COLOURS,
    CONTAINER_OUTER,
    Container,
    Cube,
    H,
    build_container,
    build_hidden_cube,
)
from mme_vla.envs.robomme.scene.placement import (
    ANCHOR_HALF,
    Avoid,
    Draws,
    Point,
    Region,
    SceneError,
    draw_container,
)
from mme_vla.envs.robomme.scene.predicates import container_picked_up, container_put_down
from mme_vla.envs.robomme.tasks.families.stages import read_swaps, sample_colours
from mme_vla.envs.subtasks import Choice, SubTask
from mme_vla.envs.task import Task

UNMASK_COLOURS = ("red", "green", "blue")
MOST_PICKS = len(UNMASK_COLOURS)
PARKED = {"outer": 0, "outer cubes": 1, "inner": 2, "inner cubes": 3}
"""Groups of objects that are away at places of their own, in rows of RoboMME-OOD."""


def add_container(
    env: Task,
    draws: Draws,
    name: str,
    value: str,
    region: Region,
    avoid: Sequence[Avoid],
    gap: float,
) -> Container:
    """Add a container at the place that the row gives as `value`, or at a random one.

    Raises:
        SceneError: no place is free.
    """

    def sample() -> list[float]:
        xy, degrees = draw_container(draws, region, avoid, gap, f"{env.where}: {name}")
        return [*xy, degrees]

    x, y, degrees = env.values.place(value, sample, size=3)
    yaw = float(np.deg2rad(degrees))
    env.values.occupy(value, (x, y), CONTAINER_OUTER / 2, yaw)
    return env.add(build_container(env, name, (x, y), yaw))


class ContainerTask(Task):
    """Cubes under some of the containers, of which one or two are to be found."""

    letters: ClassVar[tuple[str, str]] = ("a", "b")
    """Options of multi-choice: picking a container up, and putting it down."""
    pick_count: int
    containers: list[Container]
    visible_motions: Sequence[Cover | Swap]
    """Set by `start_episode`: those that show what is to be remembered."""
    colours: list[str]
    over_cubes: list[Container]
    """The container over the cube of each colour."""

    def check_count(self) -> None:
        """Refuse a row with fewer containers than hidden cubes."""
        count = len(self.containers)
        self.values.require(
            count >= MOST_PICKS,
            "layout.bins",
            f"has {count} containers; expected at least {MOST_PICKS}",
        )

    def add_outer_containers(self, draws: Draws) -> None:
        """Add the containers that stand around the inner ones and belong to none of their lists;
        some hide a cube.

        The row has them as `objects.distractors`, or `objects.distractors.public` where they change
        places.
        """
        self.outer: list[Container] = []
        self.outer_hidden: list[tuple[Cube, Container]] = []
        values = self.values
        part = "objects.distractors"
        if values.find(f"{part}.public") is not None:
            part = f"{part}.public"
        table = Region((0, 0), WIDER_HALF)  # without effect: the row has their places
        for i in range(values.count(f"{part}.bins")):
            name = f"distractor_bin_{i}"
            self.outer.append(add_container(self, draws, name, f"{part}.bins.{i}", table, [], H))
        if not self.outer:
            return
        indices = values.indices(f"{part}.cube_bins", list, len(self.outer))
        colours = values.words(f"{part}.cube_colors", list, COLOURS)
        values.require(
            len(colours) == len(indices),
            f"{part}.cube_colors",
            f"has {len(colours)} colours for {len(indices)} cubes",
        )
        for j, (i, colour) in enumerate(zip(indices, colours, strict=True)):
            container = self.outer[i]
            name = f"distractor_cube_{j}_{colour}"
            cube = self.add(build_hidden_cube(self, name, colour, container.position[:2]))
            self.outer_hidden.append((cube, container))

    def visible_facts(self, ended: Mapping[int, SubTask]) -> dict[str, VisibleFact]:
        return active_motions(self.visible_motions)

    def hide_cubes(self) -> list[Cube]:
        """Put a small cube of each colour under its container."""
        cubes: list[Cube] = []
        for colour, container in zip(self.colours, self.over_cubes, strict=False):
            place = container.position[:2]
            cubes.append(self.add(build_hidden_cube(self, f"cube_{colour}", colour, place)))
        return cubes

    def parking_group(self, name: str) -> int | None:
        """Which group of `PARKED` objects belong to while they are away; None: all at one place."""
        return PARKED[name] if self.tier else None

    @property
    def contents(self) -> dict[str, Container]:
        """Colour of each hidden cube → the container over it."""
        return dict(zip(self.colours, self.over_cubes, strict=False))

    @property
    def targets(self) -> list[tuple[str, Container]]:
        """Colours to be found, in order, each with the container over it."""
        return list(self.contents.items())[: self.pick_count]

    def cues(self) -> list[Cue]:
        return [under(container, colour) for colour, container in self.contents.items()]

    def picks(self) -> list[SubTask]:
        """Pick up the container over each colour in turn, putting one down before the next."""
        steps: list[SubTask] = []
        lifted: Container | None = None
        for colour, container in self.targets:
            if lifted is not None:
                steps.append(self._put_down(lifted))
            steps.append(self._pick_up(colour, container))
            lifted = container
        return steps

    def _pick_up(self, colour: str, container: Container) -> SubTask:
        return SubTask(
            f"pick up the container that hides the {colour} cube",
            done=lambda: container_picked_up(container),
            run=lambda demo: demo.pick_container(container),
            grounded=f"pick up the container at <> that hides the {colour} cube",
            failed=lambda: self._another_lifted(container),
            targets=[container],
            choice=self.letters[0],
            pick=True,
            operation="where",
        )

    def _put_down(self, container: Container) -> SubTask:
        return SubTask(
            "put down the container",
            done=lambda: container_put_down(self, container),
            run=lambda demo: demo.put_down(),
            failed=lambda: self._another_lifted(container),
            targets=[container],
            choice=self.letters[1],
            operation="where",
        )

    def _another_lifted(self, container: Container) -> bool:
        """Whether a wrong one is up, of the inner ones or of those around them."""
        for other in (*self.containers, *self.outer):
            if other is not container and container_picked_up(other):
                return True
        return False

    def choices(self) -> list[Choice]:
        """Pick up a container (which one, a pixel says), or put the held one down."""
        up, down = self.letters
        return [
            Choice(up, "pick up the container", Demonstrator.pick_container, self.containers),
            Choice(down, "put down the container", lambda demo, _: demo.put_down()),
        ]

    def hiding_goal(self) -> str:
        """`pick up the container hiding the red cube`, and for a second colour another one."""
        (first, _), *others = self.targets
        goal = f"pick up the container hiding the {first} cube"
        for i, (colour, _) in enumerate(others, 1):
            word = "finally" if i == len(others) else "next"
            goal += f", {word} pick up another container hiding the {colour} cube"
        return goal


STANDING = {"easy": 3, "medium": 5, "hard": 15}  # in hard episodes as many as fit
STANDING_PICKS = {"easy": 1, "medium": 1, "hard": 2}
STANDING_HALF = 0.2
"""Half the side of the square in which they stand, metres."""
WIDER_HALF = 0.25
"""Likewise for more containers than the benchmark's, which also stand closer together."""


class Unmask(ContainerTask):
    """Containers that stay where they are; what comes before the picks is for the task to say."""

    def build_containers(self, draws: Draws, avoid: Sequence[Avoid]) -> None:
        """Place the containers, hide the cubes under the first three, and add what a dial or a row
        adds.
        """
        self.containers = []
        count = STANDING[self.difficulty]
        self._add_containers(draws, "layout.bins", count, avoid, STANDING_HALF, gap=2 * H)
        if self.values.specified:
            self.check_count()
        self.colours = sample_colours(self, draws, UNMASK_COLOURS)
        self.over_cubes = self.containers[: len(self.colours)]
        self.pick_count = self.values.integer(
            "objects.n_picks", lambda: STANDING_PICKS[self.difficulty], least=1, most=MOST_PICKS
        )
        self.hide_cubes()
        more = self.turned("containers")
        self._add_containers(draws, "layout.empty_bins", more, avoid, WIDER_HALF, gap=H)
        self.add_outer_containers(draws)

    def _add_containers(
        self, draws: Draws, part: str, count: int, avoid: Sequence[Avoid], half: float, gap: float
    ) -> None:
        """Place containers in the middle of the table until there are `count` more, or as many as
        the row has, or one finds no place.
        """
        for i in range(self.values.count(part, count)):
            name = f"container_{len(self.containers)}"
            taken = [*avoid, *self.containers]
            try:
                container = add_container(
                    self, draws, name, f"{part}.{i}", Region((0, 0), half), taken, gap
                )
            except SceneError:
                return
            self.containers.append(container)

    def flip_fact(self) -> dict[str, Any]:
        """The first two containers change places, and their cubes with them."""
        first, second, *others = self.values.find("layout.bins")
        return self.values.changed({"layout.bins": [second, first, *others]})

    def start_episode(self, draws: Draws) -> None:
        cover = Cover(self.containers, self.parking_group("inner"), self.contents)
        self.visible_motions = [cover]
        self.motions = [cover, Cover(self.outer, self.parking_group("outer"))]


CONTAINERS = {"easy": 3, "medium": 4, "hard": 4}
SWAPS = {"easy": (1, 2), "medium": (1, 2), "hard": (2, 3)}  # fewest and most
PICKS = {"easy": (1, 2), "medium": (1, 1), "hard": (2, 2)}


class UnmaskSwap(ContainerTask):
    """Where the containers stand, and what comes before the picks, is for the task to say."""

    def plan(self, draws: Draws) -> None:
        low, high = SWAPS[self.difficulty]
        self.swap_count = draws.integer(low, high + 1)
        low, high = PICKS[self.difficulty]
        self.pick_count = self.values.integer(
            "objects.n_picks", lambda: draws.integer(low, high + 1), least=1, most=MOST_PICKS
        )

    def build_containers(
        self, draws: Draws, anchors: Sequence[Point], avoid: Sequence[Avoid] = ()
    ) -> None:
        """Place a container near each anchor, hide the cubes, and draw which containers will begin
        a swap.

        Raises:
            SceneError: a container finds no place.
        """
        values = self.values
        self.containers = []
        count = values.count("layout.bins", len(anchors))
        for i in range(count):
            region = Region(anchors[min(i, len(anchors) - 1)], ANCHOR_HALF)
            taken = [*avoid, *self.containers]
            container = add_container(
                self, draws, f"container_{i}", f"layout.bins.{i}", region, taken, H
            )
            self.containers.append(container)
        self.check_count()
        self.colours = sample_colours(self, draws, UNMASK_COLOURS)
        over = values.indices("objects.selected", lambda: draws.permutation(3), count)
        values.require(
            len(over) == len(self.colours),
            "objects.selected",
            f"has {len(over)} containers for {len(self.colours)} cubes",
        )
        self.over_cubes = [self.containers[i] for i in over]
        self.cubes = self.hide_cubes()
        self.swap_steps = values.integer(
            "actions.swap_window.duration_steps", lambda: SWAP_STEPS, least=1
        )
        self.swapped = read_swaps(
            self, self.containers, lambda: self._draw_initiators(draws, count), distinct=False
        )
        self.swap_count = len(self.swapped)
        self.add_outer_containers(draws)
        outer = self.outer
        name = "actions.distractor_swap_pairs"
        self.outer_swapped = [(outer[a], outer[b]) for a, b in values.pairs(name, len(outer)) or []]
        swaps = len(self.outer_swapped)
        values.require(
            swaps <= self.swap_count, name, f"has {swaps} swaps, more than objects.n_swaps"
        )

    def _draw_initiators(self, draws: Draws, count: int) -> list[int]:
        draws.integer(0, count)  # part of the official stream, without effect
        initiators = draws.permutation(3)[:2]
        others = [i for i in range(count) if i not in initiators]
        initiators.append(others[draws.integer(0, len(others))])
        initiators = initiators[: self.swap_count]
        for _ in range(self.turned("swaps")):
            initiators.append(draws.integer(0, count))
        return initiators

    def flip_fact(self) -> dict[str, Any]:
        """The first two cubes change places: each is under the other's container."""
        first, second, *others = self.values.find("objects.selected")
        return self.values.changed({"objects.selected": [second, first, *others]})

    @property
    def swapped_after(self) -> int:
        """The step at which the last swap ends."""
        return COVER_STEPS + self.swap_steps * self.swap_count

    def start_episode(self, draws: Draws) -> None:
        inner, outer = self.containers, self.outer
        start, steps, end = COVER_STEPS, self.swap_steps, self.swapped_after
        swaps = consecutive_swaps(self.swapped, inner, start, steps)
        cover = Cover(inner, self.parking_group("inner"), self.contents)
        pairs = list(zip(self.cubes, self.over_cubes, strict=True))
        self.visible_motions = [cover, *swaps]
        self.motions = [
            cover,
            Cover(outer, self.parking_group("outer")),
            *swaps,
            *consecutive_swaps(self.outer_swapped, outer, start, steps),
            Hide(pairs, start, end, self.parking_group("inner cubes")),
            Hide(self.outer_hidden, start, end, self.parking_group("outer cubes")),
        ]
