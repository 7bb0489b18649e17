"""PickXtimes (Counting): put the cube of one colour on the target a number of times, then press the
button.
"""

from typing import ClassVar

from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import Cue, row, tally
from mme_vla.envs.robomme.scene.objects import H
from mme_vla.envs.robomme.scene.placement import Draws, Region
from mme_vla.envs.robomme.scene.predicates import any_picked_up, pressed
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.repetitions import RepetitionTask
from mme_vla.envs.robomme.tasks.families.stages import (
    add_target,
    pick,
    place,
    press,
    press_choice,
)
from mme_vla.envs.subtasks import Choice, SubTask, number, ordinal

TARGET_RADIUS = 0.04


@register_task
class PickXtimes(RepetitionTask):
    """One cube is picked up and placed on the target again and again, as often as the goal says."""

    bounds: ClassVar = {"easy": (1, 3), "medium": (1, 3), "hard": (4, 5)}
    region = Region((-0.1, 0.0), 0.2)

    def add_targets(self, draws: Draws) -> None:
        avoid = [self.button, *self.cubes]
        self.target = add_target(
            self, draws, "target", "layout.goal_xy", self.region, TARGET_RADIUS, avoid, gap=2 * H
        )

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
