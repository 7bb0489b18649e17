"""VideoUnmask (Permanence): cubes lie open in the video, containers then cover them; pick up the
right container.
"""

from mme_vla.envs.robomme.scene.motions import COVER_STEPS
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.containers import Unmask
from mme_vla.envs.robomme.tasks.families.stages import delay, wait
from mme_vla.envs.subtasks import SubTask


@register_task
class VideoUnmask(Unmask):
    """Containers cover three cubes during the conditioning video."""

    def build(self, draws: Draws) -> None:
        self.build_containers(draws, [])

    def subtasks(self) -> list[SubTask]:
        return [wait(self, COVER_STEPS + delay(self)), *self.picks()]

    def goals(self) -> list[str]:
        return [f"watch the video carefully, then {self.hiding_goal()}"]
