"""Symbolic memory: who says the current subgoal. Importing the room registers the predictors it ships."""

from mme_vla.subgoal.background import BackgroundPredictor
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor, Usage, build_predictor
from mme_vla.subgoal.gemini import Gemini, OpenAI
from mme_vla.subgoal.memer import Memer
from mme_vla.subgoal.notebook import NotebookPredictor
from mme_vla.subgoal.oracle import Oracle
from mme_vla.subgoal.qwenvl import QwenVL

__all__ = [
    "BackgroundPredictor", "Gemini", "Memer", "NotebookPredictor", "OpenAI", "Oracle", "QwenVL", "Subgoal",
    "SubgoalEpisode", "SubgoalPredictor",
    "Usage", "build_predictor",
]  # fmt: skip
