"""ButtonUnmask (Permanence): press a button while containers cover three cubes; pick up the right
container.
"""

from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.containers import (
    Unmask,
    container_choices,
    container_picks,
    hiding_goal,
)
from mme_vla.envs.robomme.tasks.families.stages import add_button, press
from mme_vla.envs.subtasks import Choice, SubTask

LETTERS = ("b", "c")


@register_task
class ButtonUnmask(Unmask):
    """Containers cover three cubes while the robot presses a button."""

    dials = frozenset({"containers"})

    def build(self, draws: Draws) -> None:
        self.button = add_button(self, draws, (-0.2, 0), (0.1, 0.1))
        self.build_containers(draws, [self.button])

    def draw_failed_pick(self, draws: Draws, picks: int) -> int:
        # Here alone the stream is one of its own, in which a number without effect comes first.
        local_draws = Draws(self.seed)
        local_draws.integer(1, 6)
        return local_draws.integer(0, picks)

    def subtasks(self) -> list[SubTask]:
        picks = container_picks(self, self.targets, self.all_containers, LETTERS)
        return [press(self.button, "press the button", "a"), *picks]

    def choices(self) -> list[Choice]:
        push = Choice("a", "press the button", lambda demo, _: demo.press(self.button))
        return [push, *container_choices(self.containers, LETTERS)]

    def goals(self) -> list[str]:
        return [
            f"first press the button, then {hiding_goal([colour for colour, _ in self.targets])}"
        ]
