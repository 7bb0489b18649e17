"""PickXtimes (Counting): put the cube of one colour on the target a number of times, then press the
button.
"""

from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import Cue, row, tally
from mme_vla.envs.robomme.scene.objects import H
from mme_vla.envs.robomme.scene.placement import Draws, Region
from mme_vla.envs.robomme.scene.predicates import any_picked_up, pressed
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import (
    SAMPLED_COLOURS,
    add_button,
    add_cubes,
    add_distractors,
    add_target,
    choose_cube,
    pick,
    place,
    press,
    press_choice,
    sample_colours,
    sample_repetitions,
)
from mme_vla.envs.subtasks import Choice, SubTask, number, ordinal
from mme_vla.envs.task import Task

CUBES = {"easy": 1, "medium": 3, "hard": 3}
REPETITIONS = {"easy": (1, 3), "medium": (1, 3), "hard": (4, 5)}  # fewest and most
TABLE = Region((-0.1, 0.0), 0.2)
TARGET_RADIUS = 0.04


@register_task
class PickXtimes(Task):
    """One cube is picked up and placed on the target again and again, as often as the goal says."""

    latch_failure = True
    fact_choices = "b"

    def plan(self, draws: Draws) -> None:
        self.repetitions = sample_repetitions(self, draws, REPETITIONS[self.difficulty])

    def build(self, draws: Draws) -> None:
        self.button = add_button(self, draws, (-0.2, 0.0))
        colours = sample_colours(self, draws, SAMPLED_COLOURS)[: CUBES[self.difficulty]]
        draws.integer(0, 3)  # part of the official stream, without effect
        self.cubes = add_cubes(self, draws, colours, TABLE, [self.button])
        avoid = [self.button, *self.cubes]
        self.target = add_target(
            self, draws, "target", "layout.goal_xy", TABLE, TARGET_RADIUS, avoid, gap=2 * H
        )
        self.cube = choose_cube(self, draws, self.cubes)
        self.distractors = add_distractors(self, draws, TABLE)
        self.all_cubes = [*self.cubes, *self.distractors]
        self.wrong_cubes = [cube for cube in self.all_cubes if cube is not self.cube]

    def cues(self) -> list[Cue]:
        def left() -> int:
            return sum(step.choice == "b" for step in self.progress.to_come)

        return tally(row(self.repetitions), left)

    def subtasks(self) -> list[SubTask]:
        colour = self.cube.colour
        steps: list[SubTask] = []
        for i in range(self.repetitions):
            steps.append(
                pick(
                    self,
                    self.cube,
                    f"pick up the {colour} cube for the {ordinal(i)} time",
                    failed=self._strayed,
                    pick=True,
                    operation=self._mistaken,
                )
            )
            steps.append(
                place(
                    self,
                    self.cube,
                    self.target,
                    f"place the {colour} cube onto the target",
                    failed=self._strayed,
                    operation=self._mistaken,
                )
            )
        stop = press(
            self.button,
            "press the button to stop",
            "c",
            failed=lambda: any_picked_up(self, self.all_cubes),
            operation="how many",
        )
        return [*steps, stop]

    def _strayed(self) -> bool:
        return any_picked_up(self, self.wrong_cubes) or pressed(self.button)

    def _mistaken(self) -> str:
        """Stopping too early is a count forgotten; which cube, the goal says."""
        return "how many" if pressed(self.button) else ""

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the cube", Demonstrator.pick, self.all_cubes),
            Choice(
                "b", "place the cube onto the target", lambda demo, _: demo.place_on(self.target)
            ),
            press_choice("c", "press the button to stop", self.button),
        ]

    def goals(self) -> list[str]:
        start = f"pick up the {self.cube.colour} cube and place it on the target"
        if self.repetitions == 1:
            return [f"{start}, then press the button to stop"]
        times = f"{number(self.repetitions)} times, then press the button to stop"
        return [
            f"{start}, repeating this action {times}",
            f"{start}, repeating this pick-and-place action {times}",
        ]
