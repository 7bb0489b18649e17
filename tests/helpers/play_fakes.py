"""A task without a simulator for play sessions: press the right blocks in the right order."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.extras.play import ChoiceSession

OPTIONS = [
    {"label": "a", "action": "press the block", "need_parameter": True},
    {"label": "b", "action": "wait", "need_parameter": False},
    {"label": "c", "action": "wave", "need_parameter": False},
]
BLOCKS = {"red": (60, 70), "blue": (180, 190)}
"""Centres in pixels, (row, column)."""
COLOURS = {"red": (220, 40, 40), "blue": (40, 60, 220)}
VIDEO, MOTION = 8, 5  # frames


class BlocksEnv:
    """The blocks must be pressed in the order the video tells; waiting moves nothing, and waving is
    an error.

    Args:
        order: the blocks to press. video: whether there is one.
    """

    def __init__(self, order: Sequence[str] = ("blue", "red"), video: bool = True) -> None:
        self.order, self.video, self.closed, self.received_actions = list(order), video, False, []
        self.pressed: list[str] = []

    def reset(self) -> tuple[dict[str, Any], dict[str, Any]]:
        return self._observation(VIDEO + 1 if self.video else 1), self._info("ongoing")

    def step(self, action: dict[str, Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        action = {**action, "choice": action["choice"].lower()}
        self.received_actions.append(action)
        if action["choice"] == "c":
            return (
                None,
                0.0,
                True,
                False,
                {"status": "error", "error_message": "no path", "exception_type": "E"},
            )
        if action["choice"] == "b":
            return self._observation(0), 0.0, False, False, self._info("ongoing")
        near = min(BLOCKS, key=lambda name: np.hypot(*np.subtract(BLOCKS[name], action["point"])))
        self.pressed.append(near)
        right = self.pressed == self.order[: len(self.pressed)]
        status = "fail" if not right else "success" if self.pressed == self.order else "ongoing"
        return self._observation(MOTION), 0.0, status != "ongoing", False, self._info(status)

    def oracle(self) -> None:
        """It has none."""

    def close(self) -> None:
        self.closed = True

    def _info(self, status: str) -> dict[str, Any]:
        goal = "press the blocks in the order of the video"
        return {"status": status, "task_goal": [goal], "available_multi_choices": OPTIONS}

    def _observation(self, count: int) -> dict[str, list[np.ndarray]]:
        frames = []
        for k in range(count):
            frame = np.full((256, 256, 3), 90 + 4 * k, np.uint8)
            for name, (row, column) in BLOCKS.items():
                frame[row - 20 : row + 20, column - 20 : column + 20] = COLOURS[name]
            frames.append(frame)
        return {
            "front_rgb_list": frames,
            "joint_state_list": [np.zeros(7)] * count,
            "gripper_state_list": [np.zeros(2)] * count,
        }


class SessionWithObjects(ChoiceSession):
    """Knows where the blocks are."""

    def objects(self) -> dict[str, list[tuple[float, float]]]:
        return {"a": [(float(row), float(column)) for row, column in BLOCKS.values()]}


def an_episode(number: int = 0) -> EpisodeSpec:
    return EpisodeSpec("VideoUnmask", "test", number, 560000 + 100 * number, "easy")


def a_session(number: int = 0, **options: Any) -> ChoiceSession:
    names = ("max_choices", "max_steps", "pictures", "clock")
    limits = {key: options.pop(key) for key in names if key in options}
    return ChoiceSession(BlocksEnv(**options), an_episode(number), **limits)
