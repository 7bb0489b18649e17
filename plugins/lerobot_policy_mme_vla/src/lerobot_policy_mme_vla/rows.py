"""The episodes of one batch of environments."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mme_vla import Episode, Policy

BLOCK = 256  # frames of a conditioning video that wait to be read together


@dataclass
class Row:
    """One environment's episode, the frames it has not read yet, and what is left of its chunk.

    Frames are read when a chunk is chosen, all since the last one at once, as mme-vla's own
    evaluation does.
    """

    episode: Episode
    plan: deque[np.ndarray] = field(default_factory=deque)
    in_video: bool = False
    _frames: list[Mapping[str, np.ndarray]] = field(default_factory=list)
    _states: list[np.ndarray] = field(default_factory=list)
    _demo: list[bool] = field(default_factory=list)

    def see(self, images: Mapping[str, np.ndarray], state: np.ndarray, is_demo: bool) -> None:
        """Take a frame: images [H, W, 3] uint8 by camera, and the state [s]."""
        self._frames.append(images)
        self._states.append(state)
        self._demo.append(is_demo)
        self.in_video = is_demo
        if is_demo and len(self._frames) == BLOCK:
            self.read()

    def read(self) -> None:
        """Hand the waiting frames to the episode."""
        if not self._frames:
            return
        views = {
            camera: np.stack([frame[camera] for frame in self._frames])
            for camera in self._frames[0]
        }
        self.episode.observe(views, np.stack(self._states), np.array(self._demo))
        self._frames, self._states, self._demo = [], [], []


def act(policy: Policy, rows: list[Row], steps: int | None) -> np.ndarray:
    """Choose chunks [n, h, w] for these, in one batch."""
    for row in rows:
        row.read()
    chunks: np.ndarray = policy.act([row.episode for row in rows], steps)
    return chunks
