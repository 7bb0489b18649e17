"""The environment of one episode: official observation lists, info keys and statuses around one
simulated task.

`reset` simulates the conditioning video and returns all of its frames followed by the present one.
`step` returns one frame, or all frames of the motion in the action spaces that plan. Images appear
only when the environment renders.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch

from mme_vla.embodiment.robomme import CAMERAS
from mme_vla.envs.base import CLOSED, Hold
from mme_vla.envs.facts import Candidates, Fact, TaskFacts
from mme_vla.envs.grounding import Grounding
from mme_vla.envs.metadata import DEFAULT_STEPS
from mme_vla.envs.observations import (
    INTRINSIC,
    Include,
    Observer,
    RenderRequest,
    as_lists,
    frame_keys,
)
from mme_vla.envs.oracle import OracleStuckError, oracle_choice
from mme_vla.envs.robomme.robot.control import PlanningError
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.scene_hash import NOT_BUILT, scene_digest
from mme_vla.envs.spaces import SPACES, UnreachableError
from mme_vla.envs.subtasks import NO_RECORD
from mme_vla.errors import UserError, check_known, listed, require
from mme_vla.registry import REWARDS

if TYPE_CHECKING:
    from mme_vla.envs.subtasks import SubTask
    from mme_vla.envs.task import Task

log = logging.getLogger(__name__)

FrameHook = Callable[[dict[str, Any], dict[str, Any], bool], None]
"""Called with each returned frame, its info, and whether it belongs to the conditioning video."""
_REACH = 1.2  # metres from the arm's base; what was moved away lies ten metres off
_MARGIN = 2  # The benchmark counts two steps more than its limit.


@dataclass(frozen=True)
class EpisodeState:
    """The state of an episode as its scene and its actions: a replay restores it, to the last bit
    on one CPU type.

    Positions and velocities are not enough: contacts, the solver's last solution and the script's
    variables belong to the state as well. A replay without images takes about two milliseconds a
    control step. Can be pickled.

    environment: what makes the scene, the action space and the limit, by name.
    actions: all that were given to `step` since the reset.
    """

    environment: Mapping[str, Any]
    actions: Sequence[Any]


@dataclass
class _Run:
    """One episode under way."""

    demonstrator: Demonstrator
    observer: Observer
    facts: TaskFacts
    displayed: "SubTask"
    """Whose text describes the present frame."""
    last_action: np.ndarray
    in_video: bool = True
    grounding: Grounding = field(default_factory=Grounding)
    frames: list[dict[str, Any]] = field(default_factory=list)
    """Those that the present call returns."""
    newest: dict[str, Any] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    returned: int = 0
    """Frames returned since the reset."""
    count: int = 0
    """Control steps that count towards the limit."""
    hold_steps: int = 0
    """Control steps for which the robot was told to hold its pose, by which the limit grows."""
    total_reward: float = 0.0
    actions: list[Any] = field(default_factory=list)
    """All since the reset."""
    subgoal_text: str = ""
    began: list[int] = field(default_factory=list)
    """Frames at which the sub-task's text changed."""
    terminated: torch.Tensor = field(default_factory=lambda: torch.tensor(False))
    truncated: torch.Tensor = field(default_factory=lambda: torch.tensor(False))


class RoboMMEEnv(gymnasium.Env):
    """One episode's environment with the official interface.

    `step` does not raise: a malformed action, an unreachable pose or a simulator error
    ends the episode with `info["status"] == "error"`. After the end of an episode further steps are
    simulated as the benchmark does, so that recorded action sequences can be replayed to their last
    action.

    Args:
        task: the simulated task, created with the observation mode `none` (or, for `maniskill_obs`,
            another).
        action: name of the action space.
        max_steps: control steps after which the status becomes `timeout`; the video's steps do not
            count.
        include: what observations and infos hold beyond the standard keys.
        render: whether there are images.
        reward: `none`, as in the benchmark, `sparse`, `subtask` (`mme_vla.envs.subtasks`), or your
            own in `REWARDS`.

    Attributes:
        on_frame: called with every frame that is returned, for recording.
        render_request: which frames have images, from the next call on; None for all. The others'
            are None.
        scene_digest: of the values and places of the scene, from the reset on
            (`mme_vla.envs.scene_hash`).
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        task: "Task",
        action: str = "joint_angle",
        max_steps: int = DEFAULT_STEPS,
        include: Include | None = None,
        render: bool = True,
        reward: str = "none",
    ) -> None:
        is_count = type(max_steps) is int and max_steps >= 1
        require(is_count, f"max_steps is {max_steps!r}; expected a positive integer.")
        check_known("action space", action, SPACES)
        self._space = SPACES[action]
        self._total_reward = REWARDS[reward]
        self.include = include or Include()
        self.max_steps = max_steps
        self.on_frame: FrameHook | None = None
        self.render_request: RenderRequest | None = None
        self.render_mode = "rgb_array" if render else None
        self.action_space = self._space.space(task.stick)
        self._keys = frame_keys(self.include, render)
        self._render = render
        self._task: Task | None = task
        self._muted = True
        task.on_frame = self._on_frame
        self._run: _Run | None = None
        self.scene_digest = NOT_BUILT

    # Episodes -------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, list[Any]], dict[str, Any]]:
        """Begin the episode anew; the same scene and script every time.

        Args:
            seed: without effect on the scene, which the environment's own seed fixes.
            options: there are none.

        Returns:
            Observation lists (conditioning video, then the present frame) and the info of the
            present frame.
        """
        task = self.task
        require(not options, f"Unknown reset options {listed(options or ())}; there are none.")
        super().reset(seed=seed)
        # Leftovers of an episode, in the solver and in what the script added, go only with the
        # scene.
        self._muted = True
        task.reset(options={"reconfigure": self._run is not None})
        self._muted = False
        self.scene_digest = scene_digest(task.placed_values())
        run = self._run = _Run(
            Demonstrator(task, self._step_control),
            Observer(task, self.include, self._render),
            TaskFacts(task),
            task.progress.displayed,
            task.reset_action,
        )
        # The video is the recorded one, whose texts change when its drops were noticed.
        with task.as_recorded():
            for subtask in task.progress.subtasks:
                if subtask.video:
                    # Evaluated before and after it, as at recording.
                    task.evaluate_planned()
                    try:
                        subtask.run(run.demonstrator)
                    except PlanningError as error:  # the rest of the video follows, as officially
                        log.info("conditioning video: %r failed: %s", subtask.text, error)
                    task.evaluate_planned()
        run.in_video = False
        task.unrecorded_steps = 1
        self._step_control(task.start_action)
        return as_lists(run.frames, self._keys), dict(run.info)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Perform one action.

        Args:
            action: as the action space describes it, or a `Hold`.

        Returns:
            Observation lists, reward, terminated, truncated (0-d tensors) and the info of the last
            frame. After an exception `(None, 0.0, True, False, info)` with the status `error`;
            after failed inverse kinematics the observation is `{}`.
        """
        run = self._require_run()
        run.frames = []
        run.actions.append(deepcopy(action))
        try:
            if isinstance(action, Hold):
                self._hold(run, action.steps)
            else:
                self._space.act(run.demonstrator, action)
            before = run.total_reward
            run.total_reward = self._total_reward(
                self.task.progress, bool(run.info.get("success", False))
            )
            reward = torch.tensor(run.total_reward - before)
            if run.frames and run.terminated:
                # Repeat the last action once without a frame, as the benchmark does at the end of
                # an episode.
                self._muted = True
                self.task.step(run.last_action)
        except UnreachableError as error:
            return {}, 0.0, True, False, {"status": "error", "error_message": str(error)}
        except Exception as error:  # the official contract: whatever goes wrong is a status
            log.debug("step failed", exc_info=True)
            kind = type(error).__name__
            info = {
                "status": "error",
                "error_message": str(error) or f"{kind}, without a text",
                "exception_type": kind,
            }
            return None, 0.0, True, False, info
        finally:
            self._muted = False
        observation = as_lists(run.frames, self._keys)
        return observation, reward, run.terminated, run.truncated, dict(run.info)

    def save_state(self) -> EpisodeState:
        """The state of the running episode, for `restore_state`; costs next to nothing."""
        run = self._require_run()
        return EpisodeState(self._described(), tuple(run.actions))

    def _described(self) -> dict[str, Any]:
        """What an environment must have in common with another one to continue its episodes."""
        task = self.task
        return {
            "task": type(task).__name__,
            "seed": task.seed,
            "difficulty": task.difficulty,
            "recovery": task.recovery,
            "in_view": task.in_view,
            "stress": task.stress,
            "row": task.row,
            "action_space": self._space.name,
            "max_steps": self.max_steps,
        }

    def restore_state(self, state: EpisodeState) -> tuple[Any, dict[str, Any]]:
        """Continue from a saved state of the same episode, which may come from another environment
        or process.

        Replays the episode. Renders only the newest frame and those whose pixels a text needs;
        `on_frame` is not called.

        Returns:
            Observation lists and info, as the last `reset` or `step` before `save_state` returned
            them, images of the newest frame alone.
        """
        differences = []
        for name, present in self._described().items():
            value = state.environment[name]
            if value != present:
                differences.append(f"{name} {value!r} (here {present!r})")
        require(
            not differences,
            f"This state is of another environment: {', '.join(differences)}. Make one of the same"
            " episode.",
        )
        hook = self.on_frame
        request = self.render_request
        grounded = request is None or request.grounded
        hidden = RenderRequest({}, now=(), grounded=grounded)
        newest = RenderRequest({}, grounded=grounded)
        self.on_frame = None
        try:
            # The newest frame is the last action's, without one the reset's.
            self.render_request = hidden if state.actions else newest
            observation, info = self.reset()
            for number, action in enumerate(state.actions, start=1):
                self.render_request = hidden if number < len(state.actions) else newest
                observation, _, _, _, info = self.step(action)
        finally:
            self.on_frame = hook
            self.render_request = request
        return observation, info

    def render(self) -> np.ndarray | None:
        """The newest front image [256, 256, 3]; None if it was not rendered, or before the first
        reset.
        """
        require(self._task is not None, CLOSED)
        return None if self._run is None else self._run.newest.get("front_rgb")

    def close(self) -> None:
        """Free the simulator; closing twice is harmless."""
        if self._task is not None:
            self._task.close()
            self._task = self._run = None

    @property
    def task(self) -> "Task":
        """The simulated task."""
        if self._task is None:
            raise UserError(CLOSED)
        return self._task

    @property
    def difficulty(self) -> str:
        """`easy`, `medium` or `hard`, or the tier of RoboMME-OOD; read by the released evaluation
        script.
        """
        return self.task.tier or self.task.difficulty

    def scene_values(self) -> dict[str, Any]:
        """The row of this scene, plain values; `make_env(…, row=row)` or a line of a JSONL file
        builds it again.

        What is sampled when an episode begins belongs to it, so call it after `reset`.
        """
        return self.task.scene_values()

    @property
    def began(self) -> list[int]:
        """Frames, counted from the reset and the video's first, at which another sub-task's text
        began.
        """
        return [] if self._run is None else list(self._run.began)

    @property
    def facts(self) -> Sequence[Fact]:
        """What the frames since the reset showed, the video's first."""
        return () if self._run is None else tuple(self._run.facts.facts)

    @property
    def candidates(self) -> Candidates | None:
        """What the next motion can go to, where a decision depends on a fact."""
        return self.task.candidates()

    @property
    def tool(self) -> Sequence[float]:
        """X and y of the tool, in metres."""
        x, y, _ = self.task.tcp_pose.p.tolist()
        return [x, y]

    def oracle(self) -> Mapping[str, Any] | None:
        """The choice that the task's script takes next; None where it has none."""
        try:
            return oracle_choice(self.task)[0]
        except OracleStuckError:
            return None

    @property
    def steps_counted(self) -> int:
        """Control steps that count towards the limit."""
        return 0 if self._run is None else self._run.count

    # One control step -----------------------------------------------------------------------------

    def _on_frame(self, evaluated: dict[str, Any]) -> None:
        if self._muted:
            return
        run = self._require_run()
        run.observer.follow()
        if run.in_video and run.displayed.text == NO_RECORD:
            return  # neither rendered nor returned
        cameras: tuple[str, ...] = tuple(CAMERAS)
        if self.render_request is not None:
            cameras = self.render_request.cameras(
                run.returned, newest=not run.in_video and not run.demonstrator.left
            )
        frame = run.newest = run.observer.frame(evaluated, cameras)
        if run.displayed.text != run.subgoal_text:
            run.began.append(run.returned)
            run.subgoal_text = run.displayed.text
        run.returned += 1
        run.facts.add(run.in_video)
        run.info = self._info(run, evaluated)
        run.frames.append(frame)
        if self.on_frame is not None:
            self.on_frame(frame, run.info, run.in_video)

    def _step_control(self, action: np.ndarray) -> None:
        task = self.task
        run = self._require_run()
        run.count += not run.in_video
        # A frame has the text of the sub-task in which its step was made, not of the next one. In
        # the video it has the text of the demonstrated sub-task where one of the two has none.
        run.displayed, demonstrated = task.progress.displayed, task.progress.demonstrated
        if run.in_video and NO_RECORD in (run.displayed.text, demonstrated.text):
            run.displayed = demonstrated
        run.last_action = np.asarray(action, np.float32)
        _, _, terminated, _, _ = task.step(run.last_action)
        run.terminated = terminated.reshape(-1)[0].clone()
        run.truncated = torch.tensor(self._timed_out(run))

    def _hold(self, run: _Run, steps: int) -> None:
        """Repeat the last command, while the scene continues, until the episode ends."""
        run.hold_steps += steps
        for left in reversed(range(steps)):
            run.demonstrator.left = left  # the last one's frame is the newest
            self._step_control(run.last_action)
            if run.terminated:
                break
        run.demonstrator.left = 0

    # Info and status ------------------------------------------------------------------------------

    def _info(self, run: _Run, evaluated: dict[str, Any]) -> dict[str, Any]:
        task = self.task
        subtask = run.displayed
        success, fail = evaluated["success"].clone(), evaluated["fail"].clone()
        status = "ongoing"
        if success:
            status = "success"
        elif fail:
            status = "fail"
        elif self._timed_out(run):
            status = "timeout"
        info: dict[str, Any] = {
            "task_goal": list(task.goals()),
            "simple_subgoal_online": subtask.text,
            "status": status,
            "success": success,
            "fail": fail,
            "elapsed_steps": evaluated["elapsed_steps"].clone(),
        }
        if self.render_request is None or self.render_request.grounded:
            segmentation = run.observer.segmentation if self._render else None
            info["grounded_subgoal_online"] = run.grounding.update(subtask, segmentation)
        if self.include.available_multi_choices or self._space.name == "multi_choice":
            info["available_multi_choices"] = self._options()
        for name in CAMERAS:
            if getattr(self.include, f"{name}_camera_intrinsic"):
                info[f"{name}_camera_intrinsic"] = INTRINSIC.copy()
        return info

    def _options(self) -> list[dict[str, Any]]:
        """What the task offers to choose from."""
        options = []
        for choice in self.task.choices():
            option = choice.option.to_dict()
            if self.include.possible:
                # An object that it fits is within the arm's reach.
                base = self.task.agent.robot.pose.sp.p
                option["possible"] = choice.candidates is None or any(
                    np.linalg.norm(thing.position - base) < _REACH for thing in choice.candidates
                )
            options.append(option)
        if self.include.possible and not any(option["possible"] for option in options):
            for option in options:  # something has to be chosen
                option["possible"] = True
        return options

    def _timed_out(self, run: _Run) -> bool:
        return run.count >= self.max_steps + run.hold_steps + _MARGIN

    def _require_run(self) -> _Run:
        if self._run is None:
            raise UserError(
                CLOSED if self._task is None else "step() before reset(): call reset() first."
            )
        return self._run
