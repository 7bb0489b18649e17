"""BinFill (Counting): put a number of cubes of each colour into the bin, some appear only later."""

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from itertools import islice
from typing import Any

import sapien

from mme_vla.envs.robomme.scene.motions import Appear, Cue, row, tally
from mme_vla.envs.robomme.scene.objects import Cube, H, build_board, build_cube
from mme_vla.envs.robomme.scene.placement import Draws, Region, SceneError, draw_cube
from mme_vla.envs.robomme.scene.predicates import (
    ON_TARGET,
    any_picked_up,
    dropped,
    pressed,
    released_and_away,
)
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import add_button, choices_made, press
from mme_vla.envs.subtasks import Choice, SubTask, number, ordinal
from mme_vla.envs.task import Task

# Both bounds belong to the range.
AVAILABLE = {"easy": 1, "medium": 2, "hard": 3}
GOAL_COLOURS = {"easy": (1, 1), "medium": (1, 2), "hard": (2, 3)}
GOAL_CUBES = {"easy": (1, 3), "medium": (2, 4), "hard": (3, 5)}
CUBES = {"easy": (4, 6), "medium": (8, 10), "hard": (10, 12)}
COLOURS = ("red", "blue", "green")
ORDERED = ("blue", "red", "green")  # from which the order of the sub-tasks is sampled
BOARD_X = 0.15  # metres
TABLE = Region((-0.1, 0.0), (0.2, 0.25))
APPEAR_EVERY = 50
IN_BIN = sapien.Pose((10.0, 10.0, 0.0))


@register_task
class BinFill(Task):
    """Any cube counts towards its colour; the counts are judged at the button."""

    shared_draws = True
    spectator = ((1, 0, 0.4), (0, 0, 0.4))
    latch_failure = True
    recovery_sampled_per_episode = True

    def build(self, draws: Draws) -> None:
        values = self.values
        self.streaming = values.flag(
            "actions.streaming", lambda: draws.integer(0, 2) == 0, default=False
        )
        self.button = add_button(self, draws, (-0.2, 0))
        dx, y, degrees = values.place(
            "layout.board_offsets",
            lambda: [
                0.2 * draws.uniform() - 0.2,
                -0.2 + 0.4 * draws.uniform(),
                -20 + 40 * draws.uniform(),
            ],
            size=3,
        )
        self.board = self.add(build_board(self, (BOARD_X + dx, y), math.radians(degrees)))
        numbers = values("objects.target_numbers", lambda: self._draw_counts(draws))
        full = isinstance(numbers, list) and all(type(n) is int and n >= 0 for n in numbers)
        if not full or len(numbers) != len(COLOURS) or not any(numbers):
            raise values.error(
                "objects.target_numbers", f"is {numbers}; expected three numbers: red, blue, green"
            )
        self.goal = Counter(dict(zip(COLOURS, numbers, strict=True)))
        self.cubes: dict[str, list[Cube]] = {colour: [] for colour in COLOURS}
        for colour, (x, y, yaw) in (
            self._specified_cubes() if values.specified else self._draw_cubes(draws)
        ):
            cubes = self.cubes[colour]
            values.occupy("layout.slots", (x, y), H, yaw)
            cubes.append(
                self.add(build_cube(self, f"cube_{colour}_{len(cubes)}", colour, (x, y), yaw))
            )
        for colour in COLOURS:
            if len(self.cubes[colour]) < self.goal[colour]:
                problem = f"a {colour} cube for the bin"
                raise (
                    values.error("objects.slot_assignment", f"lacks {problem}")
                    if values.specified
                    else SceneError(f"BinFill, seed {self.seed}: {problem} finds no place.")
                )

    def _specified_cubes(self) -> Iterator[tuple[str, list[float]]]:
        """Colour and place of each cube of the row."""
        names: Any = self.values("objects.slot_assignment", list)
        count = self.values.count("layout.slots")
        if not isinstance(names, list) or len(names) != count:
            raise self.values.error(
                "objects.slot_assignment", f"must name a cube for each of the {count} slots"
            )
        for i, name in enumerate(names):
            colour = str(name).split("_")[0]
            if colour not in COLOURS:
                raise self.values.error(
                    f"objects.slot_assignment.{i}", f"is {name!r}; expected {', '.join(COLOURS)}"
                )
            yield colour, self.values.place(f"layout.slots.{i}", list, size=3)

    def _draw_cubes(self, draws: Draws) -> Iterator[tuple[str, list[float]]]:
        """Likewise from random numbers; a cube that finds no place is left out."""
        colours = [colour for colour in COLOURS for _ in range(self.spawned[colour])]
        count = 0
        for i in draws.permutation(len(colours)):
            colour = colours[i]
            place = draw_cube(draws, TABLE, [self.button, self.board, *self.all_cubes()], gap=H)
            if place is not None:
                self.values.note(f"layout.slots.{count}", [*place[0], place[1]])
                self.values.note(
                    f"objects.slot_assignment.{count}", f"{colour}_{len(self.cubes[colour])}"
                )
                count += 1
                yield colour, [*place[0], place[1]]

    def _draw_counts(self, draws: Draws) -> list[int]:
        """How many red, blue and green cubes belong into the bin; also samples how many lie on the
        table.
        """
        available = [COLOURS[i] for i in draws.permutation(3)][: AVAILABLE[self.difficulty]]
        low, high = GOAL_COLOURS[self.difficulty]
        selected = available[: draws.integer(low, high + 1)]
        low, high = GOAL_CUBES[self.difficulty]
        total = draws.integer(low, high + 1)
        picks = (
            [0] * total
            if len(selected) == 1
            else [draws.integer(0, len(selected)) for _ in range(total)]
        )
        goal = Counter(selected[i] for i in picks)
        low, high = CUBES[self.difficulty]
        cubes = draws.integer(low, high + 1)
        self.spawned = Counter({colour: max(1, goal[colour]) for colour in available})
        for _ in range(cubes - self.spawned.total()):
            self.spawned[
                available[draws.integer(0, len(available)) if len(available) > 1 else 0]
            ] += 1
        return [goal[colour] for colour in COLOURS]

    def start_episode(self, draws: Draws) -> None:
        order = self.values.indices(
            "initializations.color_order", lambda: draws.permutation(3), len(ORDERED)
        )
        self.order = [ORDERED[i] for i in order]
        self.filled: Counter[str] = Counter()
        self._streams = [
            Appear(cube, APPEAR_EVERY * i)
            for cubes in self.cubes.values()
            for i, cube in enumerate(cubes)
            if self.streaming and i
        ]

    def cues(self) -> list[Cue]:
        """A disc for each cube that is still to be put into the bin, of its colour."""
        places = iter(row(self.goal.total()))

        def of_colour(colour: str) -> list[Cue]:
            some = list(islice(places, self.goal[colour]))
            return tally(some, lambda: self.goal[colour] - self.filled[colour], colour)

        return [cue for colour in COLOURS for cue in of_colour(colour)]

    def before_physics(self, k: int) -> None:
        for stream in self._streams:
            stream.apply(k)

    def all_cubes(self) -> list[Cube]:
        """Every cube of the scene."""
        return [cube for cubes in self.cubes.values() for cube in cubes]

    def _falls_into_bin(self, cube: Cube) -> bool:
        near = distance_xy(cube.position, self.board.position) <= ON_TARGET
        return near and dropped(self, cube) and released_and_away(self, cube)

    def _put(self) -> bool:
        """Whether a cube has just been put into the bin; it leaves the scene and is counted."""
        for colour, cubes in self.cubes.items():
            for cube in cubes:
                if self._falls_into_bin(cube):
                    self.filled[colour] += 1
                    cube.move_to(IN_BIN)
                    return True
        return False

    def failure(self) -> bool:
        if self.progress.index < len(self.progress.subtasks) - 1:
            return pressed(self.button)
        surplus = any(self._falls_into_bin(cube) for cube in self.all_cubes())
        return surplus or any(self.filled[colour] != self.goal[colour] for colour in COLOURS)

    def subtasks(self) -> list[SubTask]:
        steps = [
            step
            for colour in self.order
            for i in range(self.goal[colour])
            for step in (self._pick(i, self.cubes[colour][i]), self._drop())
        ]
        return [*steps, press(self.button, "press the button", "c", operation="how many")]

    def _pick(self, i: int, cube: Cube) -> SubTask:
        return SubTask(
            f"pick up the {ordinal(i)} {cube.colour} cube",
            done=lambda: any_picked_up(self, self.all_cubes()),
            run=lambda demo: demo.pick(cube),
            grounded=f"pick up the {ordinal(i)} {cube.colour} cube at <>",
            targets=[cube],
            choice="a",
            pick=True,
            operation="how many",
        )

    def _drop(self) -> SubTask:
        return SubTask(
            "put it into the bin",
            done=self._put,
            run=lambda demo: demo.drop_into_bin(self.board),
            grounded="put it into the bin at <>",
            targets=[self.board],
            choice="b",
            operation="how many",
        )

    def evidence(self, ended: Mapping[int, SubTask]) -> Collection[str]:
        return choices_made(ended, "b", video=False)

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the cube", lambda demo, cube: demo.pick(cube), self.all_cubes),
            Choice("b", "put it into the bin", lambda demo, _: demo.drop_into_bin(self.board)),
            Choice("c", "press the button", lambda demo, _: demo.press(self.button)),
        ]

    def goals(self) -> list[str]:
        parts = [
            f"{number(n)} {colour} cube{'s' if n > 1 else ''}"
            for colour in COLOURS
            if (n := self.goal[colour]) > 0
        ]
        cubes = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
        return [
            f"put {cubes} into the bin{end} press the button to stop" for end in (", then", " and")
        ]
