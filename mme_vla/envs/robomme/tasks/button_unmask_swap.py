"""ButtonUnmaskSwap (Permanence): press two buttons while containers cover cubes and swap; pick up
the right one.
"""

from mme_vla.envs.robomme.scene.articulated import Button
from mme_vla.envs.robomme.scene.placement import Draws, shifted_anchors
from mme_vla.envs.robomme.scene.predicates import pressed
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.containers import (
    CONTAINERS,
    UnmaskSwap,
    container_choices,
    container_picks,
    hiding_goal,
)
from mme_vla.envs.robomme.tasks.families.stages import add_button
from mme_vla.envs.subtasks import Choice, SubTask

LETTERS = ("c", "d")
WAIT_TEXT, WAIT_LETTER = "wait for the containers to finish swapping", "e"  # in rows of RoboMME-OOD


@register_task
class ButtonUnmaskSwap(UnmaskSwap):
    """Covering and swapping take place while the robot presses two buttons, in whichever order."""

    def build(self, draws: Draws) -> None:
        self.left, self.right = (
            add_button(self, draws, (-0.2, y), (0.05, 0.05), name, f"layout.buttons_xy.{i}")
            for i, (name, y) in enumerate((("button_left", -0.1), ("button_right", 0.1)))
        )
        self.build_containers(
            draws, shifted_anchors(draws, CONTAINERS[self.difficulty]), [self.left, self.right]
        )

    def start_episode(self, draws: Draws) -> None:
        super().start_episode(draws)
        self.to_press = [self.left, self.right]

    def subtasks(self) -> list[SubTask]:
        presses = [self._press("first", self.right, "a"), self._press("second", self.left, "b")]
        watch = [self._watch()] if self.tier else []
        return [
            *presses,
            *watch,
            *container_picks(self, self.targets, self.all_containers, LETTERS),
        ]

    def _watch(self) -> SubTask:
        return SubTask(
            WAIT_TEXT,
            done=lambda: self.steps_done >= self.swapped_after,
            run=lambda demo: demo.hold_until(self.swapped_after),
            choice=WAIT_LETTER,
        )

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
            *(
                [Choice(WAIT_LETTER, "wait", lambda demo, _: demo.hold_until(self.swapped_after))]
                if self.tier
                else []
            ),
        ]

    def goals(self) -> list[str]:
        return [
            "first press both buttons on the table, then"
            f" {hiding_goal([colour for colour, _ in self.targets])}"
        ]
