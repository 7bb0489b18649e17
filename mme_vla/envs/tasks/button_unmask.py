"""ButtonUnmask (Permanence): press a button while containers cover three cubes; pick up the right container."""

from mme_vla.envs.scene.articulated import build_button
from mme_vla.envs.scene.motions import Cover, Cue, under
from mme_vla.envs.scene.placement import Draws, draw_button
from mme_vla.envs.subtasks import Choice, SubTask
from mme_vla.envs.task import Task
from mme_vla.envs.tasks import register_task
from mme_vla.envs.tasks.families.containers import (
    add_containers,
    add_hidden_cubes,
    container_choices,
    container_picks,
    hiding_goal,
)
from mme_vla.envs.tasks.families.stages import press
from mme_vla.envs.tasks.video_unmask import CONTAINERS, PICKS

LETTERS = ("b", "c")


@register_task
class ButtonUnmask(Task):
    """Containers cover three cubes while the robot presses a button."""

    dials = frozenset({"containers"})

    def build(self, draws: Draws) -> None:
        self.button = self.add(build_button(self, draw_button(draws, (-0.2, 0), (0.1, 0.1))))
        self.containers = add_containers(self, draws, CONTAINERS[self.difficulty], [self.button])
        self.colours = [("red", "green", "blue")[i] for i in draws.permutation(3)]
        add_hidden_cubes(self, self.colours, self.containers)
        add_containers(self, draws, self.turned("containers"), [self.button], self.containers)

    def cues(self) -> list[Cue]:
        return [under(container, colour) for colour, container in zip(self.colours, self.containers, strict=False)]

    def start_episode(self, draws: Draws) -> None:
        self.cover = Cover(self.containers)

    def before_physics(self, k: int) -> None:
        self.cover.apply(k)

    def draw_failed_pick(self, draws: Draws, picks: int) -> int | None:
        # Here alone the stream is one of its own, in which a number without effect comes first.
        local_draws = Draws(self.seed)
        local_draws.integer(1, 6)
        return local_draws.integer(0, picks)

    def subtasks(self) -> list[SubTask]:
        targets = list(zip(self.colours, self.containers, strict=False))[: PICKS[self.difficulty]]
        picks = container_picks(self, targets, self.containers, LETTERS)
        return [press(self.button, "press the button", "a"), *picks]

    def choices(self) -> list[Choice]:
        push = Choice("a", "press the button", lambda demo, _: demo.press(self.button))
        return [push, *container_choices(self.containers, LETTERS)]

    def goals(self) -> list[str]:
        return [f"first press the button, then {hiding_goal(self.colours[: PICKS[self.difficulty]])}"]
