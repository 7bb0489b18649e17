"""The environment's side of a rollout, in a worker process: executes whole chunks and hands back
every frame.

Its frames come in the form the policy reads. What the benchmark's interface says in dictionaries
becomes a `Report`.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.embodiment.robomme import (
    CAMERAS,
    SIDE,
    benchmark_action,
    benchmark_state,
    choice_action,
)
from mme_vla.envs.base import OPTIONS, EpisodeEnv, Hold, environment, open_episode
from mme_vla.envs.make import ROBOMME, make_env
from mme_vla.envs.metadata import DEFAULT_STEPS, STICK_TASKS
from mme_vla.envs.observations import Include, RenderRequest
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT
from mme_vla.envs.subtasks import Progress, process_score
from mme_vla.errors import require
from mme_vla.evaluation.rollout.video import EpisodeVideo
from mme_vla.registry import TASKS

SUBGOAL = "simple_subgoal_online"
REPORTED = (
    "status", "task_goal", SUBGOAL, "grounded_subgoal_online", "error_message", "exception_type",
    OPTIONS,
)  # fmt: skip
"""What is passed on of the environment's info, in `Report.info`."""
_BLIND = np.zeros((SIDE, SIDE, 3), np.uint8)

Observation = dict[str, Any]
"""Every camera by its name: lists of uint8 [H, W, 3], or None where a frame was not requested;
`state`: float32 [t, s].

The robot's `readings`, if it has any, are lists of all frames.
"""


def is_out_of_reach(observation: Mapping[str, Any] | None, info: Mapping[str, Any]) -> bool:
    """Whether an environment's `error` is of the policy, whose target no motion reaches."""
    return observation == {} or info.get("exception_type") == "PlanningError"


@dataclass(frozen=True)
class ChunkCommand:
    """What an environment executes next.

    actions: [n, w], executed one after the other; None with `hold`.
    hold: control steps for which the robot stays where it is.
    subgoal: text in the video meanwhile.
    images: those that are requested, by default all. Frames are counted from the reset on, and the
        newest is the last.
    """

    actions: np.ndarray | None = None
    hold: int = 0
    subgoal: str | None = None
    images: RenderRequest | None = None


@dataclass(frozen=True)
class Report:
    """What an environment reports of a reset or of a command, beside its frames.

    status: `ongoing`, `success`, `fail`, `timeout` or `error`; None of an environment that gives
        none.
    goal: the instruction; None if the environment named none yet.
    error: why the episode failed, where the environment reports it.
    info: what the environment itself sends, for subgoal predictors.
    options: of a robot that chooses, what there is to choose.
    scene: digest of the scene.
    executed: actions.
    frames: what these took, one each unless an action is a motion.
    held: the action [w] that keeps the robot where it is after a command to hold it; None before
        the first action.
    subtask: number of the execution's current sub-task from 1; 0 where the environment has none.
    began: frames at which sub-tasks began.
    process: where the chain of sub-tasks broke, once the episode is over.
    oracle: the action [w] that the task's script takes next, if it was requested.
    video: name of the finished video's file.
    simulated_s, rendered_s: seconds since the last report.
    """

    status: str | None = None
    goal: str | None = None
    error: str | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    options: Sequence[Mapping[str, Any]] | None = None
    scene: str = NOT_BUILT
    executed: int = 0
    frames: int = 0
    held: np.ndarray | None = None
    subtask: int = 0
    began: Sequence[int] = ()
    process: dict[str, Any] | None = None
    oracle: np.ndarray | None = None
    video: str | None = None
    simulated_s: float = 0.0
    rendered_s: float = 0.0


class ChunkEnv:
    """One episode that takes chunks of actions.

    Args:
        make: builds an environment with the benchmark's interface.
        stick: its robot holds a stick, and takes no command of the gripper, which is an action's
            last number.
        max_steps: actions after which the outcome is `timeout`, should the environment itself not
            say so: one more than this is executed, as in the benchmark.
        video: records the episode.
        robot: the cameras that are read and the width of an action.
        max_actions: actions that are executed at most, whatever frames they took; then the outcome
            is `timeout`.
        oracle: whether reports name the action [w] that the task's script takes next (`oracle`).
    """

    def __init__(
        self,
        make: Callable[[], Any],
        stick: bool = False,
        max_steps: int = DEFAULT_STEPS,
        video: EpisodeVideo | None = None,
        robot: Embodiment = ROBOMME_JOINT,
        max_actions: int | None = None,
        oracle: bool = False,
    ) -> None:
        self._robot = robot
        self._stick = stick
        self._oracle = oracle
        self._max_actions = max_actions
        self._max_steps = max_steps
        self._video = video
        self._simulating = self._rendered = 0.0  # seconds since the last report; images in both
        self._executed = 0  # actions
        self._steps = 0
        self._returned = 0  # frames
        self._pose: np.ndarray | None = None
        self._last: np.ndarray | None = None
        self._subgoal = ""
        self._n_subgoals = 0
        self._goal: str | None = None
        self._scene = NOT_BUILT
        with self._simulation():
            self._env = make()
        # Time the images, where the simulator's scene is within reach: in the official package they
        # are part of the simulation.
        scene = getattr(getattr(self._env, "task", None), "scene", None)
        if isinstance(self._env, EpisodeEnv):
            self._env.render_image = self._timed(self._env.render_image)  # type: ignore[method-assign]
        elif scene is not None:
            scene.update_render = self._timed(scene.update_render)
            for sensor in scene.sensors.values():
                sensor.capture = self._timed(sensor.capture)
                sensor.get_obs = self._timed(sensor.get_obs)

    def reset(self, images: RenderRequest | None = None) -> tuple[Observation, Report]:
        """All frames of the conditioning video, the current one last, and the report.

        images: those that are requested, by default all.
        """
        self._request_images(images)
        with self._simulation():
            observation, info = self._env.reset()
        frames = Frames(self._robot)
        count = frames.add(observation)
        self._note_pose(observation)
        self._note_info(info)
        if self._video is not None:
            for number, views in enumerate(frames.newest(count), 1):
                caption = f"conditioning video, frame {number} of {count - 1}"
                if number == count:
                    caption = "step 0"
                self._video.add(views, self._goal, caption, demo=number < count)
        self._returned = frames.blank_unrequested(images, 0)
        # Environments of other packages do not know their scene.
        self._scene = getattr(self._env, "scene_digest", NO_VALUES)
        return frames.observation(), self._report(info)

    def step(self, command: ChunkCommand) -> tuple[Observation, float, bool, bool, Report]:
        """Execute actions one after the other until they, or the episode, are over.

        Returns:
            The frames of the executed actions, the sum of their rewards, terminated, truncated, and
            the report. After `hold` no action counts as executed.
        """
        actions: list[Any] = [Hold(command.hold)]
        if not command.hold:
            actions = list(np.asarray(command.actions))
        self._max_steps += command.hold
        frames = Frames(self._robot)
        info: Mapping[str, Any] = {}
        executed_before = self._executed
        total_reward = 0.0
        terminated = truncated = False
        for number, action in enumerate(actions, 1):
            images = command.images
            if images is not None and number < len(actions):
                # Only the chunk's last frame is the newest when the policy reads it.
                images = replace(images, now=())
            self._request_images(images)
            reward, terminated, truncated, info = self._execute(action, frames, command.subgoal)
            total_reward += reward
            if terminated or truncated:
                break
        self._returned = frames.blank_unrequested(command.images, self._returned)
        observation = frames.observation()
        report = replace(
            self._report(info),
            executed=self._executed - executed_before,
            frames=len(observation["state"]),
        )
        if command.hold:
            report = replace(report, held=self._hold_action())
        if (terminated or truncated) and self._video is not None:
            path = self._video.finish(str(report.status), report.goal or "")
            if path is not None:
                report = replace(report, video=path.name)
        return observation, total_reward, terminated, truncated, report

    def _execute(
        self, action: "np.ndarray | Hold", frames: "Frames", subgoal: str | None
    ) -> tuple[float, bool, bool, Mapping[str, Any]]:
        """Execute one action, and add its frames; what a Gymnasium step returns after them."""
        command: Any = action
        if not isinstance(action, Hold):
            self._last = action
            command = benchmark_action(self._robot.action, action, self._stick, self._pose)
        with self._simulation():
            observation, reward, terminated, truncated, info = self._env.step(command)
        self._note_info(info)
        if info.get("status") == "error":
            if is_out_of_reach(observation, info):
                info = {**info, "status": "fail"}
            return float(reward), True, bool(truncated), info
        if not isinstance(action, Hold):
            self._executed += 1
        n_frames = frames.add(observation)
        self._note_pose(observation)
        # A choice that moves nothing takes time too, or it could continue for ever.
        self._steps += max(n_frames, 1)
        is_last = self._executed == self._max_actions or self._steps > self._max_steps
        if is_last and not (terminated or truncated):
            truncated = True
            info = {**info, "status": "timeout"}
        outcome = None
        if terminated or truncated:
            outcome = str(info.get("status"))
        self._add_to_video(frames, n_frames, subgoal, outcome)
        return float(reward), bool(terminated), bool(truncated), info

    def _add_to_video(
        self, frames: "Frames", count: int, subgoal: str | None, outcome: str | None
    ) -> None:
        if self._video is None:
            return
        for step, views in enumerate(frames.newest(count), self._steps - count + 1):
            parts = [f"step {step}", subgoal]
            if step == self._steps:
                parts.append(outcome)
            self._video.add(views, self._goal, " · ".join(part for part in parts if part))

    def close(self) -> None:
        """Free the simulator; an unfinished video is removed."""
        if self._video is not None:
            self._video.discard()
        self._env.close()

    def _hold_action(self) -> np.ndarray | None:
        """The policy's action that keeps the robot where it is."""
        if hasattr(self._env, "hold_action"):
            return np.asarray(self._env.hold_action, np.float32)
        if self._last is None:
            return None
        row = self._last.copy()
        row[list(self._robot.action.of_pose)] = 0
        return row

    def _note_info(self, info: Mapping[str, Any]) -> None:
        """Note the goal, and count the sub-tasks of an environment that only names them."""
        if goals := info.get("task_goal"):
            self._goal = str(goals[0])
        text = info.get(SUBGOAL) or self._subgoal
        self._n_subgoals += text != self._subgoal
        self._subgoal = text

    def _note_pose(self, observation: dict[str, list[Any]]) -> None:
        if not self._robot.action.of_pose:
            return
        _require(
            observation,
            "eef_state",
            f"The policy's actions are differences to 'eef_state', {MISSING}",
        )
        if poses := observation["eef_state_list"]:
            self._pose = np.asarray(poses[-1], np.float64)

    def _request_images(self, request: RenderRequest | None) -> None:
        # A video shows everything; and not every environment can leave images out.
        if self._video is None and hasattr(self._env, "render_request"):
            self._env.render_request = request

    @contextmanager
    def _simulation(self) -> Iterator[None]:
        begun = time.perf_counter()
        try:
            yield
        finally:
            self._simulating += time.perf_counter() - begun

    def _timed(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """A call that renders, within the simulation."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            begun = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                self._rendered += time.perf_counter() - begun

        return timed

    def _report(self, info: Mapping[str, Any]) -> Report:
        status = info.get("status")
        subtask = self._n_subgoals
        process = None
        progress = getattr(getattr(self._env, "task", None), "progress", None)
        if isinstance(progress, Progress):
            score = process_score(progress, str(status))
            if status != "ongoing":
                process = score.to_dict()
            subtask = min(score.done + 1, score.of)
        oracle = None
        if self._oracle and status == "ongoing" and (choice := self._env.oracle()) is not None:
            oracle = choice_action(self._robot.action, choice)
        report = Report(
            status=status,
            goal=self._goal,
            error=info.get("error_message"),
            info={key: info[key] for key in REPORTED if key in info},
            options=info.get(OPTIONS),
            scene=self._scene,
            subtask=subtask,
            began=getattr(self._env, "began", None) or (),
            process=process,
            oracle=oracle,
            simulated_s=self._simulating - self._rendered,
            rendered_s=self._rendered,
        )
        self._simulating = self._rendered = 0.0
        return report


MISSING = "which this environment does not deliver"


def _require(observation: Mapping[str, list[Any]], name: str, message: str) -> None:
    require(
        f"{name}_list" in observation,
        f"{message}; there are only {', '.join(sorted(observation))}.",
    )


class Frames:
    """Collects frames in the policy's form; the benchmark's own cameras too, for the video."""

    def __init__(self, robot: Embodiment) -> None:
        self._cameras = robot.camera_names
        self._width = robot.state.width
        # the benchmark's videos show both of its cameras
        beside = CAMERAS if robot.action.space else ()
        self._images: dict[str, list[np.ndarray | None]] = {
            name: [] for name in (*self._cameras, *beside)
        }
        self._readings: dict[str, list[np.ndarray]] = {name: [] for name in robot.readings}
        self._states: list[np.ndarray] = []

    def add(self, observation: Mapping[str, list[Any]]) -> int:
        """Take the benchmark's lists; return how many frames they hold."""
        if "state_list" in observation:  # an environment of the user's own
            states = observation["state_list"]
        else:
            joints = observation["joint_state_list"]
            fingers = observation["gripper_state_list"]
            states = [benchmark_state(q, f) for q, f in zip(joints, fingers, strict=True)]
        self._states += states
        blind = not any(key.endswith("_rgb_list") for key in observation)  # it does not render
        for name, images in self._images.items():
            if not blind and name in self._cameras:
                _require(observation, f"{name}_rgb", f"The environment has no camera {name!r}")
            images += observation.get(f"{name}_rgb_list", [_BLIND] * len(states))
        for name, readings in self._readings.items():
            _require(observation, name, f"The policy reads {name!r}, {MISSING}")
            readings += observation[f"{name}_list"]
        return len(states)

    def blank_unrequested(self, request: RenderRequest | None, first: int) -> int:
        """Leave out the images that were not requested.

        first: the number of the first frame.

        Returns:
            The number that follows the last one's.
        """
        stop = first + len(self._states)
        if request is not None:
            for frame in range(first, stop):
                cameras = request.cameras(frame, newest=frame == stop - 1)
                for name in self._cameras:
                    if name not in cameras:
                        self._images[name][frame - first] = None
        return stop

    def newest(self, count: int) -> Iterator[tuple[Any, ...]]:
        """The last frames, each as its images: the robot's cameras, then the benchmark's."""
        first = len(self._states) - count
        return zip(*(images[first:] for images in self._images.values()), strict=True)

    def observation(self) -> Observation:
        state = np.zeros((0, self._width), np.float32)
        if self._states:
            state = np.stack(self._states)
        return {
            **{name: self._images[name] for name in self._cameras},
            **self._readings,
            "state": state,
        }


@dataclass(frozen=True)
class EpisodeFactory:
    """Makes the environment of an episode, in the worker process that runs it: called with `task`,
    `split` and `episode`.

    robot: the policy's.
    env: name of the environment; `reward` and `only_possible` have an effect on RoboMME alone.
    base: makes the environment itself in place of `open`, from `task`, `split`, `episode` and
        `max_steps`; importable by name.
    options: further arguments of what makes it.
    max_steps, max_actions, oracle: see `ChunkEnv`; or a function that gives the steps for a task.
    videos: folder, and which outcomes are kept: `none`, `all`, `success` or `failure`.
    run: its name, in the videos.

    Raises:
        UserError: the environment does not take this robot.
    """

    robot: Embodiment = ROBOMME_JOINT
    env: str = ROBOMME
    base: Callable[..., Any] = make_env
    options: Mapping[str, Any] = field(default_factory=dict)
    render: bool = True
    reward: str = "none"
    only_possible: bool = False
    max_steps: int | Callable[[str], int] = DEFAULT_STEPS
    max_actions: int | None = None
    oracle: bool = False
    videos: tuple[str, str] = ("", "none")
    run: str = ""

    def __post_init__(self) -> None:
        if self.base is make_env:
            environment(self.env).check_embodiment(self.robot)

    def __call__(self, task: str, split: str, episode: int) -> ChunkEnv:
        video = None
        folder, save_on = self.videos
        if save_on != "none":
            video = EpisodeVideo(Path(folder), f"{task}_ep{episode}", save_on, self.run)
        stick = task in STICK_TASKS
        if task in TASKS:  # once its module is imported
            stick = stick or bool(getattr(TASKS[task], "stick", False))
        limit = self.max_steps
        if not isinstance(limit, int):
            limit = limit(task)
        return ChunkEnv(
            partial(self.open, task, split, episode, limit),
            stick=stick,
            max_steps=limit,
            video=video,
            robot=self.robot,
            max_actions=self.max_actions,
            oracle=self.oracle,
        )

    def open(self, task: str, split: str, episode: int, max_steps: int, **options: Any) -> Any:
        """The environment itself, which takes single actions: a `RoboMMEEnv`, of other environments
        an `EpisodeEnv`.

        options: beside `options` of the factory, such as a twin's `row`.
        """
        arguments: dict[str, Any] = {**self.options, **options}
        arguments |= {"task": task, "split": split, "episode": episode, "max_steps": max_steps}
        if self.base is not make_env:
            return self.base(**arguments)
        arguments = {"action_space": self.robot.action.space, "render": self.render, **arguments}
        if self.env != ROBOMME:
            return open_episode(self.env, **arguments)
        readings = dict.fromkeys(self.robot.readings, True)
        include = Include(**readings, possible=self.only_possible)
        return make_env(**{"reward": self.reward, "include": include, **arguments})
