"""Recorded episodes that a policy observes: in a probe, or before each episode of a
stress split.
"""

from collections.abc import Sequence

import numpy as np

from mme_vla.data import recording
from mme_vla.data.episodes import EpisodeSource
from mme_vla.extras.methods.sam2act.keyframes import EpisodeKeyframes, KeyframeFile
from mme_vla.memory.base import union_frames
from mme_vla.policy.base import Policy

SUBGOAL = "simple_subgoal"  # The column whose changes separate sub-tasks


class Recording(recording.Recording):
    """One episode of a dataset, its sub-tasks, and the depth that files beside the dataset hold."""

    @property
    def task(self) -> str:
        return self.source.task(self.episode)

    @property
    def goal(self) -> str:
        return self.source.goal(self.episode)

    @property
    def tells_subtasks(self) -> bool:
        return SUBGOAL in self.source.subgoal_names

    def subgoal(self, step: int, column: str = SUBGOAL) -> str | None:
        """The subgoal at a step; None where the dataset has no such column."""
        return self.source.subgoals(self.episode, step).get(column)

    def frame(self, number: int) -> np.ndarray:
        """An image [H, W, 3] uint8 of the camera that feeds memory."""
        return self.source.frames(self.episode, [number])[0]

    def boundaries(self) -> list[int]:
        """Frames at which a sub-task begins, the execution's first among them."""
        if not self.tells_subtasks:
            return [self.exec_start]
        subgoals = [self.subgoal(step) for step in range(self.length)]
        changes = [step for step in range(1, self.length) if subgoals[step] != subgoals[step - 1]]
        return sorted({0, self.exec_start, *changes})

    def views(
        self, start: int, stop: int, required: np.ndarray | None, every_camera: bool = False
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray] | None]:
        """As `recording.Recording.views`. A robot that reads depth observes the frames that the
        dataset keeps depth of.
        """
        robot = self.source.robot
        if not robot.readings:
            return super().views(start, stop, required, every_camera)
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


def stored_frames(policy: Policy, length: int) -> np.ndarray | None:
    """Frames of an episode that a memory may have stored or scored, whatever it chooses; None for
    all.
    """
    memory = policy.memory
    if memory is None or memory.past_view_spec is not None:
        return None
    if policy.frames_read(np.zeros(1, np.int64), 0) is None:
        return None
    frames = [memory.storage.stored_frames(length)]
    scorer = memory.make_scorer()
    if scorer is not None:
        frames.append(scorer.frames_scored(length))
    return union_frames(frames)
