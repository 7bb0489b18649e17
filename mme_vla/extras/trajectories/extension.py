"""What learning from trajectories adds: it is called from Python alone, so there are no names."""

from mme_vla.registry import Extension

EXTENSION = Extension()
