"""Importing this registers the sixteen tasks with Gymnasium, as the official module does."""

from mme_vla.envs.make import load_tasks

load_tasks()
