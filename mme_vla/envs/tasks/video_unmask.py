"""VideoUnmask (Permanence): cubes lie open in the video, containers then cover them; pick up the right container."""

from mme_vla.envs.scene.motions import COVER_STEPS, Cover, Cue, under
from mme_vla.envs.scene.placement import Draws
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
from mme_vla.envs.tasks.families.stages import wait

CONTAINERS = {"easy": 3, "medium": 5, "hard": 15}  # in hard episodes as many as fit
PICKS = {"easy": 1, "medium": 1, "hard": 2}


@register_task
class VideoUnmask(Task):
    """Containers cover three cubes during the conditioning video."""

    dials = frozenset({"containers", "delay"})

    def build(self, draws: Draws) -> None:
        self.containers = add_containers(self, draws, CONTAINERS[self.difficulty])
        self.colours = [("red", "green", "blue")[i] for i in draws.permutation(3)]
        add_hidden_cubes(self, self.colours, self.containers)
        add_containers(self, draws, self.turned("containers"), [], self.containers)

    def cues(self) -> list[Cue]:
        return [under(container, colour) for colour, container in zip(self.colours, self.containers, strict=False)]

    def start_episode(self, draws: Draws) -> None:
        self.cover = Cover(self.containers)

    def before_physics(self, k: int) -> None:
        self.cover.apply(k)

    def subtasks(self) -> list[SubTask]:
        targets = list(zip(self.colours, self.containers, strict=False))[: PICKS[self.difficulty]]
        picks = container_picks(self, targets, self.containers)
        return [wait(self, COVER_STEPS + self.turned("delay")), *picks]

    def choices(self) -> list[Choice]:
        return container_choices(self.containers)

    def goals(self) -> list[str]:
        return [f"watch the video carefully, then {hiding_goal(self.colours[: PICKS[self.difficulty]])}"]
