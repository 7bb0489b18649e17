"""An episode as a video: all cameras side by side, the conditioning part in a red border, below
them the goal, the run, the step, the subgoal and at the end the outcome.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mme_vla.utils import draft_of
from mme_vla.utils.media import VideoWriter, video_frame

_LONGEST_GOAL = 100  # characters of a file name


class EpisodeVideo:
    """Draws and compresses frame by frame, so that no episode is held in memory.

    The file gets its name, with the outcome, when the episode is over; until then it is a hidden
    file beside it.

    folder: of the videos.
    episode: begins the file's name, `PickXtimes_ep3_success_pick_up_the_red_cube.mp4`.
    save_on: which outcomes are kept: `all`, `success` or `failure`.
    run: name of the run, in every frame.
    """

    def __init__(self, folder: Path, episode: str, save_on: str = "all", run: str = "") -> None:
        self._folder = folder
        self._episode = episode
        self._save_on = save_on
        self._run = run
        self._video: VideoWriter | None = None
        self._draft = Path()

    def add(
        self,
        views: Sequence[np.ndarray],
        goal: str | None = None,
        caption: str = "",
        demo: bool = False,
    ) -> None:
        """Append the images [H, W, 3] uint8 that all cameras took at one step.

        goal, caption: the two lines below them; the run's name begins the second.
        demo: whether they are of the conditioning video.
        """
        line = " · ".join(part for part in (self._run, caption) if part)
        text = f"{goal or ''}\n{line}"
        if self._video is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._draft = draft_of(self._folder / f"film-{id(self):x}.mp4")
            self._video = VideoWriter(self._draft)
        self._video.add(video_frame(views, text, demo))

    def finish(self, outcome: str, goal: str) -> Path | None:
        """Close the video under its name; None if this outcome is not kept."""
        kind = "success" if outcome == "success" else "failure"
        if self._video is None or self._save_on not in ("all", kind):
            self.discard()
            return None
        self._video.close()
        words = re.sub(r"[^a-z0-9]+", "_", goal.lower()).strip("_")
        if len(words) > _LONGEST_GOAL:
            words = words[:_LONGEST_GOAL].rpartition("_")[0]
        name = "_".join(part for part in (self._episode, outcome, words) if part)
        target = self._folder / f"{name}.mp4"
        self._draft.replace(target)
        self._video = None
        return target

    def discard(self) -> None:
        """Drop the frames."""
        if self._video is not None:
            self._video.close(complete=False)
            self._draft.unlink(missing_ok=True)
            self._video = None
