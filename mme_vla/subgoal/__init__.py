"""Symbolic memory: who says the current subgoal. Importing the room registers the predictors it ships."""

from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor, Usage, build_predictor
from mme_vla.subgoal.oracle import Oracle

__all__ = ["Oracle", "Subgoal", "SubgoalEpisode", "SubgoalPredictor", "Usage", "build_predictor"]
