"""The random floor of an audit: what is solved without reading anything of a scene."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from mme_vla.extras.probing.recordings import Recording
from mme_vla.policy.base import Policy, PolicyInfo
from mme_vla.policy.episode import Episode
from mme_vla.types import Noise

RANDOM = "random"
"""The floor's name in cards and records, and its folder."""


class RandomPolicy(Policy):
    """Takes any option and any point; of a robot without options a chunk from any place of the
    recorded episodes.

    The seed of an episode decides which.
    """

    memory = None

    def __init__(self, policy: Policy, recordings: Sequence[Recording]) -> None:
        """Take the robot of a policy. recordings: of this robot; at least one where it has no
        options.
        """
        super().__init__()
        self.processor = policy.processor
        self.config = {"name": RANDOM, "embodiment": policy.embodiment.to_dict()}
        self.horizon = policy.embodiment.action.horizon
        self.info = PolicyInfo(max_actions=policy.info.max_actions)
        self.weights = torch.nn.Parameter(torch.zeros(0), requires_grad=False)
        """None; the parameter says which device and precision a run has."""
        self._recordings = list(recordings)

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray:
        """No frame beside the current ones."""
        return np.zeros(0, np.int64)

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The chunk [h, w], absolute."""
        space = self.embodiment.action
        if space.choice:
            return {"chunk": torch.rand(self.horizon, space.width, generator=generator)}
        which, place = torch.rand(2, generator=generator).tolist()
        recording = self._recordings[int(which * len(self._recordings))]
        source, episode = recording.source, recording.episode
        if source.robot.action.frames is None:
            actions = source.past_actions(episode, recording.length - 1, recording.length)
        else:
            actions = source.actions(episode, recording.exec_start)
        # A chunk that begins near the end repeats the last action.
        steps = int(place * len(actions)) + np.arange(self.horizon)
        chunk = actions[np.minimum(steps, len(actions) - 1)]
        return {"chunk": torch.from_numpy(np.asarray(chunk, np.float32))}

    def act(self, episodes: Any, steps: int | None = None) -> np.ndarray:
        """Choose as `Policy.act` does."""
        if isinstance(episodes, Episode):
            single: np.ndarray = self.act([episodes])[0]
            return single
        chunks = []
        for episode in episodes:
            chunk = self.embodiment.action.decide(episode.draw()["chunk"], episode.options).numpy()
            episode.acted(chunk)
            chunks.append(chunk)
        return np.stack(chunks)
