"""PickHighlight (Reference): some cubes are briefly underlaid with white; press the button, then pick up just those."""

from mme_vla.envs.scene.articulated import build_button
from mme_vla.envs.scene.motions import Cue, Highlight, under
from mme_vla.envs.scene.objects import Cube, H, build_highlight
from mme_vla.envs.scene.placement import Draws, Region, draw_button
from mme_vla.envs.scene.predicates import any_picked_up, dropped, picked_up
from mme_vla.envs.subtasks import Choice, SubTask, ordinal
from mme_vla.envs.task import Task
from mme_vla.envs.tasks import register_task
from mme_vla.envs.tasks.families.stages import add_cube, pick, press

CUBES = {"easy": 3, "medium": 4, "hard": 6}
GOALS = {"easy": 1, "medium": 2, "hard": 3}
HIGHLIGHTED = (10, 100)  # steps; on the episode's clock, the button does not matter
RELEASE_Z = 0.01


@register_task
class PickHighlight(Task):
    """Success needs every highlighted cube to have been picked up once, in any order."""

    latch_failure = True
    dials = frozenset({"distractors"})

    def build(self, draws: Draws) -> None:
        self.button = self.add(build_button(self, draw_button(draws, (-0.2, 0))))
        self.cubes: list[Cube] = []
        for i in range(CUBES[self.difficulty]):
            colour = ("red", "blue", "green")[draws.integer(0, 3)]
            avoid = [self.button, *self.cubes]
            self.cubes.append(add_cube(self, draws, f"cube_{i}", colour, Region((-0.1, 0), 0.2), avoid, gap=2 * H))
        self.goal_cubes = [self.cubes[i] for i in draws.permutation(len(self.cubes))[: GOALS[self.difficulty]]]
        self._discs = [build_highlight(self, f"highlight_{i}", 0.05, 0.001) for i in range(len(self.goal_cubes))]

        for i in range(self.turned("distractors")):
            colour = ("red", "blue", "green")[draws.integer(0, 3)]
            avoid = [self.button, *self.cubes]
            self.cubes.append(
                add_cube(self, draws, f"distractor_{i}", colour, Region((-0.1, 0), 0.2), avoid, gap=2 * H)
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

    def failure(self) -> bool:
        self.picked.update(cube for cube in self.goal_cubes if picked_up(self, cube))
        others = [cube for cube in self.cubes if cube not in self.goal_cubes]
        return self.progress.index > 0 and any_picked_up(self, others)

    def success(self) -> bool:
        return len(self.picked) == len(self.goal_cubes)

    def subtasks(self) -> list[SubTask]:
        steps = [press(self.button, "press the button", "a")]
        for i, cube in enumerate(self.goal_cubes):
            if i:
                steps.append(self._place(self.goal_cubes[i - 1]))
            steps.append(self._pick(i, cube))
        return steps

    def _pick(self, i: int, cube: Cube) -> SubTask:
        which = "highlighted cube" if len(self.goal_cubes) == 1 else f"{ordinal(i)} highlighted cube"
        return pick(self, cube, f"pick up the {which}, which is {cube.colour}", "b", pick=True, operation="which")

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
            Choice("b", "pick up the highlighted cube", lambda demo, cube: demo.pick(cube), lambda: self.cubes),
            Choice("c", "place the cube onto the table", lambda demo, _: demo.put_down(RELEASE_Z)),
        ]

    def goals(self) -> list[str]:
        return [
            # The spelling is the benchmark's.
            "first press the button, then pick up all cubes that have been highlighteted with white areas on the table",
            "first press the button, then pick up all highlighted cubes, finally press the button again to stop",
        ]
