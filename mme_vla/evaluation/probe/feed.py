"""What an episode is shown instead of what happened: sessions before it, no video, a pause."""

from dataclasses import dataclass

import numpy as np

from mme_vla.errors import UserError


@dataclass(frozen=True)
class Feed:
    """Frames of an episode on their way to a policy. The default shows what happened.

    sessions: unrelated episodes that come first, as if they were part of the video. video: whether the conditioning
    video is shown. stills: how often one frame is repeated; at: which, counted from the first execution frame.
    """

    sessions: int = 0
    video: bool = True
    stills: int = 0
    at: int = 0

    def __post_init__(self) -> None:
        for name in ("sessions", "stills", "at"):
            if getattr(self, name) < 0:
                raise UserError(f"A probe cannot show {getattr(self, name)} {name}: the number must not be negative.")

    def shown(self, frames: np.ndarray, exec_start: int, before: int = 0) -> np.ndarray:
        """Where frames [n] of the episode stand among the shown ones, int64 [n]; −1 where one is left out.

        Args:
            exec_start: the episode's first execution frame. before: frames of the sessions.
        """
        frames = np.asarray(frames, np.int64)
        video = exec_start if self.video else 0
        later = np.where(frames >= exec_start + self.at, self.stills, 0)  # the frame that stands still: its last repeat
        executed = before + video + frames - exec_start + later
        return np.where(frames >= exec_start, executed, before + frames if self.video else -1)

    def first_executed(self, exec_start: int, before: int = 0) -> int:
        """The first execution frame among the shown ones."""
        return before + (exec_start if self.video else 0)

    def own(self, shown: np.ndarray, exec_start: int, before: int = 0) -> np.ndarray:
        """The episode's own frames behind shown ones [m], ascending, each once; those of sessions are left out."""
        shown = np.asarray(shown, np.int64) - before
        shown = shown[shown >= 0]
        video = exec_start if self.video else 0
        past = shown - video
        executed = np.where(past > self.at, np.maximum(past - self.stills, self.at), past)
        return np.unique(np.where(shown < video, shown, exec_start + executed))
