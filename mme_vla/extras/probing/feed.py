"""Which frames of an episode a policy observes under perturbations: repeated, left out, after other
episodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mme_vla.memory.perturbation import Perturbation, overrides
from mme_vla.memory.transforms import map_frames


@dataclass(frozen=True)
class Feed:
    """The frames that a policy observes of an episode, under these perturbations, in this order.

    They act as in training. Unrelated episodes come first, as part of the conditioning video.
    """

    perturbations: tuple[Perturbation, ...] = ()

    @classmethod
    def of(cls, perturbations: Sequence[Perturbation]) -> "Feed":
        """The feed of those that act on frames: arms that share it observe the same."""
        hooks = ("repeats", "n_sessions", "shows_video")
        return cls(tuple(one for one in perturbations if overrides(type(one), *hooks)))

    @property
    def n_sessions(self) -> int:
        """How many unrelated episodes come first."""
        return sum(one.n_sessions for one in self.perturbations)

    @property
    def shows_video(self) -> bool:
        """Whether the conditioning video is shown."""
        return all(one.shows_video for one in self.perturbations)

    @property
    def drops(self) -> bool:
        """Whether frames of the execution may be left out."""
        return any(one.drops for one in self.perturbations)

    def repeats(self, frames: np.ndarray, exec_start: int) -> np.ndarray:
        """How often each of the episode's frames [n] is observed, int64 [n]."""
        frames = np.asarray(frames, np.int64)
        if not len(frames):
            return np.zeros(0, np.int64)
        return self._counts(int(frames.max()) + 1, exec_start)[frames]

    def _counts(self, length: int, exec_start: int) -> np.ndarray:
        """How often each of the first `length` frames is observed."""
        real = map_frames(self.perturbations, length, exec_start).real
        counts = np.bincount(real, minlength=length)
        if not self.shows_video:
            counts[:exec_start] = 0
        return counts

    def displayed(self, frames: np.ndarray, exec_start: int, before: int = 0) -> np.ndarray:
        """The episode's frames [n] as numbers of observed frames, int64 [n]; −1 for one that is
        left out.

        exec_start: the episode's first execution frame.
        before: frames of the sessions.
        """
        frames = np.asarray(frames, np.int64)
        counts = self._counts(int(frames.max(initial=0)) + 1, exec_start)
        last = before + np.cumsum(counts)[frames] - 1  # of a repeated frame: its last repeat
        return np.where(counts[frames] > 0, last, -1)

    def first_executed(self, exec_start: int, before: int = 0) -> int:
        """The number of the first execution frame among the observed ones."""
        return before + int(self._counts(exec_start, exec_start).sum())

    def source_frames(self, displayed: np.ndarray, exec_start: int, before: int = 0) -> np.ndarray:
        """The episode's frames behind observed ones [m], ascending, each once; those of sessions
        are left out.
        """
        displayed = np.asarray(displayed, np.int64) - before
        displayed = displayed[displayed >= 0]
        if not len(displayed):
            return displayed
        # As many frames of the episode as it takes to observe the last of them.
        length = exec_start + int(displayed.max()) + 1
        counts = self._counts(length, exec_start)
        while counts.sum() <= displayed.max():
            length *= 2
            counts = self._counts(length, exec_start)
        return np.unique(np.repeat(np.arange(length), counts)[displayed])
