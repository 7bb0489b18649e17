"""A task of one's own: press two buttons in the order that the goal says."""

from mme_vla import Task, register
from mme_vla.envs.robomme.scene.articulated import build_button
from mme_vla.envs.robomme.scene.placement import Draws, draw_button
from mme_vla.envs.robomme.scene.predicates import pressed
from mme_vla.envs.subtasks import Choice, SubTask

NAMES = ("left", "right")
PLACES = ((-0.1, 0.15), (-0.1, -0.15))  # about where they stand, metres from the table's middle


@register("task", "TwoButtons")
class TwoButtons(Task):
    """The seed decides which button comes first; the goal names it."""

    def build(self, draws: Draws) -> None:
        spots = [draw_button(draws, place, (0.1, 0.1)) for place in PLACES]
        self.buttons = [
            self.add(build_button(self, at, name)) for name, at in zip(NAMES, spots, strict=True)
        ]
        self.order = [int(i) for i in draws.permutation(2)]

    def subtasks(self) -> list[SubTask]:
        return [
            SubTask(
                f"press the {NAMES[i]} button",
                done=lambda i=i: pressed(self.buttons[i]),
                run=lambda demo, i=i: demo.press(self.buttons[i]),
                grounded=f"press the {NAMES[i]} button at <>",
                targets=[self.buttons[i]],
                choice="ab"[i],
            )
            for i in self.order
        ]

    def failure(self) -> bool:
        """The second button is pressed before the first."""
        return self.progress.index == 0 and pressed(self.buttons[self.order[1]])

    def choices(self) -> list[Choice]:
        return [
            Choice(
                "ab"[i],
                f"press the {NAMES[i]} button",
                lambda demo, _, i=i: demo.press(self.buttons[i]),
            )
            for i in range(2)
        ]

    def goals(self) -> list[str]:
        first, second = (NAMES[i] for i in self.order)
        return [
            f"press the {first} button, then the {second} one",
            f"the {first} button first, then the {second}",
        ]
