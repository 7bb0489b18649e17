"""Imported by the process that simulating ones are forked from: whatever they import, done once."""

import gc

import mme_vla.envs.task  # noqa: F401

# What a collection does not walk through stays shared between the processes.
gc.collect()
gc.freeze()
