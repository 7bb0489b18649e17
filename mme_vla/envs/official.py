"""The official package `robomme` behind the interface of this library's own environments.

It needs a patched simulator, numpy < 2 and gymnasium 0.29, so it lives in an environment of its own; where it is
installed, `make_env(..., env="official")` gives its episodes to the same policies and evaluators.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from mme_vla.envs.observations import Include
from mme_vla.errors import UserError

_BUILDER = "robomme.env_record_wrapper"
_ENVIRONMENTS = "robomme.robomme_env"
_INSTALL_HINT = (
    "The official package robomme is not installed. Install it from github.com/RoboMME/robomme_benchmark "
    "in an environment of its own, since it needs numpy < 2 and gymnasium 0.29; or use env='mme_vla', which needs none."
)


class OfficialEnv:
    """One official episode; `reset`, `step`, `render`, `close` as in `RoboMMEEnv`.

    Args:
        env: what the official builder made.
        max_steps: control steps after which the status becomes `timeout`.
        include: what observations and infos hold beyond the standard keys.
    """

    def __init__(self, env: Any, max_steps: int, include: Include) -> None:
        self._env: Any = env
        self.max_steps = max_steps
        self.include = include
        self._newest: np.ndarray | None = None
        self._started = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, list[Any]], dict[str, Any]]:
        """Begin the episode; `seed` and `options` have no effect."""
        observation, info = self._open().reset()
        self._started = True
        self._keep_newest(observation)
        return observation, _flat(info)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Perform one action."""
        env = self._open()
        if not self._started:
            raise UserError("step() before reset(): call reset() first.")
        observation, reward, terminated, truncated, info = env.step(action)
        self._keep_newest(observation)
        return observation, reward, terminated, truncated, _flat(info)

    def render(self) -> np.ndarray | None:
        """The newest front image [256, 256, 3], or None before the first reset."""
        self._open()
        return self._newest

    def close(self) -> None:
        """Free the simulator; closing twice is harmless."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _open(self) -> Any:
        if self._env is None:
            raise UserError("The environment is closed; make a new one.")
        return self._env

    def _keep_newest(self, observation: Any) -> None:
        if observation and observation.get("front_rgb_list"):
            self._newest = np.asarray(observation["front_rgb_list"][-1])


def make_official_env(
    task: str, split: str, episode: int, action_space: str, max_steps: int, options: dict[str, Any]
) -> OfficialEnv:
    """Make an episode of the official package."""
    include = Include.from_options(options)
    if find_spec("robomme") is None:
        raise UserError(_INSTALL_HINT)
    if hasattr(import_module("robomme"), "STANDS_IN"):
        raise UserError(
            "The installed package robomme is this library's stand-in (plugins/robomme), whose environments are those "
            "of env='mme_vla'. Uninstall it and install the official one, or leave out env='official'."
        )
    import_module(_ENVIRONMENTS)  # registers the tasks
    builder = import_module(_BUILDER).BenchmarkEnvBuilder(
        env_id=task, dataset=split, action_space=action_space, gui_render=False, max_steps=max_steps
    )
    count = builder.get_episode_num()
    if not 0 <= episode < count:
        raise UserError(f"Unknown episode {episode} of {task}, split {split!r}; expected 0 to {count - 1}.")
    flags = {name: True for name, yes in include.options.items() if yes}
    return OfficialEnv(builder.make_env_for_episode(episode, max_steps=max_steps, **flags), max_steps, include)


def _flat(info: dict[str, Any]) -> dict[str, Any]:
    """The info as one plain dict whose `task_goal` is a list."""
    goal = info.get("task_goal")
    return {**info, "task_goal": [goal]} if isinstance(goal, str) else dict(info)
