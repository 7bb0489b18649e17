"""Memory-augmented vision-language-action policies: one backbone, one memory interface, three integrations.

>>> from mme_vla import build_policy
>>> policy = build_policy("tokendrop_expert", backbone="tiny")
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mme_vla.embodiment import Embodiment
    from mme_vla.errors import UserError
    from mme_vla.memory.base import Memory
    from mme_vla.memory.history import CachedHistory, History, OnlineHistory, StorageSpec
    from mme_vla.policy.build import build_policy
    from mme_vla.policy.mme import Episode, MMEPolicy
    from mme_vla.registry import BACKBONES, INTEGRATIONS, MEMORIES, SUBGOALS, TASKS
    from mme_vla.types import Batch, HistoryTokens, MemoryTokens

    __version__: str

# Names are loaded on first use, so that importing the package costs nothing and needs no optional dependency.
_HOME = {
    "build_policy": "mme_vla.policy.build",
    "Embodiment": "mme_vla.embodiment",
    "MMEPolicy": "mme_vla.policy.mme",
    "Episode": "mme_vla.policy.mme",
    "Memory": "mme_vla.memory.base",
    "History": "mme_vla.memory.history",
    "StorageSpec": "mme_vla.memory.history",
    "OnlineHistory": "mme_vla.memory.history",
    "CachedHistory": "mme_vla.memory.history",
    "HistoryTokens": "mme_vla.types",
    "MemoryTokens": "mme_vla.types",
    "Batch": "mme_vla.types",
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
    "Batch",
    "CachedHistory",
    "Embodiment",
    "Episode",
    "History",
    "HistoryTokens",
    "MMEPolicy",
    "Memory",
    "MemoryTokens",
    "OnlineHistory",
    "StorageSpec",
    "UserError",
    "__version__",
    "build_policy",
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
