"""ButtonUnmaskSwap (Permanence): press two buttons while containers cover cubes and swap; pick up the right one."""

from mme_vla.envs.scene.articulated import Button, build_button
from mme_vla.envs.scene.placement import Draws, draw_button, shifted_anchors
from mme_vla.envs.scene.predicates import pressed
from mme_vla.envs.subtasks import Choice, SubTask
from mme_vla.envs.tasks import register_task
from mme_vla.envs.tasks.families.containers import (
    CONTAINERS,
    UnmaskSwap,
    container_choices,
    container_picks,
    hiding_goal,
)

LETTERS = ("c", "d")


@register_task
class ButtonUnmaskSwap(UnmaskSwap):
    """Covering and swapping take place while the robot presses two buttons, in whichever order."""

    def build(self, draws: Draws) -> None:
        self.left, self.right = (
            self.add(build_button(self, draw_button(draws, (-0.2, y), (0.05, 0.05)), name))
            for name, y in (("button_left", -0.1), ("button_right", 0.1))
        )
        self.build_containers(draws, shifted_anchors(draws, CONTAINERS[self.difficulty]), [self.left, self.right])

    def start_episode(self, draws: Draws) -> None:
        super().start_episode(draws)
        self.to_press = [self.left, self.right]

    def subtasks(self) -> list[SubTask]:
        presses = [self._press("first", self.right, "a"), self._press("second", self.left, "b")]
        return [*presses, *container_picks(self, self.targets, self.containers, LETTERS)]

    def _press(self, which: str, button: Button, choice: str) -> SubTask:
        """Press the button that is shown, or the other one if it has not been pressed yet."""
        return SubTask(
            f"press the {which} button",
            done=self._another_pressed,
            run=lambda demo: demo.press(button),
            grounded=f"press the {which} button at <>",
            targets=[button],
            choice=choice,
        )

    def _another_pressed(self) -> bool:
        down = next((button for button in self.to_press if pressed(button)), None)
        if down is not None:
            self.to_press.remove(down)
        return down is not None

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "press the first button", lambda demo, _: demo.press(self.left)),
            Choice("b", "press the second button", lambda demo, _: demo.press(self.right)),
            *container_choices(self.containers, LETTERS),
        ]

    def goals(self) -> list[str]:
        return [f"first press both buttons on the table, then {hiding_goal([colour for colour, _ in self.targets])}"]
