"""BinFill (Counting): put a number of cubes of each colour into the bin, some appear only later."""

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial

import sapien
from pydantic import NonNegativeInt

from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import Appear, Cue, row, tally
from mme_vla.envs.robomme.scene.objects import Cube, build_board
from mme_vla.envs.robomme.scene.placement import Draws, Region, SceneError
from mme_vla.envs.robomme.scene.predicates import (
    ON_TARGET,
    any_picked_up,
    dropped,
    pressed,
    released_and_away,
)
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import (
    SAMPLED_COLOURS,
    add_button,
    add_cube,
    press,
    press_choice,
)
from mme_vla.envs.subtasks import Choice, SubTask, number, ordinal
from mme_vla.envs.task import Task

# Both bounds belong to the range.
AVAILABLE = {"easy": 1, "medium": 2, "hard": 3}
GOAL_COLOURS = {"easy": (1, 1), "medium": (1, 2), "hard": (2, 3)}
GOAL_CUBES = {"easy": (1, 3), "medium": (2, 4), "hard": (3, 5)}
CUBES = {"easy": (4, 6), "medium": (8, 10), "hard": (10, 12)}
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
    fact_choices = "b"

    def build(self, draws: Draws) -> None:
        values = self.values
        self.streaming = values.flag(
            "actions.streaming", lambda: draws.integer(0, 2) == 0, default=False
        )
        self.button = add_button(self, draws, (-0.2, 0))

        def sample_board() -> list[float]:
            dx = 0.2 * draws.uniform() - 0.2
            y = -0.2 + 0.4 * draws.uniform()
            return [dx, y, -20 + 40 * draws.uniform()]

        dx, y, degrees = values.place("layout.board_offsets", sample_board, size=3)
        self.board = self.add(build_board(self, (BOARD_X + dx, y), math.radians(degrees)))
        numbers = values(
            "objects.target_numbers", lambda: self._draw_counts(draws), list[NonNegativeInt]
        )
        values.require(
            len(numbers) == len(SAMPLED_COLOURS) and any(numbers),
            "objects.target_numbers",
            f"is {numbers}; expected three numbers, not all 0: red, blue, green",
        )
        self.goal = Counter(dict(zip(SAMPLED_COLOURS, numbers, strict=True)))
        self.cubes: dict[str, list[Cube]] = {colour: [] for colour in SAMPLED_COLOURS}
        colours = self._read_colours() if values.specified else self._draw_colours(draws)
        self._add_cubes(draws, colours)
        for colour in SAMPLED_COLOURS:
            if len(self.cubes[colour]) < self.goal[colour]:
                problem = f"a {colour} cube for the bin"
                values.require(not values.specified, "objects.slot_assignment", f"lacks {problem}")
                raise SceneError(f"{self.where}: {problem} finds no place.")

    def _draw_counts(self, draws: Draws) -> list[int]:
        """How many red, blue and green cubes belong into the bin; also samples how many lie on the
        table.
        """
        available = [SAMPLED_COLOURS[i] for i in draws.permutation(3)][: AVAILABLE[self.difficulty]]
        low, high = GOAL_COLOURS[self.difficulty]
        selected = available[: draws.integer(low, high + 1)]
        low, high = GOAL_CUBES[self.difficulty]
        total = draws.integer(low, high + 1)
        goal: Counter[str] = Counter()
        if len(selected) == 1:
            goal[selected[0]] = total
        else:
            for _ in range(total):
                goal[selected[draws.integer(0, len(selected))]] += 1
        low, high = CUBES[self.difficulty]
        cubes = draws.integer(low, high + 1)
        self.spawned = Counter({colour: max(1, goal[colour]) for colour in available})
        for _ in range(cubes - self.spawned.total()):
            # With one colour nothing is sampled.
            index = draws.integer(0, len(available)) if len(available) > 1 else 0
            self.spawned[available[index]] += 1
        return [goal[colour] for colour in SAMPLED_COLOURS]

    def _add_cubes(self, draws: Draws, colours: Sequence[str]) -> None:
        """Add cubes of these colours; one that finds no place is left out."""
        count = 0
        for colour in colours:
            name = f"{colour}_{len(self.cubes[colour])}"
            avoid = [self.button, self.board, *self.all_cubes()]
            slot = f"layout.slots.{count}"
            try:
                cube = add_cube(self, draws, f"cube_{name}", colour, TABLE, avoid, value=slot)
            except SceneError:
                continue
            if not self.values.specified:
                self.values.note(f"objects.slot_assignment.{count}", name)
            self.cubes[colour].append(cube)
            count += 1

    def _draw_colours(self, draws: Draws) -> list[str]:
        """The colours of the cubes in random order."""
        colours: list[str] = []
        for colour in SAMPLED_COLOURS:
            colours += [colour] * self.spawned[colour]
        return [colours[i] for i in draws.permutation(len(colours))]

    def _read_colours(self) -> list[str]:
        """The colours of the row's cubes."""
        names: list[str] = self.values("objects.slot_assignment", list, list[str])
        count = self.values.count("layout.slots")
        self.values.require(
            len(names) == count,
            "objects.slot_assignment",
            f"must name a cube for each of the {count} slots",
        )
        colours = [name.split("_")[0] for name in names]
        for i, colour in enumerate(colours):
            self.values.require(
                colour in SAMPLED_COLOURS,
                f"objects.slot_assignment.{i}",
                f"is {names[i]!r}; expected {', '.join(SAMPLED_COLOURS)}",
            )
        return colours

    def start_episode(self, draws: Draws) -> None:
        order = self.values.indices(
            "initializations.color_order", lambda: draws.permutation(3), len(ORDERED)
        )
        self.order = [ORDERED[i] for i in order]
        self.filled: Counter[str] = Counter()
        if self.streaming:
            for cubes in self.cubes.values():
                for i, cube in enumerate(cubes[1:], 1):
                    self.motions.append(Appear(cube, APPEAR_EVERY * i))

    def cues(self) -> list[Cue]:
        """A disc for each cube that is still to be put into the bin, of its colour."""
        places = row(self.goal.total())
        cues: list[Cue] = []
        for colour in SAMPLED_COLOURS:
            count = self.goal[colour]
            cues += tally(places[:count], partial(self._missing, colour), colour)
            places = places[count:]
        return cues

    def _missing(self, colour: str) -> int:
        return self.goal[colour] - self.filled[colour]

    def all_cubes(self) -> list[Cube]:
        """Every cube of the scene."""
        return [cube for cubes in self.cubes.values() for cube in cubes]

    def failure(self) -> bool:
        if self.progress.index < len(self.progress.subtasks) - 1:
            return pressed(self.button)
        surplus = any(self._falls_into_bin(cube) for cube in self.all_cubes())
        return surplus or any(self._missing(colour) for colour in SAMPLED_COLOURS)

    def _falls_into_bin(self, cube: Cube) -> bool:
        near = distance_xy(cube.position, self.board.position) <= ON_TARGET
        return near and dropped(self, cube) and released_and_away(self, cube)

    def subtasks(self) -> list[SubTask]:
        steps: list[SubTask] = []
        for colour in self.order:
            for i, cube in enumerate(self.cubes[colour][: self.goal[colour]]):
                steps += [self._pick(f"the {ordinal(i)} {colour} cube", cube), self._drop()]
        return [*steps, press(self.button, "press the button", "c", operation="how many")]

    def _pick(self, which: str, cube: Cube) -> SubTask:
        return SubTask(
            f"pick up {which}",
            done=lambda: any_picked_up(self, self.all_cubes()),
            run=lambda demo: demo.pick(cube),
            grounded=f"pick up {which} at <>",
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

    def _put(self) -> bool:
        """Whether a cube has just been put into the bin; it leaves the scene and is counted."""
        for colour, cubes in self.cubes.items():
            for cube in cubes:
                if self._falls_into_bin(cube):
                    self.filled[colour] += 1
                    cube.move_to(IN_BIN)
                    return True
        return False

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the cube", Demonstrator.pick, self.all_cubes()),
            Choice("b", "put it into the bin", lambda demo, _: demo.drop_into_bin(self.board)),
            press_choice("c", "press the button", self.button),
        ]

    def goals(self) -> list[str]:
        parts: list[str] = []
        for colour in SAMPLED_COLOURS:
            count = self.goal[colour]
            if count == 1:
                parts.append(f"one {colour} cube")
            elif count > 1:
                parts.append(f"{number(count)} {colour} cubes")
        *others, cubes = parts
        if others:
            cubes = f"{', '.join(others)} and {cubes}"
        return [
            f"put {cubes} into the bin, then press the button to stop",
            f"put {cubes} into the bin and press the button to stop",
        ]
