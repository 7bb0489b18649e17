"""VideoUnmaskSwap (Permanence): in the video containers cover three cubes and change places; pick
up the right one.
"""

from mme_vla.envs.robomme.scene.placement import Draws, rotated_anchors
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.containers import CONTAINERS, UnmaskSwap
from mme_vla.envs.robomme.tasks.families.stages import delay, wait
from mme_vla.envs.subtasks import SubTask


@register_task
class VideoUnmaskSwap(UnmaskSwap):
    """Covering and swapping take place in the conditioning video."""

    def build(self, draws: Draws) -> None:
        self.build_containers(draws, rotated_anchors(draws, CONTAINERS[self.difficulty]))

    def subtasks(self) -> list[SubTask]:
        return [wait(self, self.swapped_after + delay(self)), *self.picks()]

    def goals(self) -> list[str]:
        return [f"watch the video carefully, then {self.hiding_goal()}"]
