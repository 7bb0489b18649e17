"""RoboMME for `lerobot-eval`, conditioning video included.

LeRobot's loop gives an action for every observation, and its observations have one shape. So the
video is played frame by frame: each step shows the next one, flags it with `is_demo`, and does
nothing with the action.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end

from mme_vla.embodiment.robomme import ROBOMME_JOINT, SIDE, benchmark_state
from mme_vla.envs import make_env
from mme_vla.errors import UserError

VIEWS = {"image": "front_rgb_list", "wrist_image": "wrist_rgb_list"}
STATE, ACTION = ROBOMME_JOINT.state.width, ROBOMME_JOINT.action.width
LONGEST_VIDEO = 2000  # frames; LeRobot reads the step limit before it has the videos of its batch


class RoboMMEWithVideo(gym.Env):
    """One episode of the benchmark in joint space.

    Args:
        task, split, episode: which. max_steps: control steps of the execution until it is over.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, task: str, split: str, episode: int, max_steps: int) -> None:
        self.task = self.task_description = task
        self._make: Callable[[], Any] = partial(
            make_env, task, split=split, episode=episode, max_steps=max_steps
        )
        self._env: Any = None
        self._max_episode_steps = max_steps + LONGEST_VIDEO
        self._waiting: list[dict[str, Any]] = []
        self._frame: dict[str, Any] = {}
        image = spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)
        self.observation_space = spaces.Dict({
            "pixels": spaces.Dict(dict.fromkeys(VIEWS, image)),
            "agent_pos": spaces.Box(-np.inf, np.inf, (STATE,), np.float32),
            "is_demo": spaces.Box(0, 1, (1,), np.float32),
        })  # fmt: skip
        self.action_space = spaces.Box(-np.inf, np.inf, (ACTION,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the episode; the scene is the episode's own, whatever `seed` is."""
        super().reset(seed=seed)
        if self._env is None:
            self._env = self._make()
        lists, info = self._env.reset()
        self.task_description = info["task_goal"][0]
        frames = _frames(lists)
        if len(frames) > LONGEST_VIDEO:
            raise UserError(
                f"{self.task}: a video of {len(frames) - 1} frames; this environment plays"
                f" {LONGEST_VIDEO}."
            )
        for frame in frames[:-1]:
            frame["is_demo"][:] = 1
        self._frame, *self._waiting = frames
        return self._frame, {"task_goal": self.task_description}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Show the next frame of the video, or carry out an action."""
        if self._waiting:
            self._frame = self._waiting.pop(0)
            return self._frame, 0.0, False, False, {"is_success": False, "status": "ongoing"}
        lists, _, terminated, truncated, info = self._env.step(np.asarray(action, np.float32))
        if lists:
            self._frame = _frames(lists)[-1]
        status = info["status"]
        over = bool(terminated) or status == "error"
        reasons = {
            key: str(info[key]) for key in ("error_message", "exception_type") if info.get(key)
        }
        facts = {"is_success": status == "success", "status": status, **reasons}
        return self._frame, 0.0, over, bool(truncated), facts

    def render(self) -> np.ndarray:
        """The front image that is shown."""
        image: np.ndarray = self._frame["pixels"]["image"]
        return image

    def close(self) -> None:
        """Free the simulator."""
        if self._env is not None:
            self._env.close()
            self._env = None


def _frames(lists: dict[str, list[Any]]) -> list[dict[str, Any]]:
    states = map(benchmark_state, lists["joint_state_list"], lists["gripper_state_list"])
    return [
        {
            "pixels": {name: lists[key][i] for name, key in VIEWS.items()},
            "agent_pos": state,
            "is_demo": np.zeros(1, np.float32),
        }
        for i, state in enumerate(states)
    ]


def _features() -> dict[str, PolicyFeature]:
    image_features = {
        f"pixels/{name}": PolicyFeature(FeatureType.VISUAL, (SIDE, SIDE, 3)) for name in VIEWS
    }
    return {
        "action": PolicyFeature(FeatureType.ACTION, (ACTION,)),
        **image_features,
        "agent_pos": PolicyFeature(FeatureType.STATE, (STATE,)),
    }


def _names() -> dict[str, str]:
    return {
        "action": "action",
        **{f"pixels/{name}": f"observation.images.{name}" for name in VIEWS},
        "agent_pos": "observation.state",
    }


@EnvConfig.register_subclass("mme_vla")
@dataclass
class MMEVLAEnvConfig(EnvConfig):
    """`--env.type=mme_vla --env.task=VideoUnmask,PickXtimes --env.episodes='[0,1]'`.

    A batch of n environments runs the episodes e, e + 1, … e + n − 1 for every e of `episodes`.
    """

    task: str = "PickXtimes"
    fps: int = 20
    split: str = "test"
    episodes: list[int] = field(default_factory=lambda: [0])
    max_steps: int = 1300
    features: dict[str, PolicyFeature] = field(default_factory=_features)
    features_map: dict[str, str] = field(default_factory=_names)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: `create_envs` makes them."""
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """Task → first episode → batch of environments, each of which stops where its
        episode ends.
        """
        kind: Any = (
            gym.vector.AsyncVectorEnv if use_async_envs and n_envs > 1 else gym.vector.SyncVectorEnv
        )

        def batch(task: str, first: int) -> Any:
            made = [
                freeze_after_episode_end(
                    partial(RoboMMEWithVideo, task, self.split, first + i, self.max_steps)
                )
                for i in range(n_envs)
            ]
            return kind(made)

        tasks = [task.strip() for task in self.task.split(",")]
        return {task: {first: batch(task, first) for first in self.episodes} for task in tasks}
