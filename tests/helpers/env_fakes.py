"""Light environments that stand for the simulator in worker processes."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.errors import SceneError

FRAME = (256, 256, 3)


class LightEnv:
    """Counts its steps; the action says what goes wrong."""

    def __init__(self, episode: int, video: int = 0) -> None:
        self.episode, self.video, self.steps = episode, video, 0

    def reset(self) -> tuple[dict[str, Any], dict[str, Any]]:
        frames = [np.full(FRAME, (self.episode + k) % 256, np.uint8) for k in range(self.video + 1)]
        return {"front_rgb_list": frames, "joint_state_list": [np.zeros(7)]}, {
            "status": "ongoing",
            "task_goal": ["wait"],
        }

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if action == "die":
            os._exit(3)
        if action == "hang":
            time.sleep(60)
        if action == "raise":
            raise RuntimeError("the arm fell off")
        if action == "refuse":
            raise SceneError("no object found a place")
        self.steps += 1
        while isinstance(action, Path) and not action.exists():
            time.sleep(0.01)
        frame = np.full(FRAME, self.steps, np.uint8)
        return (
            {"front_rgb_list": [frame]},
            0.0,
            action == "end",
            False,
            {"status": "ongoing", "steps": self.steps},
        )

    def close(self) -> None:
        """Nothing to free."""


def make_light_env(task: str, split: str, episode: int, video: int = 0, **options: Any) -> LightEnv:
    """As `make_env`; episode 13 cannot be made."""
    if episode == 13:
        raise ValueError("no scene for this seed")
    return LightEnv(episode, video)
