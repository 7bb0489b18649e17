"""Policies that act by a rule, so that their twin accuracy is known."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from mme_vla.policy.base import Policy


class PlantedEpisode:
    """Keeps every image that it observes, and the noise that the policy would have."""

    failure = None
    subgoal = None
    goal = ""
    options: Sequence[Any] = ()

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.images: list[np.ndarray] = []
        self.n_observed_frames = 0

    def observe(self, frames: Mapping[str, np.ndarray], *_: Any, **__: Any) -> None:
        images = next(iter(frames.values()))
        self.images += list(images)
        self.n_observed_frames += len(images)

    def note_subtask_starts(self, frames: Sequence[int], exec_start: int) -> None:
        pass


Rule = Callable[[PlantedEpisode], np.ndarray]
"""The chunk that is chosen in an episode."""


class Planted(Policy):
    """A policy that acts by a rule, with the robot of another."""

    memory = None

    def __init__(self, inner: Policy, rule: Rule) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.processor = inner.processor
        self.config = inner.config
        self.rule = rule

    def start_episode(self, goal: str, seed: int = 0) -> Any:
        return PlantedEpisode(seed)

    def act(self, episodes: Any, steps: int | None = None) -> np.ndarray:
        return np.stack([self.rule(episode) for episode in episodes])
