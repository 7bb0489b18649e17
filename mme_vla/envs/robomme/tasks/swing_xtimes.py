"""SwingXtimes (Counting): swing a cube between two targets a number of times, put it down, press
the button.
"""

from typing import ClassVar

from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import TALLY_SPACING, Cue, Mark, build_mark, tally
from mme_vla.envs.robomme.scene.objects import Cube, Disc, H
from mme_vla.envs.robomme.scene.placement import Draws, Region
from mme_vla.envs.robomme.scene.predicates import any_picked_up, pressed
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.repetitions import RepetitionTask
from mme_vla.envs.robomme.tasks.families.stages import (
    add_target,
    pick,
    press,
    press_choice,
    put_down,
    put_down_choice,
)
from mme_vla.envs.subtasks import Choice, SubTask, number, ordinal

TARGET_RADIUS = 0.04
NEAR, LEFT = 0.03, 0.04  # a swing is entered within the first distance and left beyond the second
LOW, HIGH = 0.12, 0.3  # likewise for the cube's height
MARK_STEPS = 20
SWING_Z = 0.1  # of the tool over a target, metres


class Swings:
    """Counts how often the cube comes over one target, with hysteresis."""

    def __init__(self, cube: Cube, target: Disc) -> None:
        self._cube = cube
        self._target = target
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
            self.inside = True
            self.count += 1
        elif self.inside and (distance_xy(cube, self._target.position) > LEFT or cube[2] >= HIGH):
            self.inside = False


@register_task
class SwingXtimes(RepetitionTask):
    """The cube goes right, then left, `repetitions` times."""

    bounds: ClassVar = {"easy": (1, 3), "medium": (1, 2), "hard": (3, 3)}
    region = Region((-0.1, 0), 0.25)

    def add_targets(self, draws: Draws) -> None:
        targets: list[Disc] = []
        for i, y in enumerate((-0.2, 0.2)):
            target = add_target(
                self,
                draws,
                f"target_{i}",
                f"layout.targets.{i}",
                Region((-0.1, y), 0.1),
                TARGET_RADIUS,
                [self.button, *self.cubes, *targets],
                gap=H,
                colour="gray",
            )
            targets.append(target)
        # Right and left as the robot sees them.
        self.right, self.left = sorted(targets, key=lambda target: target.position[1])

    def build(self, draws: Draws) -> None:
        super().build(draws)
        self._marks = [build_mark(self, f"mark_{i}", TARGET_RADIUS * 1.003, 0.014) for i in (0, 1)]

    def start_episode(self, draws: Draws) -> None:
        self.swings = [Swings(self.cube, self.right), Swings(self.cube, self.left)]
        right_mark, left_mark = self._marks
        self.marks = [
            Mark(right_mark, self.right.position, MARK_STEPS),
            Mark(left_mark, self.left.position, MARK_STEPS),
        ]

    def cues(self) -> list[Cue]:
        """A tally for each target, on its side: which one is next is to be seen as well."""

        def visits(target: Disc, side: int) -> list[Cue]:
            places = [side * TALLY_SPACING * (i + 1) for i in range(self.repetitions)]

            def left() -> int:
                return sum(target in step.targets for step in self.progress.to_come)

            return tally(places, left)

        return [*visits(self.right, -1), *visits(self.left, 1)]

    def after_step(self, k: int) -> None:
        for mark, swings in zip(self.marks, self.swings, strict=True):
            mark.update(k, swings.over)

    def failure(self) -> bool:
        count = 0
        for swings in self.swings:
            swings.update()
            count += swings.count
        is_last = self.progress.index >= len(self.progress.subtasks) - 1
        if pressed(self.button) and not is_last:
            return True
        return any_picked_up(self, self.wrong_cubes) or count > 2 * self.repetitions

    def subtasks(self) -> list[SubTask]:
        colour, mistaken = self.cube.colour, self._mistaken
        moves: list[SubTask] = []
        for i in range(self.repetitions):
            moves.append(self._move(i, "right", self.right, self.swings[0]))
            moves.append(self._move(i, "left", self.left, self.swings[1]))
        return [
            pick(self, self.cube, f"pick up the {colour} cube", pick=True, operation=mistaken),
            *moves,
            put_down(
                self, self.cube, f"put the {colour} cube on the table", "c", operation=mistaken
            ),
            press(self.button, "press the button", "d", operation=mistaken),
        ]

    def _move(self, i: int, side: str, target: Disc, swings: Swings) -> SubTask:
        return SubTask(
            f"move to the top of the {side}-side target for the {ordinal(i)} time",
            done=lambda: swings.over,
            run=lambda demo: demo.move_over(target, SWING_Z),
            grounded=f"move to the top of the {side}-side target at <> for the {ordinal(i)} time",
            targets=[target],
            choice="b",
            operation=self._mistaken,
        )

    def _mistaken(self) -> str:
        """Swings too few or too many are a count forgotten; which cube, the goal says."""
        return "" if any_picked_up(self, self.wrong_cubes) else "how many"

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the cube", Demonstrator.pick, self.all_cubes),
            Choice(
                "b",
                "move to the top of the target",
                lambda demo, disc: demo.move_over(disc, SWING_Z),
                [self.right, self.left],
            ),
            put_down_choice("c", "put the cube on the table"),
            press_choice("d", "press the button", self.button),
        ]

    def goals(self) -> list[str]:
        start = f"pick up the {self.cube.colour} cube, move it to the"
        first = f"{start} top of the right-side target, then"
        second = f"{start} right-side target and then"
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
