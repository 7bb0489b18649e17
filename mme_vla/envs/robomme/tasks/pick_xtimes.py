"""PickXtimes (Counting): put the cube of one colour on the target a number of times, then press the
button.
"""

from collections.abc import Collection, Mapping

from mme_vla.envs.robomme.scene.motions import Cue, row, tally
from mme_vla.envs.robomme.scene.objects import Cube, H
from mme_vla.envs.robomme.scene.placement import Draws, Region
from mme_vla.envs.robomme.scene.predicates import any_picked_up, dropped_onto, pressed
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

COLOURS = ("red", "blue", "green")
CUBES = {"easy": 1, "medium": 3, "hard": 3}
REPETITIONS = {"easy": (1, 3), "medium": (1, 3), "hard": (4, 5)}  # fewest and most
TABLE = Region((-0.1, 0.0), 0.2)
TARGET_RADIUS = 0.04


@register_task
class PickXtimes(Task):
    """One cube is picked up and placed on the target again and again, as often as the goal says."""

    latch_failure = True
    dials = frozenset({"count"})

    def plan(self, draws: Draws) -> None:
        fewest, most = REPETITIONS[self.difficulty]
        self.repetitions = self.values.integer(
            "objects.num_repeats",
            lambda: draws.integer(fewest, most + 1) + self.turned("count"),
            least=1,
        )

    def build(self, draws: Draws) -> None:
        self.button = add_button(self, draws, (-0.2, 0.0))
        colours = sample_colours(self, draws, COLOURS)[: CUBES[self.difficulty]]
        draws.integer(0, 3)  # part of the official stream, without effect
        self.cubes: list[Cube] = []
        for name in cube_names(self, "layout.cubes", colours):
            colour, avoid = name.split("_")[0], [self.button, *self.cubes]
            value = f"layout.cubes.{name}"
            self.cubes.append(
                add_cube(self, draws, f"cube_{colour}", colour, TABLE, avoid, value=value)
            )
        avoid = [self.button, *self.cubes]
        self.target = add_target(
            self, draws, "target", "layout.goal_xy", TABLE, TARGET_RADIUS, avoid, gap=2 * H
        )
        count = len(self.cubes)
        self.cube = self.cubes[
            self.values.integer(
                "objects.target_cube_idx", lambda: draws.integer(0, count), most=count - 1
            )
        ]
        check_colour(self, self.cube.colour)
        self.distractors = add_distractors(self, draws, TABLE)

    def cues(self) -> list[Cue]:
        def left() -> int:
            return sum(step.choice == "b" for step in self.progress.to_come)

        return tally(row(self.repetitions), left)

    def subtasks(self) -> list[SubTask]:
        steps = []
        for i in range(self.repetitions):
            steps += [self._pick(i), self._place()]
        stop = {
            "failed": lambda: any_picked_up(self, [*self.cubes, *self.distractors]),
            "operation": "how many",
        }
        return [*steps, press(self.button, "press the button to stop", "c", **stop)]

    def _pick(self, i: int) -> SubTask:
        text = f"pick up the {self.cube.colour} cube for the {ordinal(i)} time"
        return pick(
            self, self.cube, text, failed=self._strayed, pick=True, operation=self._mistaken
        )

    def _place(self) -> SubTask:
        return SubTask(
            f"place the {self.cube.colour} cube onto the target",
            done=lambda: dropped_onto(self, self.cube, self.target),
            run=lambda demo: demo.place_on(self.target),
            grounded=f"place the {self.cube.colour} cube onto the target at <>",
            failed=self._strayed,
            targets=[self.target],
            choice="b",
            operation=self._mistaken,
        )

    def _strayed(self) -> bool:
        others = [cube for cube in (*self.cubes, *self.distractors) if cube is not self.cube]
        return any_picked_up(self, others) or pressed(self.button)

    def _mistaken(self) -> str:
        """Stopping too early is a count forgotten; which cube, the goal says."""
        return "how many" if pressed(self.button) else ""

    def evidence(self, ended: Mapping[int, SubTask]) -> Collection[str]:
        return choices_made(ended, "b", video=False)

    def choices(self) -> list[Choice]:
        return [
            Choice(
                "a",
                "pick up the cube",
                lambda demo, cube: demo.pick(cube),
                lambda: [*self.cubes, *self.distractors],
            ),
            Choice(
                "b", "place the cube onto the target", lambda demo, _: demo.place_on(self.target)
            ),
            Choice("c", "press the button to stop", lambda demo, _: demo.press(self.button)),
        ]

    def goals(self) -> list[str]:
        start = f"pick up the {self.cube.colour} cube and place it on the target"
        if self.repetitions == 1:
            return [f"{start}, then press the button to stop"]
        return [
            f"{start}, repeating this {action} {number(self.repetitions)} times, then press the"
            " button to stop"
            for action in ("action", "pick-and-place action")
        ]
