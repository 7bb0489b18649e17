"""An environment of one decision: the lamp is red or green, and one of two options is
right for it.
"""

from typing import Any

import numpy as np

OPTIONS = [
    {"label": label, "action": f"say {word}", "need_parameter": False}
    for label, word in ("aA", "bB")
]


class TwoChoices:
    """Episode numbers decide the lamp's colour; the right letter is rewarded with 1."""

    def __init__(self, episode: int) -> None:
        self.right = "ab"[episode % 2]

    def reset(self) -> tuple[dict[str, list[Any]], dict[str, Any]]:
        return self._frame(), self._info("ongoing")

    def step(
        self, action: dict[str, Any]
    ) -> tuple[dict[str, list[Any]], float, bool, bool, dict[str, Any]]:
        success = action["choice"].lower() == self.right
        return (
            self._frame(),
            float(success),
            True,
            False,
            self._info("success" if success else "fail"),
        )

    def oracle(self) -> dict[str, Any]:
        return {"choice": self.right, "point": None}

    def close(self) -> None:
        """Nothing to free."""

    def _frame(self) -> dict[str, list[Any]]:
        image = np.zeros((256, 256, 3), np.uint8)
        image[90:108, 120:138, "ab".index(self.right)] = (
            220  # as large as a cube, which the vision tower locates
        )
        state = {
            "joint_state_list": [np.zeros(7, np.float32)],
            "gripper_state_list": [np.zeros(2, np.float32)],
        }
        return {"front_rgb_list": [image], **state}

    def _info(self, status: str) -> dict[str, Any]:
        return {
            "status": status,
            "task_goal": ["say the right letter"],
            "available_multi_choices": OPTIONS,
        }


def make_two_choices(task: str, split: str, episode: int, max_steps: int) -> TwoChoices:
    return TwoChoices(episode)
