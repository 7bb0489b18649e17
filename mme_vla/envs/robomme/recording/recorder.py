"""Demonstrates a task and records every stored step, with the fields of the official files."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from mme_vla.embodiment.robomme import ARM_JOINTS, CAMERAS, POSE
from mme_vla.envs.facts import Fact, TaskFacts
from mme_vla.envs.grounding import Grounding, project
from mme_vla.envs.observations import AngleTrack, Include, Observer, RenderRequest
from mme_vla.envs.robomme.robot.control import PlanningError
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.robot.gripper_skills import DOWNWARD_Q
from mme_vla.envs.subtasks import COMPLETED, NO_RECORD

if TYPE_CHECKING:
    import sapien

    from mme_vla.envs.subtasks import SubTask
    from mme_vla.envs.task import Task


def demonstrate(
    env: "Task", demonstrator: Demonstrator, subtasks: Sequence["SubTask"] | None = None
) -> bool:
    """Perform the sub-tasks of a task that has just been reset, evaluated `as_recorded`; whether it
    succeeded.

    The task is evaluated before and after each sub-task; `env.progress.planned` moves at these
    evaluations only. In a recovery demonstration the sampled pick of the execution fails once
    first.

    Args:
        subtasks: by default all of the task's.

    Raises:
        PlanningError: a motion could not be planned.
    """
    subtasks = env.progress.subtasks if subtasks is None else subtasks
    picks = [subtask for subtask in subtasks if subtask.pick and not subtask.video]
    with env.as_recorded():
        ended = _ended(env)
        for subtask in subtasks:
            if ended or _ended(env):
                break
            if env.recovery and env.failed_pick is not None and subtask in picks:
                demonstrator.fail_next_pick = None
                if picks.index(subtask) == env.failed_pick:
                    demonstrator.fail_next_pick = env.recovery
            subtask.run(demonstrator)
            ended = _ended(env)
    return env.success() and not env.progress.failed


def _ended(env: "Task") -> bool:
    """Evaluate once; whether the episode is over."""
    env.evaluate_planned()
    return env.progress.succeeded or env.progress.failed


MAX_STEPS = 2000
"""Control steps after which a recording is given up, as in the benchmark."""
MAX_STEPS_OOD = 4000
"""The same for the longer scenes of RoboMME-OOD."""
SEAM = 5e-8  # rad
AT_REST = 1e-5  # rad
GRIPPER_CLOSED = 0.03
"""Finger position below which the gripper counts as closed, metres."""


class TooLongError(RuntimeError):
    """A demonstration took more control steps than `MAX_STEPS`, or `MAX_STEPS_OOD`."""


@dataclass(frozen=True)
class RecordedStep:
    """One stored time step with the keys of the official files; the observation was made after the
    action.
    """

    obs: dict[str, Any]
    action: dict[str, Any]
    info: dict[str, Any]


@dataclass
class Recording:
    """The result of one demonstration."""

    success: bool
    steps: int
    """Control steps, stored or not."""
    stored: int = 0
    video: int = 0
    """Stored steps of the conditioning video."""
    error: str | None = None
    """Why the demonstration ended early, if it did."""
    frames: list[RecordedStep] = field(default_factory=list)
    """Empty where a callback took the steps."""
    facts: Sequence[Fact] = ()
    """Of the stored steps, which count as frames."""


class Recorder:
    """Demonstrates a task and records its steps, except those of sub-tasks without a text
    (`NO_RECORD`).

    Args:
        task: created with the observation mode `none`.
        render: take images; without them frames hold states, actions and plain texts only.
        render_request: which stored steps, counted from 0, are rendered by which cameras; by
            default all. Where a text needs a pixel, the front camera renders in any case.
        on_step: takes each stored step; by default they are collected in `Recording.frames`.
    """

    def __init__(
        self,
        task: "Task",
        render: bool = True,
        on_step: Callable[[RecordedStep], None] | None = None,
        render_request: RenderRequest | None = None,
    ) -> None:
        self._task = task
        self._render = render
        self._on_step = on_step
        self._render_request = render_request

    def record(self) -> Recording:
        """Reset the task and demonstrate it once."""
        task = self._task
        task.reset()
        include = Include(
            front_depth=self._render,
            wrist_depth=self._render,
            front_camera_extrinsic=True,
            wrist_camera_extrinsic=True,
        )
        self._observer = Observer(task, include, self._render)
        self._planned = Grounding(retry=False)
        # unlike a running environment's, a file's text is made once
        self._online = Grounding(retry=False)
        self._action_angles = AngleTrack()
        self._roll_shift: float | None = None
        self._waypoint: np.ndarray | None = None
        self._in_video: bool | None = None
        self._last_stored: str | int | None = None
        self._result = Recording(success=False, steps=0)
        self._facts = TaskFacts(task)
        self._demonstrator = Demonstrator(task, self._step, self._note_waypoint)
        task.on_frame = self._on_frame
        try:
            self._result.success = demonstrate(task, self._demonstrator)
        except (PlanningError, TooLongError) as error:
            self._result.error = str(error) or type(error).__name__
        finally:
            task.on_frame = None
        self._result.facts = self._facts.facts
        return self._result

    def _step(self, action: np.ndarray) -> None:
        limit = MAX_STEPS_OOD if self._task.tier else MAX_STEPS
        if self._result.steps >= limit:
            raise TooLongError(f"not done after {limit} control steps")
        self._action = np.asarray(action, np.float64)
        # the text is set before the evaluation moves the pointer
        self._displayed = self._task.progress.displayed
        self._task.step(np.asarray(action, np.float32))
        self._result.steps += 1

    def _note_waypoint(self, pose: "sapien.Pose", gripper: float) -> None:
        self._enter_phase()
        angles = AngleTrack().follow(pose.q)
        # Straight down is half a turn either way, which rounding would decide.
        if np.array_equal(pose.q, DOWNWARD_Q):  # as over buttons
            angles[0] = -np.pi
        else:
            angles = np.where(np.abs(angles + np.pi) < SEAM, np.pi, angles)
        self._waypoint = np.concatenate([pose.p, angles, [gripper]]).astype(np.float64)

    def _on_frame(self, evaluated: dict[str, Any]) -> None:
        self._observer.follow()
        progress = self._task.progress
        planned = progress.demonstrated
        self._enter_phase()
        if planned.text == NO_RECORD:
            return
        cameras: tuple[str, ...] = CAMERAS
        if self._render_request is not None:
            cameras = self._render_request.cameras(self._result.stored, newest=False)
        frame = self._observer.frame(evaluated, cameras)
        frame = {name: value for name, value in frame.items() if value is not None}
        frame["eef_state"] = frame["eef_state"].astype(np.float32)
        closed = self._task.stick or bool((frame["gripper_state"] < GRIPPER_CLOSED).any())
        frame["is_gripper_close"] = closed
        step = RecordedStep(frame, self._actions(planned), self._texts(planned))
        self._result.stored += 1
        self._result.video += planned.video
        self._facts.add(planned.video)
        if self._on_step is None:
            self._result.frames.append(step)
        else:
            self._on_step(step)

    def _enter_phase(self) -> None:
        """Drop the video's waypoint where the execution begins: at its first step, or at a waypoint
        before that.
        """
        video = self._task.progress.demonstrated.video
        if self._in_video is not None and video != self._in_video:
            self._waypoint = None
        self._in_video = video

    def _actions(self, planned: "SubTask") -> dict[str, Any]:
        action = self._action
        pose = self._demonstrator.arm.forward(action[:ARM_JOINTS])
        gripper = -1.0
        if not self._task.stick:
            gripper = float(action[ARM_JOINTS])
        angles = self._action_angles.follow(pose.q)
        if self._roll_shift is None:
            self._roll_shift = 0.0
            if abs(angles[0] + np.pi) < AT_REST:
                # a gripper begins straight down, which the official files have at +pi
                self._roll_shift = 2 * np.pi
        angles[0] += self._roll_shift
        waypoint = self._waypoint
        if waypoint is None:
            waypoint = np.full(len(POSE) + 1, np.nan, np.float32)
        point: list[int] = []
        if planned.choice and planned.targets:
            pixel = project(planned.targets[0].position)
            point = [round(float(coordinate)) for coordinate in pixel]
        return {
            "joint_action": np.append(action[:ARM_JOINTS], gripper),
            "eef_action": np.concatenate([pose.p, angles, [gripper]]).astype(np.float64),
            "waypoint_action": waypoint,
            "choice_action": json.dumps({"choice": planned.choice.upper(), "point": point}),
        }

    def _texts(self, planned: "SubTask") -> dict[str, Any]:
        completed = self._task.progress.succeeded
        text = planned.text
        now: str | int = self._task.progress.planned
        if completed:
            text = COMPLETED
            now = "completed"
        boundary = now != self._last_stored
        self._last_stored = now
        segmentation = None
        if self._render:
            segmentation = self._observer.segmentation
        displayed = self._displayed
        return {
            "simple_subgoal": text,
            "grounded_subgoal": self._planned.update(planned, segmentation),
            "simple_subgoal_online": displayed.text,
            "grounded_subgoal_online": self._online.update(displayed, segmentation),
            "is_video_demo": planned.video,
            "is_subgoal_boundary": boundary,
            "is_completed": completed,
        }
