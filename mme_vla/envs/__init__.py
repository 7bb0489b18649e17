"""The 16 RoboMME tasks as environments, with their demonstrations. Importing this does not import
the simulator.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mme_vla.envs.interface import RoboMMEEnv
    from mme_vla.envs.make import load_tasks, make_env
    from mme_vla.envs.metadata import TASK_NAMES, EpisodeSpec, episode
    from mme_vla.envs.vector.pool import Job, Reply, VecEnv, make_vec_env

__all__ = [
    "TASK_NAMES",
    "EpisodeSpec",
    "Job",
    "Reply",
    "RoboMMEEnv",
    "VecEnv",
    "episode",
    "load_tasks",
    "make_env",
    "make_vec_env",
]

_HOMES = {
    "EpisodeSpec": "metadata",
    "Job": "vector.pool",
    "Reply": "vector.pool",
    "RoboMMEEnv": "interface",
    "TASK_NAMES": "metadata",
    "VecEnv": "vector.pool",
    "episode": "metadata",
    "load_tasks": "make",
    "make_env": "make",
    "make_vec_env": "vector.pool",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
