"""The policy's side of one running episode: its memory, its subgoal, its clock, and the images that
are rendered for it.
"""

import hashlib
import time
from collections.abc import Container, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.embodiment.action_space import read_options
from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.records import Seconds
from mme_vla.evaluation.rollout.environment import Observation, Report
from mme_vla.evaluation.rollout.events import Event, EventCourse
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.rollout.subgoals import SubgoalTrace
from mme_vla.memory.base import union_frames
from mme_vla.policy.base import Policy
from mme_vla.subgoal import SubgoalPredictor


def episode_seed(seed: int, task: str, episode: int) -> int:
    """The seed of an episode's noise: of these three alone, so that order, batches and resumption
    do not matter.
    """
    digest = hashlib.sha256(f"{seed}/{task}/{episode}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1  # a signed 64-bit integer


def select_frames(frames: Observation, numbers: np.ndarray) -> Observation:
    """The frames with these numbers, int64 [n]."""
    selected: Observation = {"state": frames["state"][numbers]}
    for name, values in frames.items():
        if name != "state":
            selected[name] = [values[i] for i in numbers]
    return selected


class RunningEpisode:
    """One episode from before its reset to its end.

    In a round `take_report` notes what was executed, `begin` or `resume` takes the frames, `read`
    has the policy observe a piece of them, and `set_actions` takes what it decided.

    subgoals: predicts the subgoal.
    piece: frames to a piece.
    subgoal_folder: where its subgoals are logged; None keeps their score alone.
    events: what happens to it.
    worker: of its environment.
    """

    def __init__(
        self,
        policy: Policy,
        job: Job,
        seed: int,
        subgoals: SubgoalPredictor | None = None,
        piece: int = 32,
        subgoal_folder: Path | None = None,
        events: Sequence[Event] = (),
        worker: int = -1,
    ) -> None:
        self._policy = policy
        self._subgoals = subgoals
        self._piece = piece
        self.job = job
        self.worker = worker
        self.trace: SubgoalTrace | None = None
        if subgoals is not None:
            name = f"{job.task}_ep{job.episode}"
            self.trace = SubgoalTrace(subgoals.kind, subgoal_folder, name)
        self.episode = policy.start_episode("", seed=episode_seed(seed, job.task, job.episode))
        self.events = EventCourse(events)
        self._visible = np.zeros(0, np.int64)  # The environment's frames that the policy observes
        self._simulated = 0  # Frames of the environment
        self.watched: Any = None  # What the subgoal predictor knows of the episode
        self.steps = self.chunks = 0
        self.video_frames = 0
        self.report = Report()
        """The environment's last one."""
        self.first_video_frames: int | None = None
        """Frames of the conditioning video, once it is being simulated again for its images."""
        self._actions = hashlib.sha256()
        self._robot = policy.embodiment
        self._sent = np.zeros((0, self._robot.action.width), np.float32)
        self._sim = self._render = 0.0
        self.policy_s = 0.0  # this episode's share of the policy's time
        self._begun = time.perf_counter()
        self._frames: Observation = {"state": np.zeros((0, self._robot.state.width), np.float32)}
        self._demo: np.ndarray = np.zeros(0, bool)
        self._leading: np.ndarray | None = None  # Actions that led to the waiting frames
        self._at = 0

    # Observe: frames arrive, and are read piece by piece

    def take_report(self, report: Report) -> None:
        """Note what the environment says, and count the actions that it executed."""
        self.report = report
        self.steps += report.frames
        executed = np.ascontiguousarray(self._sent[: report.executed], np.float32)
        self._actions.update(executed.tobytes())
        self._sim += report.simulated_s
        self._render += report.rendered_s
        # Which options are possible may change after each choice.
        if self._robot.action.choice and report.options is not None:
            self.episode.options = read_options(report.options, len(self._robot.action.choice))

    def begin(self, frames: Observation) -> None:
        """Take the conditioning video, if the task has one, and the current frame.

        Raises:
            UserError: the environment names no goal.
        """
        goal = self.report.goal
        if goal is None:
            raise UserError(f"{self.job}: the environment's info has no task_goal.")
        self.episode.goal = goal
        # Events may leave out or repeat frames of the video; the current one is always observed.
        last = len(frames["state"]) - 1
        observed = np.append(self.events.video(last), last)
        self.video_frames = len(observed) - 1
        self._queue(frames, observed, None, n_video=self.video_frames)
        if self._subgoals is not None:
            video = None
            if self.video_frames and self._subgoals.sees_video:
                video = np.stack(self._frames[self._robot.memory_camera][:-1])
            self.watched = self._subgoals.start_episode(goal, video, self.job.task)

    def resume(self, frames: Observation) -> None:
        """Take the frames that the executed actions led to."""
        if self.events.holding is not None:
            self._resume_held(frames, self.events.holding.observed)
            return
        n_frames = len(frames["state"])
        executed = self._sent[: self.report.executed]
        if self._robot.action.frames is not None and n_frames != len(executed):
            raise UserError(
                f"{self.job}: {n_frames} frames for {len(executed)} actions; rollouts need one"
                " frame an action."
            )
        self._queue(frames, np.arange(n_frames), executed)

    def _resume_held(self, frames: Observation, n_observed: int) -> None:
        """Take the newest frames of the time for which an event held the robot."""
        length = len(frames["state"])
        self.events.hold_steps += length
        n_frames = min(n_observed, length)
        observed = np.arange(length - n_frames, length)
        leading: np.ndarray | None = self._sent[:0]
        if self._robot.action.frames is not None:
            leading = None  # before the first action
            if self.report.held is not None:
                target = np.asarray(self.report.held, np.float32)
                leading = np.repeat(target[None], n_frames, axis=0)
        self._queue(frames, observed, leading)

    def _queue(
        self,
        frames: Observation,
        observed: np.ndarray,
        leading: np.ndarray | None,
        n_video: int = 0,
    ) -> None:
        """Have those of the environment's next frames that the policy observes, int64 [n], wait to
        be read, with the actions that led to them.
        """
        self._visible = np.concatenate([self._visible, self._simulated + observed])
        self._simulated += len(frames["state"])
        self._frames = select_frames(frames, observed)
        self._demo = np.arange(len(observed)) < n_video
        self._leading = leading
        self._at = 0
        began = np.searchsorted(self._visible, self.report.began)  # as numbers of observed frames
        self.episode.note_subtask_starts(began.tolist(), self.video_frames)

    @property
    def pieces(self) -> int:
        """Pieces still to be read."""
        return max(0, -(-(len(self._frames["state"]) - self._at) // self._piece))

    def read(self) -> None:
        """Take one piece of the waiting frames into memory."""
        begun = time.perf_counter()
        part = slice(self._at, self._at + self._piece)
        demo = self._demo[part]
        views, rendered = self._views(part)
        for name in self._robot.readings:
            views[name] = np.stack(self._frames[name][part])

        # One action a frame; or some motions, all given with the first of their frames.
        actions = self._leading
        if actions is not None and self._robot.action.frames is not None:
            actions = actions[part]
        elif actions is not None and self._at > 0:
            actions = actions[:0]

        states = self._frames["state"][part]
        if all(len(places) == len(demo) for places in rendered.values()):
            self.episode.observe(views, states, demo, actions)
        else:
            self.episode.observe(views, states, demo, actions, rendered=rendered)
        self._show_predictor(views[self._robot.memory_camera], rendered, demo)
        self._at = part.stop
        self.policy_s += time.perf_counter() - begun

    def _show_predictor(
        self, images: np.ndarray, rendered: dict[str, np.ndarray], demo: np.ndarray
    ) -> None:
        """Have a subgoal predictor see frames of the execution: it has seen the video when the
        episode began.
        """
        if self.watched is None or demo[-1:].any():
            return
        displayed = images[~demo[rendered[self._robot.memory_camera]]]
        passed = int((~demo).sum()) - len(displayed)
        if passed:
            self.watched.skip(passed)
        if len(displayed):
            self.watched.observe(displayed, self.report.info)

    def _views(self, part: slice) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Images of every camera, and their places in this part of the frames."""
        views = {}
        rendered = {}
        for name in self._robot.camera_names:
            images = self._frames[name][part]
            places = [i for i, image in enumerate(images) if image is not None]
            rendered[name] = np.array(places, np.int64)
            views[name] = np.zeros((0, 1, 1, 3), np.uint8)
            if places:
                views[name] = np.stack([images[i] for i in places])
        return views, rendered

    # Decide and act

    def set_actions(self, actions: np.ndarray) -> None:
        """Note the actions [n, w] that are sent to the environment."""
        self._sent = actions
        self.chunks += 1

    # Record

    @property
    def unobserved(self) -> int:
        """Frames of the environment that events withheld so far; below 0 where they
        repeated some.
        """
        return self._simulated - len(self._visible)

    @property
    def seconds(self) -> Seconds:
        """Where the time went so far."""
        return Seconds(
            sim=round(self._sim, 3),
            render=round(self._render, 3),
            policy=round(self.policy_s, 3),
            total=round(time.perf_counter() - self._begun, 3),
        )

    @property
    def actions_sha256(self) -> str:
        """A digest of all executed actions, to the last bit."""
        return self._actions.hexdigest()[:16]


EVERY = range(2**31)  # Whatever frames there are
LONGEST_MOTION = 500  # frames by which the last motion of an episode may exceed its step limit
LONGEST_VIDEO = 2_000  # frames; what is missing of a longer one is rendered by a second reset


class RenderPlan:
    """The images to render for each command to an environment: those that the policy and its
    predictor read; None requests everything.

    When a policy acts, and so what its memory reads, is known before the episode, but for the
    length of the conditioning video. Where images of it turn out to be needed, the episode begins
    once more, and the same simulation then renders them.

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
        """For a reset, before it is known how long the video is."""
        if self._all:
            return None
        if self._sees_video or self._resampled:
            return self._render_request(EVERY)
        return self._render_request(self._read_of_videos)

    def missing(self, frames: Observation) -> RenderRequest | None:
        """For a second reset, if one that gave these frames left out some that are needed."""
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
        """Frames that the policy may read of any video; none where that may be most of them."""
        read = self._read_before(np.arange(LONGEST_VIDEO), LONGEST_VIDEO)
        if read is None or len(read) >= LONGEST_VIDEO / 2:
            return frozenset()
        return frozenset(read.tolist())

    def _read_before(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """Frames that the policy reads at any of these steps, beside the current one."""
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
