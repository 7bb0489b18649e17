"""A light environment with the benchmark's interface whose every frame tells where it belongs."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.envs.base import Hold

VIDEO = {"VideoUnmask": 21, "PatternLock": 5}
"""Frames of the conditioning video, by task."""
SIZE = 64


class ScriptedEnv:
    """Takes the joints where they are sent; shows time as brightness and the first joint as a
    square's place.

    It ends by success once the joints have travelled far enough, so the outcome depends on all
    actions.

    It holds its joints when told to, and names a sub-task anew after every action.

    Attributes:
        actions: all it was given. hold_steps: control steps for which it held. frames: all front
            images it showed.
    """

    def __init__(
        self, task: str, episode: int, max_steps: int, travel: float, step_s: float, dies: str
    ) -> None:
        self.task_name, self.episode, self.max_steps = task, episode, max_steps
        self.travel, self.step_s, self.dies = travel, step_s, dies
        self.actions: list[np.ndarray] = []
        self.hold_steps = 0
        self.frames: list[np.ndarray] = []
        self.states: list[np.ndarray] = []
        self.joints: np.ndarray = np.zeros(7)
        self.gripper, self.path = 0.04, 0.0

    def reset(self) -> tuple[dict[str, Any], dict[str, Any]]:
        count = VIDEO.get(self.task_name, 0) + 1
        return self._lists([self._frame() for _ in range(count)]), self._info("ongoing")

    def step(
        self, action: np.ndarray | Hold
    ) -> tuple[dict[str, Any] | None, float, bool, bool, dict[str, Any]]:
        time.sleep(self.step_s)
        if isinstance(action, Hold):
            self.hold_steps += action.steps
            return (
                self._lists([self._frame() for _ in range(action.steps)]),
                0.0,
                False,
                False,
                self._info("ongoing"),
            )
        self.actions.append(np.array(action))
        if self.dies and len(self.actions) == 20:
            self._die()
        self.path += float(np.abs(action[:7] - self.joints).sum())
        self.joints = np.asarray(action[:7], np.float64)
        self.gripper = 0.04 if len(action) > 7 and action[7] > 0 else 0.0
        success, late = self.path > self.travel, len(self.actions) >= self.max_steps + 1
        info = self._info("success" if success else "timeout" if late else "ongoing")
        return self._lists([self._frame()]), 0.0, success, late, info

    def close(self) -> None:
        """Nothing to free."""

    def _die(self) -> None:
        marker = Path(self.dies) / f"{self.task_name}-{self.episode}"
        if self.task_name == "PickXtimes" and self.episode == 1 and not marker.exists():
            marker.touch()
            os._exit(3)

    def _frame(self) -> dict[str, Any]:
        front = np.full((SIZE, SIZE, 3), (40 * self.episode + 7 * len(self.frames)) % 256, np.uint8)
        at = int(abs(self.joints[0]) * 20) % (SIZE - 12)
        front[at : at + 12, at : at + 12] = 255 - front[0, 0]
        self.frames.append(front)
        self.states.append(np.concatenate([self.joints, [self.gripper]]).astype(np.float32))
        fingers = np.full(2, self.gripper, np.float32)
        return {
            "front_rgb": front,
            "wrist_rgb": front[::-1],
            "joint_state": self.joints.astype(np.float32),
            "gripper_state": fingers,
        }

    def _lists(self, frames: list[dict[str, Any]]) -> dict[str, Any]:
        return {f"{key}_list": [frame[key] for frame in frames] for key in frames[0]}

    def _info(self, status: str) -> dict[str, Any]:
        count = len(self.actions)
        return {
            "status": status,
            "task_goal": ["pick up the red cube"],
            "simple_subgoal_online": f"push {count} times",
            "grounded_subgoal_online": f"push at <{count}, 9>",
            "elapsed_steps": object,
        }


def make_scripted_env(
    task: str,
    split: str,
    episode: int,
    max_steps: int = 40,
    travel: float = 1e9,
    step_s: float = 0.0,
    dies: str = "",
) -> ScriptedEnv:
    """As `make_env`. dies: a folder; the process of PickXtimes 1 dies at its 20th step, once a
    folder.
    """
    return ScriptedEnv(task, episode, max_steps, travel, step_s, dies)


def make_moving_env(**options: Any) -> ScriptedEnv:
    """Episodes that end by success somewhere on the way, or time out."""
    return make_scripted_env(**options, travel=11.09 * options["max_steps"])


def make_slow_env(**options: Any) -> ScriptedEnv:
    return make_moving_env(**options, step_s=float(os.environ.get("STEP_S", "0")))


def make_mortal_env(**options: Any) -> ScriptedEnv:
    return make_scripted_env(**options, dies=os.environ["GRAVES"])
