"""Imported by the process that simulating ones are forked from: whatever they import, done once."""

import gc

import mme_vla.envs.task  # noqa: F401

# ManiSkill collects garbage whenever it builds a scene. With all that is imported here that takes 0.4 s, four fifths of
# the time of an episode's start without a picture; left out of it, 2 ms. It also keeps the memory shared.
gc.collect()
gc.freeze()
