"""Depth and poses of both cameras, and a scripted environment that sees with them and moves by
waypoints.
"""

from typing import Any

import numpy as np

from helpers.scripted_env import SIZE, ScriptedEnv

MOTION = 4
POSE = np.array([[0, -1, 0, 0.0], [-1, 0, 0, 0.0], [0, 0, -1, 1.0]], np.float32)


def readings(count: int, seed: int = 0, listed: bool = False) -> dict[str, Any]:
    """What belongs to so many frames, as arrays or, as an environment and a client send it, as
    lists.
    """
    rng = np.random.default_rng([seed, count])
    arrays: dict[str, Any] = {}
    for camera in ("front", "wrist"):
        arrays[f"{camera}_depth"] = rng.integers(400, 900, (count, SIZE, SIZE, 1)).astype(np.int16)
        arrays[f"{camera}_camera_extrinsic"] = np.tile(POSE, (count, 1, 1))
    return {f"{name}_list": list(values) for name, values in arrays.items()} if listed else arrays


class DepthEnv(ScriptedEnv):
    """Moves for `MOTION` frames a waypoint, sees with depth unless it is blind, and succeeds after
    three motions.
    """

    def __init__(self, task: str, episode: int, blind: bool = False) -> None:
        super().__init__(task, episode, 1000, 1e9, 0.0, "")
        self.blind = blind

    def step(self, action: np.ndarray) -> Any:
        self.actions.append(np.array(action))
        success = len(self.actions) == 3
        info = self._info("success" if success else "ongoing")
        return self._lists([self._frame() for _ in range(MOTION)]), 0.0, success, False, info

    def _lists(self, frames: list[dict[str, Any]]) -> dict[str, Any]:
        depth = {} if self.blind else readings(len(frames), len(self.frames), listed=True)
        return super()._lists(frames) | depth


def make_depth_env(task: str, split: str, episode: int, max_steps: int, **options: Any) -> DepthEnv:
    return DepthEnv(task, episode)
