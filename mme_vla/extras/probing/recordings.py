"""Recorded episodes that a policy observes: in a probe, or before each episode of a
stress split.
"""

from collections.abc import Sequence

import numpy as np

from mme_vla.data import recording
from mme_vla.data.episodes import EpisodeSource
from mme_vla.extras.methods.sam2act.keyframes import EpisodeKeyframes, KeyframeFile


class Recording(recording.Recording):
    """One episode of a dataset, with the depth that files beside the dataset hold."""

    def views(
        self, start: int, stop: int, required: np.ndarray | None
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray] | None]:
        """As `recording.Recording.views`. A robot that reads depth observes the frames that the
        dataset keeps depth of.
        """
        robot = self.source.robot
        if not robot.readings:
            return super().views(start, stop, required)
        keyframes = EpisodeKeyframes(KeyframeFile.file_of(self.source.root, self.episode))
        keyframes.check(self.length)
        here = keyframes.frames[(keyframes.frames >= start) & (keyframes.frames < stop)]
        stored_views = keyframes.views(here, robot)
        return stored_views, dict.fromkeys(stored_views, here - start)


def all_recordings(sources: Sequence[EpisodeSource], action_offset: int = 0) -> list[Recording]:
    """Every episode of some datasets. action_offset: of the policy that observes them."""
    recordings = []
    for source in sources:
        for episode in range(len(source)):
            recordings.append(Recording(source, episode, action_offset))
    return recordings
