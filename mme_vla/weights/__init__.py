"""Checkpoints of every format: one adapter each, over the name tables that the packages below
supply.
"""

from mme_vla.weights.load import load_weights, start_from, transfer
from mme_vla.weights.source import open_source
from mme_vla.weights.statistics import read_stats

__all__ = ["load_weights", "open_source", "read_stats", "start_from", "transfer"]
