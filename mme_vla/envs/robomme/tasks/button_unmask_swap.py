"""ButtonUnmaskSwap (Permanence): press two buttons while containers cover cubes and swap; pick up
the right one.
"""

from mme_vla.envs.robomme.scene.articulated import Button
from mme_vla.envs.robomme.scene.placement import Draws, shifted_anchors
from mme_vla.envs.robomme.scene.predicates import pressed
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.containers import CONTAINERS, UnmaskSwap
from mme_vla.envs.robomme.tasks.families.stages import add_button, press_choice
from mme_vla.envs.subtasks import Choice, SubTask

WAIT_TEXT, WAIT_LETTER = "wait for the containers to finish swapping", "e"  # in rows of RoboMME-OOD


@register_task
class ButtonUnmaskSwap(UnmaskSwap):
    """Covering and swapping take place while the robot presses two buttons, in whichever order."""

    letters = ("c", "d")

    def build(self, draws: Draws) -> None:
        size = (0.05, 0.05)
        self.left = add_button(
            self, draws, (-0.2, -0.1), size, "button_left", "layout.buttons_xy.0"
        )
        self.right = add_button(
            self, draws, (-0.2, 0.1), size, "button_right", "layout.buttons_xy.1"
        )
        anchors = shifted_anchors(draws, CONTAINERS[self.difficulty])
        self.build_containers(draws, anchors, [self.left, self.right])

    def start_episode(self, draws: Draws) -> None:
        super().start_episode(draws)
        self.to_press = [self.left, self.right]

    def subtasks(self) -> list[SubTask]:
        steps = [self._press("first", self.right, "a"), self._press("second", self.left, "b")]
        if self.tier:
            watch = SubTask(
                WAIT_TEXT,
                done=lambda: self.steps_done >= self.swapped_after,
                run=lambda demo: demo.hold_until(self.swapped_after),
                choice=WAIT_LETTER,
            )
            steps.append(watch)
        return [*steps, *self.picks()]

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
        for button in self.to_press:
            if pressed(button):
                self.to_press.remove(button)
                return True
        return False

    def choices(self) -> list[Choice]:
        options = [
            press_choice("a", "press the first button", self.left),
            press_choice("b", "press the second button", self.right),
            *super().choices(),
        ]
        if self.tier:
            options.append(
                Choice(WAIT_LETTER, "wait", lambda demo, _: demo.hold_until(self.swapped_after))
            )
        return options

    def goals(self) -> list[str]:
        return [f"first press both buttons on the table, then {self.hiding_goal()}"]
