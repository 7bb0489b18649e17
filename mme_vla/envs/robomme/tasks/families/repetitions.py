"""What the two tasks share in which one cube of several is moved a number of times."""

from abc import abstractmethod
from typing import ClassVar

from mme_vla.envs.robomme.scene.objects import Cube
from mme_vla.envs.robomme.scene.placement import Draws, Region
from mme_vla.envs.robomme.tasks.families.stages import (
    SAMPLED_COLOURS,
    add_button,
    add_cube,
    add_cubes,
    check_colour,
    names_with_colours,
    sample_colours,
)
from mme_vla.envs.task import Task

CUBES = {"easy": 1, "medium": 3, "hard": 3}


class RepetitionTask(Task):
    """The goal names the colour of the cube and the number; then a button is pressed."""

    latch_failure = True
    fact_choices = "b"
    bounds: ClassVar[dict[str, tuple[int, int]]]
    """The fewest and the most repetitions, by difficulty."""
    region: ClassVar[Region]
    """Where cubes and distractors are placed."""

    def plan(self, draws: Draws) -> None:
        fewest, most = self.bounds[self.difficulty]
        self.repetitions = self.values.integer(
            "objects.num_repeats",
            lambda: draws.integer(fewest, most + 1) + self.turned("count"),
            least=1,
        )

    @abstractmethod
    def add_targets(self, draws: Draws) -> None:
        """Put the targets on the table, on which button and cubes are."""

    def build(self, draws: Draws) -> None:
        values = self.values
        self.button = add_button(self, draws, (-0.2, 0.0))
        colours = sample_colours(self, draws, SAMPLED_COLOURS)[: CUBES[self.difficulty]]
        draws.integer(0, 3)  # part of the official stream, without effect
        self.cubes = add_cubes(self, draws, colours, self.region, [self.button])
        self.add_targets(draws)
        count = len(self.cubes)
        index = values.integer(
            "objects.target_cube_idx", lambda: draws.integer(0, count), most=count - 1
        )
        self.cube = self.cubes[index]
        check_colour(self, self.cube.colour)
        # Cubes of other colours that a row has: each is a wrong cube.
        self.distractors: list[Cube] = []
        for name, colour in names_with_colours(self, "layout.distractors"):
            place = f"layout.distractors.{name}"
            cube = add_cube(self, draws, f"distractor_{name}", colour, self.region, [], value=place)
            self.distractors.append(cube)
        self.all_cubes = [*self.cubes, *self.distractors]
        self.wrong_cubes = [cube for cube in self.all_cubes if cube is not self.cube]
