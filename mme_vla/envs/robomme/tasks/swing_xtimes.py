"""SwingXtimes (Counting): swing a cube between two targets a number of times, put it down, press
the button.
"""

from collections.abc import Collection, Mapping

from mme_vla.envs.robomme.scene.motions import TALLY_SPACING, Cue, Mark, build_mark, tally
from mme_vla.envs.robomme.scene.objects import Cube, Disc, H
from mme_vla.envs.robomme.scene.placement import Avoid, Draws, Region
from mme_vla.envs.robomme.scene.predicates import any_picked_up, dropped, pressed
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import (
    add_button,
    add_cube,
    add_distractors,
    add_target,
    check_colour,
    choices_made,
    cube_names,
    pick,
    press,
    sample_colours,
)
from mme_vla.envs.subtasks import Choice, SubTask, number, ordinal
from mme_vla.envs.task import Task

SWINGS = {"easy": (1, 3), "medium": (1, 2), "hard": (3, 3)}
CUBES = {"easy": 1, "medium": 3, "hard": 3}
TABLE = Region((-0.1, 0), 0.25)
TARGET_RADIUS = 0.04
NEAR, LEFT = 0.03, 0.04  # a swing is entered within the first distance and left beyond the second
LOW, HIGH = 0.12, 0.3  # likewise for the cube's height
MARK_STEPS = 20


class Swings:
    """Counts how often the cube comes over one target, with hysteresis."""

    def __init__(self, cube: Cube, target: Disc) -> None:
        self._cube, self._target = cube, target
        self.inside = False
        self.count = 0

    @property
    def over(self) -> bool:
        """The cube is above the target and low."""
        cube = self._cube.position
        return distance_xy(cube, self._target.position) <= NEAR and cube[2] < LOW

    def update(self) -> None:
        """Count, once a step."""
        cube = self._cube.position
        if not self.inside and self.over:
            self.inside, self.count = True, self.count + 1
        elif self.inside and (distance_xy(cube, self._target.position) > LEFT or cube[2] >= HIGH):
            self.inside = False


@register_task
class SwingXtimes(Task):
    """The cube goes right, then left, `repetitions` times."""

    latch_failure = True
    dials = frozenset({"count"})

    def plan(self, draws: Draws) -> None:
        low, high = SWINGS[self.difficulty]
        self.repetitions = self.values.integer(
            "objects.num_repeats",
            lambda: draws.integer(low, high + 1) + self.turned("count"),
            least=1,
        )

    def build(self, draws: Draws) -> None:
        self.button = add_button(self, draws, (-0.2, 0))
        colours = sample_colours(self, draws, ("red", "blue", "green"))[: CUBES[self.difficulty]]
        draws.integer(0, 3)
        self.cubes: list[Cube] = []
        for name in cube_names(self, "layout.cubes", colours):
            colour, value = name.split("_")[0], f"layout.cubes.{name}"
            avoid: list[Avoid] = [self.button, *self.cubes]
            self.cubes.append(
                add_cube(self, draws, f"cube_{colour}", colour, TABLE, avoid, value=value)
            )
        targets: list[Disc] = []
        for i, y in enumerate((-0.2, 0.2)):
            place, avoid = Region((-0.1, y), 0.1), [self.button, *self.cubes, *targets]
            value = f"layout.targets.{i}"
            targets.append(
                add_target(
                    self,
                    draws,
                    f"target_{i}",
                    value,
                    place,
                    TARGET_RADIUS,
                    avoid,
                    gap=H,
                    colour="gray",
                )
            )
        # Right and left as the robot sees them.
        self.right, self.left = sorted(targets, key=lambda target: target.position[1])
        count = len(self.cubes)
        self.cube = self.cubes[
            self.values.integer(
                "objects.target_cube_idx", lambda: draws.integer(0, count), most=count - 1
            )
        ]
        check_colour(self, self.cube.colour)
        self.distractors = add_distractors(self, draws, TABLE)
        self._marks = [build_mark(self, f"mark_{i}", TARGET_RADIUS * 1.003, 0.014) for i in (0, 1)]

    def start_episode(self, draws: Draws) -> None:
        self.swings = [Swings(self.cube, target) for target in (self.right, self.left)]
        targets = (self.right, self.left)
        self.marks = [
            Mark(d, t.position, MARK_STEPS) for d, t in zip(self._marks, targets, strict=True)
        ]

    def cues(self) -> list[Cue]:
        """A tally for each target, on its side: which one is next is to be seen as well."""

        def visits(target: Disc, side: int) -> list[Cue]:
            places = [side * TALLY_SPACING * (i + 1) for i in range(self.repetitions)]
            return tally(
                places, lambda: sum(target in step.targets for step in self.progress.to_come)
            )

        return [*visits(self.right, -1), *visits(self.left, 1)]

    def after_step(self, k: int) -> None:
        for mark, swings in zip(self.marks, self.swings, strict=True):
            mark.update(k, swings.over)

    def failure(self) -> bool:
        for swings in self.swings:
            swings.update()
        early = self.progress.index < len(self.progress.subtasks) - 1 and pressed(self.button)
        return (
            early
            or self._wrong_cube()
            or sum(swings.count for swings in self.swings) > 2 * self.repetitions
        )

    def subtasks(self) -> list[SubTask]:
        cube, colour = self.cube, self.cube.colour
        first = pick(self, cube, f"pick up the {colour} cube", pick=True, operation=self._mistaken)
        put_down = SubTask(
            f"put the {colour} cube on the table",
            done=lambda: dropped(self, cube),
            run=lambda demo: demo.put_down(),
            targets=[cube],
            choice="c",
            operation=self._mistaken,
        )
        last = press(self.button, "press the button", "d", operation=self._mistaken)
        sides = [("right", self.right, self.swings[0]), ("left", self.left, self.swings[1])]
        moves = [self._move(i, *side) for i in range(self.repetitions) for side in sides]
        return [first, *moves, put_down, last]

    def _move(self, i: int, side: str, target: Disc, swings: Swings) -> SubTask:
        return SubTask(
            f"move to the top of the {side}-side target for the {ordinal(i)} time",
            done=lambda: swings.over,
            run=lambda demo: demo.move_over(target, 0.1),
            grounded=f"move to the top of the {side}-side target at <> for the {ordinal(i)} time",
            targets=[target],
            choice="b",
            operation=self._mistaken,
        )

    def _mistaken(self) -> str:
        """Swings too few or too many are a count forgotten; which cube, the goal says."""
        return "" if self._wrong_cube() else "how many"

    def _wrong_cube(self) -> bool:
        return any_picked_up(
            self, [cube for cube in (*self.cubes, *self.distractors) if cube is not self.cube]
        )

    def evidence(self, ended: Mapping[int, SubTask]) -> Collection[str]:
        return choices_made(ended, "b", video=False)

    def choices(self) -> list[Choice]:
        targets = [self.right, self.left]
        return [
            Choice(
                "a",
                "pick up the cube",
                lambda demo, cube: demo.pick(cube),
                lambda: [*self.cubes, *self.distractors],
            ),
            Choice(
                "b",
                "move to the top of the target",
                lambda demo, disc: demo.move_over(disc, 0.1),
                lambda: targets,
            ),
            Choice("c", "put the cube on the table", lambda demo, _: demo.put_down()),
            Choice("d", "press the button", lambda demo, _: demo.press(self.button)),
        ]

    def goals(self) -> list[str]:
        pick = f"pick up the {self.cube.colour} cube, move it to the"
        first, second = (
            f"{pick} top of the right-side target, then",
            f"{pick} right-side target and then",
        )
        if self.repetitions == 1:
            return [
                f"{first} put it down on the left-side target, finally press the button to stop",
                f"{second} put it down on the left-side target, then press the button to stop",
            ]
        times = f"{number(self.repetitions)} times"
        return [
            (
                f"{first} move it to the top of the left-side target, repeating this back-and-forth"
                f" motion {times}, finally press the button to stop"
            ),
            (
                f"{second} to the left-side target, repeating this right-to-left swing motion"
                f" {times}, then put down the cube and press the button to stop"
            ),
        ]
