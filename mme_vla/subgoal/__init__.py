"""Symbolic memory: predictors of the current subgoal, in words. Names are loaded on first use.

>>> from mme_vla.subgoal import build_predictor
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mme_vla.subgoal.background import BackgroundPredictor
    from mme_vla.subgoal.base import (
        Subgoal,
        SubgoalEpisode,
        SubgoalPredictor,
        Usage,
        build_predictor,
    )
    from mme_vla.subgoal.memer import Memer
    from mme_vla.subgoal.notebook import NotebookPredictor
    from mme_vla.subgoal.oracle import Oracle
    from mme_vla.subgoal.prompted import Gemini, OpenAI
    from mme_vla.subgoal.qwenvl import QwenVL

_MODULES = {
    "BackgroundPredictor": "background",
    "Gemini": "prompted",
    "Memer": "memer",
    "NotebookPredictor": "notebook",
    "OpenAI": "prompted",
    "Oracle": "oracle",
    "QwenVL": "qwenvl",
    "Subgoal": "base",
    "SubgoalEpisode": "base",
    "SubgoalPredictor": "base",
    "Usage": "base",
    "build_predictor": "base",
}

__all__ = [
    "BackgroundPredictor",
    "Gemini",
    "Memer",
    "NotebookPredictor",
    "OpenAI",
    "Oracle",
    "QwenVL",
    "Subgoal",
    "SubgoalEpisode",
    "SubgoalPredictor",
    "Usage",
    "build_predictor",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
