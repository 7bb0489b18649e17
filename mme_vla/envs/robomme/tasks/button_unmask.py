"""ButtonUnmask (Permanence): press a button while containers cover three cubes; pick up the right
container.
"""

from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.containers import Unmask
from mme_vla.envs.robomme.tasks.families.stages import add_button, press, press_choice
from mme_vla.envs.subtasks import Choice, SubTask


@register_task
class ButtonUnmask(Unmask):
    """Containers cover three cubes while the robot presses a button."""

    letters = ("b", "c")

    def build(self, draws: Draws) -> None:
        self.button = add_button(self, draws, (-0.2, 0), (0.1, 0.1))
        self.build_containers(draws, [self.button])

    def draw_failed_pick(self, draws: Draws, picks: int) -> int:
        # Here alone the stream is one of its own, in which a number without effect comes first.
        local_draws = Draws(self.seed)
        local_draws.integer(1, 6)
        return local_draws.integer(0, picks)

    def subtasks(self) -> list[SubTask]:
        return [press(self.button, "press the button", "a"), *self.picks()]

    def choices(self) -> list[Choice]:
        return [press_choice("a", "press the button", self.button), *super().choices()]

    def goals(self) -> list[str]:
        return [f"first press the button, then {self.hiding_goal()}"]
