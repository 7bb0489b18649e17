"""What learning from trajectories adds: an action head. All else is called from Python."""

from mme_vla.registry import Extension

EXTENSION = Extension(parts={"head": {"choice": "mme_vla.extras.trajectories.choice"}})
