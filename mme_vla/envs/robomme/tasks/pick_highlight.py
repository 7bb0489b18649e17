"""PickHighlight (Reference): some cubes are briefly underlaid with white; press the button, then
pick up just those.
"""

from collections.abc import Mapping
from typing import Any

from mme_vla.envs.facts import Candidates, VisibleFact
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import Cue, Highlight, active_motions, under
from mme_vla.envs.robomme.scene.objects import COLOURS, RGB, Cube, H, build_highlight
from mme_vla.envs.robomme.scene.placement import Draws, Region
from mme_vla.envs.robomme.scene.predicates import any_picked_up, picked_up
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import (
    SAMPLED_COLOURS,
    add_button,
    add_cube,
    pick,
    press,
    press_choice,
    put_down,
    put_down_choice,
)
from mme_vla.envs.subtasks import Choice, SubTask, ordinal
from mme_vla.envs.task import Task, candidates_among

CUBES = {"easy": 3, "medium": 4, "hard": 6}
GOALS = {"easy": 1, "medium": 2, "hard": 3}
HIGHLIGHTED = (10, 100)  # steps; on the episode's clock, the button does not matter
RELEASE_Z = 0.01
TABLE = Region((-0.1, 0), 0.2)


@register_task
class PickHighlight(Task):
    """Success needs every highlighted cube to have been picked up once, in any order."""

    latch_failure = True

    def build(self, draws: Draws) -> None:
        self.button = add_button(self, draws, (-0.2, 0))
        self.cubes: list[Cube] = []
        self._add_cubes(draws, "cube", "layout.cubes", CUBES[self.difficulty])
        count = len(self.cubes)
        goals = self.values.indices(
            "objects.highlight_ids",
            lambda: draws.permutation(count)[: GOALS[self.difficulty]],
            count,
        )
        self.values.require(goals, "objects.highlight_ids", "is empty; expected at least one cube")
        self.goal_cubes = [self.cubes[i] for i in goals]
        self._discs = [
            build_highlight(self, f"highlight_{i}", 0.05, 0.001) for i in range(len(goals))
        ]
        self._add_cubes(draws, "distractor", "layout.distractors", self.turned("distractors"))
        self.other_cubes = [cube for cube in self.cubes if cube not in self.goal_cubes]

    def _add_cubes(self, draws: Draws, name: str, part: str, count: int) -> None:
        for i in range(self.values.count(part, count)):
            colour = self._colour(draws, len(self.cubes))
            cube = add_cube(
                self,
                draws,
                f"{name}_{i}",
                colour,
                TABLE,
                [self.button, *self.cubes],
                gap=2 * H,
                value=f"{part}.{i}",
            )
            self.cubes.append(cube)

    def _colour(self, draws: Draws, i: int) -> str | RGB:
        """A name, or in rows of RoboMME-OOD any colour."""
        if self.values.find("objects.color_rgba") is not None:
            return self.values.colour(f"objects.color_rgba.{i}", list)
        return self.values.word(
            f"objects.colors.{i}", lambda: SAMPLED_COLOURS[draws.integer(0, 3)], COLOURS
        )

    def flip_fact(self) -> dict[str, Any] | None:
        """As many of the other cubes are highlighted instead; None where there are fewer."""
        count = len(self.goal_cubes)
        others = [i for i, cube in enumerate(self.cubes) if cube in self.other_cubes]
        if len(others) < count:
            return None
        return self.values.changed({"objects.highlight_ids": others[:count]})

    def candidates(self) -> Candidates | None:
        """Any highlighted cube that has not been picked up is correct."""
        options = super().candidates()
        if options is None:
            return None
        remaining = [cube for cube in self.goal_cubes if cube not in self.picked]
        return candidates_among(self.cubes, remaining)

    def cues(self) -> list[Cue]:
        return [under(cube) for cube in self.goal_cubes]

    def start_episode(self, draws: Draws) -> None:
        pairs = zip(self._discs, self.goal_cubes, strict=True)
        self.highlights = [Highlight(disc, cube, *HIGHLIGHTED) for disc, cube in pairs]
        self.motions = [*self.highlights]
        self.picked: set[Cube] = set()

    def visible_facts(self, ended: Mapping[int, SubTask]) -> dict[str, VisibleFact]:
        return active_motions(self.highlights)

    def failure(self) -> bool:
        self.picked.update(cube for cube in self.goal_cubes if picked_up(self, cube))
        if self.progress.index > 0:
            return any_picked_up(self, self.other_cubes)
        # Before the button is pressed, rows of RoboMME-OOD allow no cube, the benchmark any.
        return bool(self.tier) and any_picked_up(self, self.cubes)

    def success(self) -> bool:
        all_picked = len(self.picked) == len(self.goal_cubes)
        if self.tier:
            return all_picked and self.progress.succeeded
        return all_picked

    def subtasks(self) -> list[SubTask]:
        steps = [press(self.button, "press the button", "a")]
        for i, cube in enumerate(self.goal_cubes):
            steps.append(pick(self, cube, self._pick_text(i), "b", pick=True, operation="which"))
            steps.append(
                put_down(
                    self,
                    cube,
                    "place the cube onto the table",
                    "c",
                    RELEASE_Z,
                    operation="which",
                )
            )
        if self.tier:
            return [*steps, press(self.button, "press the button", "a")]
        return steps[:-1]  # the last cube stays in the gripper

    def _pick_text(self, i: int) -> str:
        if self.tier:
            return f"pick up the {ordinal(i)} highlighted cube"
        which = "highlighted cube"
        if len(self.goal_cubes) > 1:
            which = f"{ordinal(i)} highlighted cube"
        return f"pick up the {which}, which is {self.goal_cubes[i].colour}"

    def choices(self) -> list[Choice]:
        return [
            press_choice("a", "press button", self.button),
            Choice("b", "pick up the highlighted cube", Demonstrator.pick, self.cubes),
            put_down_choice("c", "place the cube onto the table", RELEASE_Z),
        ]

    def goals(self) -> list[str]:
        if self.tier:
            cubes = "every cube highlighted with a white area on the table one at a time"
            return [
                (
                    "first press the button, then pick up all highlighted cubes one by one, finally"
                    " press the button to stop"
                ),
                (
                    f"first press the button, then pick up {cubes}, finally press the button again"
                    " to stop"
                ),
            ]
        return [
            # The spelling is the benchmark's.
            (
                "first press the button, then pick up all cubes that have been highlighteted with"
                " white areas on the table"
            ),
            (
                "first press the button, then pick up all highlighted cubes, finally press the"
                " button again to stop"
            ),
        ]
