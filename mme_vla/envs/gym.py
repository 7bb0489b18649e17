"""The tasks as plain Gymnasium environments, for libraries of reinforcement learning.

>>> gymnasium.make("mme_vla.envs.gym:mme_vla/StopCube-v0", images=False)  # doctest: +SKIP

Importing this module registers the tasks, and Gymnasium imports what stands before the colon.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from mme_vla.embodiment.robomme import ARM_JOINTS, CAMERAS, SIDE, benchmark_state
from mme_vla.envs.interface import RoboMMEEnv
from mme_vla.envs.make import load_tasks, make_env
from mme_vla.envs.metadata import TASK_NAMES, episodes, step_limit
from mme_vla.errors import check_choice, check_known, listed, require
from mme_vla.registry import REWARDS, TASKS

_POSITION, _ANGLE = 2.0, 2 * np.pi  # bounds of a commanded pose: metres and radians
_LOWEST, _HIGHEST = (-2.9, -1.8, -2.9, -3.1, -2.9, -0.02, -2.9), (2.9, 1.8, 2.9, 0.0, 2.9, 3.8, 2.9)
"""Limits of the Panda's joints in radians, rounded outward."""
SPACES = ("joint_angle", "ee_pose", "waypoint")
_STATE = ARM_JOINTS + 1


class GymTask(gymnasium.Env[Any, np.ndarray]):
    """A task whose reset samples an episode of a split.

    Observations are a dict of `state` [8] (joints in radians, first finger in metres) and, with
    `images`, `front` and `wrist` [256, 256, 3] uint8: those of the newest frame. The info dict
    holds `goal`, `subgoal`, `status` and `success`, and on reset `video`: the front images [256,
    256, 3] of the conditioning video, a tuple, empty without one. (Gymnasium's vector environments
    stack arrays, and videos have different lengths: there `infos["video"]` is an object array of
    tuples.)

    Args:
        task: its name.
        split: whose episodes are sampled; `episode` fixes one of them.
        action_space: `joint_angle`, `ee_pose` or `waypoint`.
        reward: `sparse`, `subtask` or `none`.
        images: whether frames are rendered; without, a step is some 30 times faster.
        max_steps: control steps until an episode is truncated, several of which an action by poses
            may take; None: as many as the split allows. `make_env` and `evaluate` count as the
            benchmark does, one step more.
        render_mode: `rgb_array` with images, None without.

    Raises:
        UserError: a task, split, episode, action space, reward or `max_steps` that does not exist.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        split: str = "train",
        episode: int | None = None,
        action_space: str = "joint_angle",
        reward: str = "sparse",
        images: bool = True,
        max_steps: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        check_choice("action_space", action_space, SPACES)
        check_known("reward", reward, REWARDS)
        limit = max_steps
        if limit is None:
            limit = step_limit(split)
        require(
            type(limit) is int and limit >= 1,
            f"max_steps is {limit!r}; expected a positive integer.",
        )
        self.task = task
        self.split = split
        self.episode = episode
        self.images = images or render_mode is not None
        self.render_mode = render_mode
        self._limit = limit
        self._options: dict[str, Any] = {
            "action_space": action_space,
            "reward": reward,
            "max_steps": limit,
        }
        self._count = len(episodes(task, split))
        self._env: RoboMMEEnv | None = None
        self._number: int | None = None
        self._observation: dict[str, np.ndarray] = {}
        # Asked of the class: a vector environment forks after this, and a renderer does not survive
        # a fork.
        load_tasks(task)
        self._stick = TASKS[task].stick
        high = np.array([_POSITION] * 3 + [_ANGLE] * 3, np.float32)
        low = -high
        if action_space == "joint_angle":
            low = np.array(_LOWEST, np.float32)
            high = np.array(_HIGHEST, np.float32)
        if not self._stick:  # the gripper closes at -1 and opens at 1
            low = np.append(low, np.float32(-1))
            high = np.append(high, np.float32(1))
        self.action_space = gymnasium.spaces.Box(low, high)
        spaces: dict[str, gymnasium.Space[Any]] = {}
        if self.images:
            image = gymnasium.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)
            spaces |= dict.fromkeys(CAMERAS, image)
        spaces["state"] = gymnasium.spaces.Box(-100.0, 100.0, (_STATE,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; `seed` fixes which episodes follow, `options={"episode":
        3}` names one.
        """
        super().reset(seed=seed)
        remaining = dict(options or {})
        number = remaining.pop("episode", self.episode)
        require(
            not remaining,
            f"Unknown reset options {listed(sorted(remaining))}; there is episode alone.",
        )
        if number is None:
            number = int(self.np_random.integers(self._count))
        frames, info = self._open(number).reset()
        self._take(frames)
        images = frames.get("front_rgb_list", [])[:-1]
        video = tuple(np.asarray(image, np.uint8) for image in images)
        return deepcopy(self._observation), {**self._info(info), "episode": number, "video": video}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], SupportsFloat, bool, bool, dict[str, Any]]:
        """Perform one action; a pose that cannot be reached ends the episode with the status
        `error`.
        """
        assert self._env is not None, "step() before reset(): call reset() first."
        frames, reward, terminated, truncated, info = self._env.step(np.asarray(action, np.float64))
        if frames:
            self._take(frames)
        steps = self._env.steps_counted - 1  # one passes before the first action
        if steps >= self._limit and not terminated:
            truncated = True
            info = {**info, "status": "timeout"}
        return (
            deepcopy(self._observation),
            float(reward),
            bool(terminated),
            bool(truncated),
            self._info(info),
        )

    def render(self) -> np.ndarray | None:
        """The newest front image [256, 256, 3]."""
        return None if self._env is None else self._env.render()

    def close(self) -> None:
        """Free the simulator; closing twice is harmless."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _open(self, number: int) -> RoboMMEEnv:
        """The environment of an episode; the last one stays open."""
        if self._env is None or number != self._number:
            self.close()
            self._env = make_env(self.task, self.split, number, render=self.images, **self._options)
            self._number = number
        return self._env

    def _take(self, frames: Mapping[str, Sequence[Any]]) -> None:
        self._observation = {}
        if self.images:
            for name in CAMERAS:
                self._observation[name] = np.asarray(frames[f"{name}_rgb_list"][-1], np.uint8)
        self._observation["state"] = benchmark_state(
            frames["joint_state_list"][-1], frames["gripper_state_list"][-1]
        )

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        status = str(info.get("status", ""))
        goals = info.get("task_goal") or [""]
        report: dict[str, Any] = {
            "goal": goals[0],
            "subgoal": str(info.get("simple_subgoal_online", "")),
        }
        for key in ("error_message", "exception_type"):
            if info.get(key):
                report[key] = str(info[key])
        return report | {"status": status, "success": status == "success"}


for _task in TASK_NAMES:
    if f"mme_vla/{_task}-v0" not in gymnasium.registry:
        gymnasium.register(
            id=f"mme_vla/{_task}-v0", entry_point="mme_vla.envs.gym:GymTask", kwargs={"task": _task}
        )
