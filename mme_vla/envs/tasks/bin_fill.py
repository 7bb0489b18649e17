"""BinFill (Counting): put a number of cubes of each colour into the bin, some appear only later."""

import math
from collections import Counter
from itertools import islice

import sapien

from mme_vla.envs.scene.articulated import build_button
from mme_vla.envs.scene.motions import Appear, Cue, row, tally
from mme_vla.envs.scene.objects import Cube, H, build_board, build_cube
from mme_vla.envs.scene.placement import Draws, Region, SceneError, draw_button, draw_cube
from mme_vla.envs.scene.predicates import ON_TARGET, any_picked_up, dropped, pressed, released_and_away
from mme_vla.envs.scene.things import distance_xy
from mme_vla.envs.subtasks import Choice, SubTask, number, ordinal
from mme_vla.envs.task import Task
from mme_vla.envs.tasks import register_task
from mme_vla.envs.tasks.families.stages import press

# Both bounds belong to the range.
AVAILABLE = {"easy": 1, "medium": 2, "hard": 3}
GOAL_COLOURS = {"easy": (1, 1), "medium": (1, 2), "hard": (2, 3)}
GOAL_CUBES = {"easy": (1, 3), "medium": (2, 4), "hard": (3, 5)}
CUBES = {"easy": (4, 6), "medium": (8, 10), "hard": (10, 12)}
COLOURS = ("red", "blue", "green")
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
        self.streaming = draws.integer(0, 2) == 0
        self.button = self.add(build_button(self, draw_button(draws, (-0.2, 0))))
        x, y = -0.05 + 0.2 * draws.uniform(), -0.2 + 0.4 * draws.uniform()
        self.board = self.add(build_board(self, (x, y), math.radians(-20 + 40 * draws.uniform())))
        self._draw_counts(draws)
        colours = [colour for colour in COLOURS for _ in range(self.spawned[colour])]
        self.cubes: dict[str, list[Cube]] = {colour: [] for colour in COLOURS}
        for i in draws.permutation(len(colours)):
            colour = colours[i]
            place = draw_cube(draws, TABLE, [self.button, self.board, *self.all_cubes()], gap=H)
            if place is not None:
                cubes = self.cubes[colour]
                cubes.append(self.add(build_cube(self, f"cube_{colour}_{len(cubes)}", colour, *place)))
        for colour in COLOURS:
            if len(self.cubes[colour]) < self.goal[colour]:
                raise SceneError(f"BinFill, seed {self.seed}: a {colour} cube for the bin finds no place.")

    def _draw_counts(self, draws: Draws) -> None:
        """How many cubes of each colour belong into the bin, and how many lie on the table."""
        available = [COLOURS[i] for i in draws.permutation(3)][: AVAILABLE[self.difficulty]]
        low, high = GOAL_COLOURS[self.difficulty]
        selected = available[: draws.integer(low, high + 1)]
        low, high = GOAL_CUBES[self.difficulty]
        total = draws.integer(low, high + 1)
        picks = [0] * total if len(selected) == 1 else [draws.integer(0, len(selected)) for _ in range(total)]
        self.goal = Counter(selected[i] for i in picks)
        low, high = CUBES[self.difficulty]
        cubes = draws.integer(low, high + 1)
        self.spawned = Counter({colour: max(1, self.goal[colour]) for colour in available})
        for _ in range(cubes - self.spawned.total()):
            self.spawned[available[draws.integer(0, len(available)) if len(available) > 1 else 0]] += 1

    def start_episode(self, draws: Draws) -> None:
        self.order = [("blue", "red", "green")[i] for i in draws.permutation(3)]
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

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the cube", lambda demo, cube: demo.pick(cube), self.all_cubes),
            Choice("b", "put it into the bin", lambda demo, _: demo.drop_into_bin(self.board)),
            Choice("c", "press the button", lambda demo, _: demo.press(self.button)),
        ]

    def goals(self) -> list[str]:
        parts = [
            f"{number(n)} {colour} cube{'s' if n > 1 else ''}" for colour in COLOURS if (n := self.goal[colour]) > 0
        ]
        cubes = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
        return [f"put {cubes} into the bin{end} press the button to stop" for end in (", then", " and")]
