"""VideoUnmaskSwap (Permanence): in the video containers cover three cubes and change places; pick
up the right one.
"""

from mme_vla.envs.robomme.scene.placement import Draws, rotated_anchors
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.containers import (
    CONTAINERS,
    UnmaskSwap,
    container_choices,
    container_picks,
    hiding_goal,
)
from mme_vla.envs.robomme.tasks.families.stages import delay, wait
from mme_vla.envs.subtasks import Choice, SubTask


@register_task
class VideoUnmaskSwap(UnmaskSwap):
    """Covering and swapping take place in the conditioning video."""

    dials = frozenset({"swaps", "delay"})

    def build(self, draws: Draws) -> None:
        self.build_containers(draws, rotated_anchors(draws, CONTAINERS[self.difficulty]))

    def subtasks(self) -> list[SubTask]:
        watch = wait(self, self.swapped_after + delay(self))
        return [watch, *container_picks(self, self.targets, self.all_containers)]

    def choices(self) -> list[Choice]:
        return container_choices(self.containers)

    def goals(self) -> list[str]:
        return [
            f"watch the video carefully, then {hiding_goal([colour for colour, _ in self.targets])}"
        ]
