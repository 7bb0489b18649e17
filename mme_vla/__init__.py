"""Memory-augmented vision-language-action policies: one backbone, one memory interface, three integrations.

>>> from mme_vla import build_policy
>>> policy = build_policy("tokendrop_expert", backbone="tiny")
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mme_vla.backbone.base import Backbone
    from mme_vla.embodiment import Embodiment
    from mme_vla.envs.make import make_env
    from mme_vla.envs.task import Task
    from mme_vla.envs.vector.pool import make_vec_env
    from mme_vla.errors import UserError
    from mme_vla.evaluation.api import evaluate
    from mme_vla.integration.base import Integration
    from mme_vla.memory.base import Memory, PerceptualMemory
    from mme_vla.memory.history import CachedHistory, History, OnlineHistory, StorageSpec
    from mme_vla.memory.recurrent import RecurrentMemory
    from mme_vla.policy.base import Policy
    from mme_vla.policy.build import build_policy
    from mme_vla.policy.episode import Episode
    from mme_vla.policy.mme import MMEPolicy
    from mme_vla.probing.run import probe
    from mme_vla.registry import BACKBONES, INTEGRATIONS, MEMORIES, SUBGOALS, TASKS, register
    from mme_vla.subgoal.base import SubgoalPredictor
    from mme_vla.types import Batch, HistoryTokens, MemoryTokens
    from mme_vla.weights.load import load_weights

    __version__: str

# Names are loaded on first use, so that importing the package costs nothing and needs no optional dependency.
_HOME = {
    "build_policy": "mme_vla.policy.build",
    "Policy": "mme_vla.policy.base",
    "Embodiment": "mme_vla.embodiment",
    "MMEPolicy": "mme_vla.policy.mme",
    "Episode": "mme_vla.policy.episode",
    "Memory": "mme_vla.memory.base",
    "PerceptualMemory": "mme_vla.memory.base",
    "RecurrentMemory": "mme_vla.memory.recurrent",
    "StorageSpec": "mme_vla.memory.history",
    "History": "mme_vla.memory.history",
    "OnlineHistory": "mme_vla.memory.history",
    "CachedHistory": "mme_vla.memory.history",
    "Integration": "mme_vla.integration.base",
    "Backbone": "mme_vla.backbone.base",
    "SubgoalPredictor": "mme_vla.subgoal.base",
    "Task": "mme_vla.envs.task",
    "HistoryTokens": "mme_vla.types",
    "MemoryTokens": "mme_vla.types",
    "Batch": "mme_vla.types",
    "make_env": "mme_vla.envs.make",
    "make_vec_env": "mme_vla.envs.vector.pool",
    "evaluate": "mme_vla.evaluation.api",
    "probe": "mme_vla.probing.run",
    "load_weights": "mme_vla.weights.load",
    "register": "mme_vla.registry",
    "UserError": "mme_vla.errors",
    "MEMORIES": "mme_vla.registry",
    "INTEGRATIONS": "mme_vla.registry",
    "BACKBONES": "mme_vla.registry",
    "SUBGOALS": "mme_vla.registry",
    "TASKS": "mme_vla.registry",
}

__all__ = [
    "BACKBONES",
    "INTEGRATIONS",
    "MEMORIES",
    "SUBGOALS",
    "TASKS",
    "Backbone",
    "Batch",
    "CachedHistory",
    "Embodiment",
    "Episode",
    "History",
    "HistoryTokens",
    "Integration",
    "MMEPolicy",
    "Memory",
    "MemoryTokens",
    "OnlineHistory",
    "PerceptualMemory",
    "Policy",
    "RecurrentMemory",
    "StorageSpec",
    "SubgoalPredictor",
    "Task",
    "UserError",
    "__version__",
    "build_policy",
    "evaluate",
    "load_weights",
    "make_env",
    "make_vec_env",
    "probe",
    "register",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("mme-vla")
    elif name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
