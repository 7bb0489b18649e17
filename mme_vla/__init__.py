"""Memory-augmented vision-language-action policies: one backbone, one memory interface, three
integrations.

>>> from mme_vla import build_policy
>>> policy = build_policy("tokendrop_expert", backbone="tiny")
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mme_vla.backbone.base import Backbone
    from mme_vla.embodiment import Embodiment
    from mme_vla.envs.base import Environment
    from mme_vla.envs.facts import Candidates, Fact
    from mme_vla.envs.make import make_env
    from mme_vla.envs.task import Task
    from mme_vla.envs.vector.pool import make_vec_env
    from mme_vla.errors import UserError
    from mme_vla.evaluation.rollout.evaluation import evaluate
    from mme_vla.extras.probing.run import probe
    from mme_vla.integration.base import Integration
    from mme_vla.memory.base import Memory, PerceptualMemory
    from mme_vla.memory.history import CachedHistory, History, OnlineHistory, StorageSpec
    from mme_vla.memory.perturbation import Perturbation
    from mme_vla.memory.recurrent import RecurrentMemory
    from mme_vla.policy.base import Policy
    from mme_vla.policy.build import build_policy
    from mme_vla.policy.episode import Episode
    from mme_vla.policy.mme import MMEPolicy
    from mme_vla.registry import BACKBONES, INTEGRATIONS, MEMORIES, SUBGOALS, TASKS, register
    from mme_vla.subgoal.base import SubgoalPredictor
    from mme_vla.types import Batch, HistoryTokens, MemoryTokens
    from mme_vla.weights.load import load_weights

    __version__: str

# Names are loaded on first use, so that importing the package costs nothing and needs no optional
# dependency.
_MODULES = {
    "backbone.base": ["Backbone"],
    "embodiment": ["Embodiment"],
    "envs.base": ["Environment"],
    "envs.facts": ["Candidates", "Fact"],
    "envs.make": ["make_env"],
    "envs.task": ["Task"],
    "envs.vector.pool": ["make_vec_env"],
    "errors": ["UserError"],
    "evaluation.rollout.evaluation": ["evaluate"],
    "integration.base": ["Integration"],
    "memory.base": ["Memory", "PerceptualMemory"],
    "memory.history": ["CachedHistory", "History", "OnlineHistory", "StorageSpec"],
    "memory.recurrent": ["RecurrentMemory"],
    "memory.perturbation": ["Perturbation"],
    "policy.base": ["Policy"],
    "policy.build": ["build_policy"],
    "policy.episode": ["Episode"],
    "policy.mme": ["MMEPolicy"],
    "extras.probing.run": ["probe"],
    "registry": ["BACKBONES", "INTEGRATIONS", "MEMORIES", "SUBGOALS", "TASKS", "register"],
    "subgoal.base": ["SubgoalPredictor"],
    "types": ["Batch", "HistoryTokens", "MemoryTokens"],
    "weights.load": ["load_weights"],
}
_HOME = {name: f"mme_vla.{module}" for module, names in _MODULES.items() for name in names}

__all__ = [
    "BACKBONES",
    "INTEGRATIONS",
    "MEMORIES",
    "SUBGOALS",
    "TASKS",
    "Backbone",
    "Batch",
    "CachedHistory",
    "Candidates",
    "Embodiment",
    "Environment",
    "Episode",
    "Fact",
    "History",
    "HistoryTokens",
    "Integration",
    "MMEPolicy",
    "Memory",
    "MemoryTokens",
    "OnlineHistory",
    "PerceptualMemory",
    "Perturbation",
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
