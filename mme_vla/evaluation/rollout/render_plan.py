"""The images that a rollout requests of its environments: those that the policy and its predictor
read, no others.

When a policy acts is known beforehand, so what its memory reads is too, but for one thing: how long
the conditioning video is. An episode therefore begins without those of its images that depend on
it. Where some turn out to be needed, it begins once more, and the same simulation then renders
them.
"""

from collections.abc import Container
from functools import cache, cached_property

import numpy as np

from mme_vla.envs.observations import RenderRequest
from mme_vla.evaluation.rollout.environment import Observation
from mme_vla.evaluation.rollout.episode import RunningEpisode
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.memory.base import union_frames
from mme_vla.policy.base import Policy
from mme_vla.subgoal import SubgoalPredictor

EVERY = range(2**31)  # Whatever frames there are
LONGEST_MOTION = 500  # frames by which the last motion of an episode may exceed its step limit
LONGEST_VIDEO = 2_000  # frames; what is missing of a longer one is rendered by a second reset


class RenderPlan:
    """The images to render for each command to an environment; None requests everything.

    policy, subgoals: the readers.
    settings: how often the policy acts, and whether all is rendered (`draw`).
    """

    def __init__(
        self, policy: Policy, subgoals: SubgoalPredictor | None, settings: RolloutSettings
    ) -> None:
        self._policy = policy
        self._robot = policy.embodiment
        self._settings = settings
        self._grounded = subgoals is not None and subgoals.kind == "grounded"
        self._sees_video = subgoals is not None and subgoals.sees_video
        self._sees_passing = subgoals is not None and subgoals.sees_passing
        self._resampled = any(event.resamples_video for event in settings.events)
        memory = policy.memory
        every = memory is not None and memory.past_view_spec is not None
        self._cameras = self._robot.camera_names if every else (self._robot.memory_camera,)
        self._reads = cache(self._reads_of)
        # Depth and poses of cameras come with every frame.
        self._all = settings.draw == "all" or bool(self._robot.readings) or self._reads(0) is None

    def before_video(self) -> RenderRequest | None:
        """For a reset, before it is known how long the video is: what is certain to be wanted."""
        if self._all:
            return None
        if self._sees_video or self._resampled:
            return self._render_request(EVERY)
        return self._render_request(self._read_of_videos)

    def missing(self, frames: Observation) -> RenderRequest | None:
        """For a second reset, after one that gave these frames; None where it gave all that is
        needed.
        """
        if self._all or self._resampled:
            return None
        video = len(frames["state"]) - 1
        needed = range(video) if self._sees_video else self._within(video, 0, video)
        if all(frames[self._robot.memory_camera][frame] is not None for frame in needed):
            return None
        return self._render_request(frozenset(needed))

    def of_chunk(
        self, running: RunningEpisode, count: int, unobserved: int = 0
    ) -> RenderRequest | None:
        """For the next `count` frames of an episode, after so many further ones that are not
        observed.
        """
        if self._all:
            return None
        if self._sees_passing:
            return self._render_request(EVERY)
        first = running.episode.n_observed_frames
        stop = EVERY.stop  # of a motion it is not known how many frames it takes
        if self._robot.action.frames is not None:
            stop = first + count
        observed = self._within(running.video_frames, first, stop)
        # The environment counts the frames that events withheld as well.
        withheld = running.unobserved + unobserved
        return self._render_request(frozenset(frame + withheld for frame in observed))

    def _render_request(self, frames: Container[int]) -> RenderRequest:
        return RenderRequest(
            dict.fromkeys(self._cameras, frames), self._robot.camera_names, self._grounded
        )

    def _within(self, exec_start: int, first: int, stop: int) -> list[int]:
        reads = self._reads(exec_start)
        assert reads is not None
        frames: list[int] = reads[(reads >= first) & (reads < stop)].tolist()
        return frames

    @cached_property
    def _read_of_videos(self) -> Container[int]:
        """Frames that the policy may read of a video, however long it is; none where that may be
        most of them.
        """
        read = self._read_before(np.arange(LONGEST_VIDEO), LONGEST_VIDEO)
        if read is None or len(read) >= LONGEST_VIDEO / 2:
            return frozenset()
        return frozenset(read.tolist())

    def _read_before(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """Frames that the policy reads at any of these steps, but for the current one, which is
        rendered anyway.
        """
        lists = []
        for step in steps:
            read = self._policy.frames_read(np.array([step]), exec_start)
            if read is None:
                return None
            lists.append(read[read != step])
        return union_frames(lists)

    def _reads_of(self, exec_start: int) -> np.ndarray | None:
        """Frames that the policy reads of an episode with this video, until its step limit."""
        action = self._robot.action
        most = self._settings.step_limit + self._settings.hold_steps + 2
        # A motion, or an event that holds the robot, takes any number of frames: the policy may act
        # at each.
        if action.frames is None or self._settings.hold_steps:
            return self._read_before(exec_start + np.arange(most + LONGEST_MOTION), exec_start)
        apart = min(self._settings.execute or action.execute, action.horizon)
        return self._policy.frames_read(exec_start + np.arange(0, most, apart), exec_start)
