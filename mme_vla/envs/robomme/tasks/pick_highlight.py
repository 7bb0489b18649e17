"""PickHighlight (Reference): some cubes are briefly underlaid with white; press the button, then
pick up just those.
"""

from collections.abc import Collection, Mapping

from mme_vla.envs.robomme.scene.motions import Cue, Highlight, active_motions, under
from mme_vla.envs.robomme.scene.objects import COLOURS, RGB, Cube, H, build_highlight
from mme_vla.envs.robomme.scene.placement import Draws, Region
from mme_vla.envs.robomme.scene.predicates import any_picked_up, dropped, picked_up
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import add_button, add_cube, pick, press
from mme_vla.envs.subtasks import Choice, SubTask, ordinal
from mme_vla.envs.task import Task

CUBES = {"easy": 3, "medium": 4, "hard": 6}
GOALS = {"easy": 1, "medium": 2, "hard": 3}
HIGHLIGHTED = (10, 100)  # steps; on the episode's clock, the button does not matter
RELEASE_Z = 0.01
TABLE = Region((-0.1, 0), 0.2)


@register_task
class PickHighlight(Task):
    """Success needs every highlighted cube to have been picked up once, in any order."""

    latch_failure = True
    dials = frozenset({"distractors"})

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
        if not goals:
            raise self.values.error("objects.highlight_ids", "is empty; expected at least one cube")
        self.goal_cubes = [self.cubes[i] for i in goals]
        self._discs = [
            build_highlight(self, f"highlight_{i}", 0.05, 0.001)
            for i in range(len(self.goal_cubes))
        ]
        self._add_cubes(draws, "distractor", "layout.distractors", self.turned("distractors"))

    def _add_cubes(self, draws: Draws, name: str, part: str, count: int) -> None:
        for i in range(self.values.count(part) if self.values.specified else count):
            colour, value = self._colour(draws, len(self.cubes)), f"{part}.{i}"
            avoid = [self.button, *self.cubes]
            self.cubes.append(
                add_cube(self, draws, f"{name}_{i}", colour, TABLE, avoid, gap=2 * H, value=value)
            )

    def _colour(self, draws: Draws, i: int) -> str | RGB:
        """A name, or in rows of RoboMME-OOD any colour."""
        if self.values.find("objects.color_rgba") is not None:
            return self.values.colour(f"objects.color_rgba.{i}", list)
        return self.values.word(
            f"objects.colors.{i}", lambda: ("red", "blue", "green")[draws.integer(0, 3)], COLOURS
        )

    def cues(self) -> list[Cue]:
        return [under(cube) for cube in self.goal_cubes]

    def start_episode(self, draws: Draws) -> None:
        pairs = zip(self._discs, self.goal_cubes, strict=True)
        self.highlights = [Highlight(disc, cube, *HIGHLIGHTED) for disc, cube in pairs]
        self.picked: set[Cube] = set()

    def before_physics(self, k: int) -> None:
        for highlight in self.highlights:
            highlight.apply(k)

    def evidence(self, ended: Mapping[int, SubTask]) -> Collection[str]:
        return active_motions(self.highlights)

    def failure(self) -> bool:
        self.picked.update(cube for cube in self.goal_cubes if picked_up(self, cube))
        others = [cube for cube in self.cubes if cube not in self.goal_cubes]
        if self.tier and self.progress.index == 0:
            return any_picked_up(self, self.cubes)
        return self.progress.index > 0 and any_picked_up(self, others)

    def success(self) -> bool:
        all_picked = len(self.picked) == len(self.goal_cubes)
        return all_picked and (self.progress.succeeded or not self.tier)

    def subtasks(self) -> list[SubTask]:
        steps = [press(self.button, "press the button", "a")]
        for i, cube in enumerate(self.goal_cubes):
            steps += [self._pick(i, cube), self._place(cube)]
        return [*steps, press(self.button, "press the button", "a")] if self.tier else steps[:-1]

    def _pick(self, i: int, cube: Cube) -> SubTask:
        which = (
            "highlighted cube"
            if len(self.goal_cubes) == 1 and not self.tier
            else f"{ordinal(i)} highlighted cube"
        )
        text = (
            f"pick up the {which}" if self.tier else f"pick up the {which}, which is {cube.colour}"
        )
        return pick(self, cube, text, "b", pick=True, operation="which")

    def _place(self, cube: Cube) -> SubTask:
        return SubTask(
            "place the cube onto the table",
            done=lambda: dropped(self, cube),
            run=lambda demo: demo.put_down(RELEASE_Z),
            targets=[cube],
            choice="c",
            operation="which",
        )

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "press button", lambda demo, _: demo.press(self.button)),
            Choice(
                "b",
                "pick up the highlighted cube",
                lambda demo, cube: demo.pick(cube),
                lambda: self.cubes,
            ),
            Choice("c", "place the cube onto the table", lambda demo, _: demo.put_down(RELEASE_Z)),
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
