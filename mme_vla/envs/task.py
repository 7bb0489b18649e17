"""The environment every task is made from: robot, table, cameras, the order of a step, success and failure.

A task says which objects there are (`plan`, `build`, `start_episode`), what happens to them (`before_physics`,
`after_step`), and what is to be done (`subtasks`, `goals`, `choices`). Everything else is here.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.scene_builder.table import TableSceneBuilder

from mme_vla.envs.choices import Choice
from mme_vla.envs.rendering import keep_renderer
from mme_vla.envs.robot.robots import ROBOT_BASE, STICK, WRISTCAM
from mme_vla.envs.scene.draws import Draws
from mme_vla.envs.scene.things import Thing
from mme_vla.envs.subtasks import Progress, SubTask
from mme_vla.errors import UserError, did_you_mean

RESET_QPOS = np.array([0, 0, 0, -np.pi / 2, 0, np.pi / 2, np.pi / 4], np.float32)
"""Joint angles at the start of every episode, and the target of the reset action; radians."""
DIFFICULTIES = ("easy", "medium", "hard")
RECOVERY_MODES = ("z", "xy")
IMAGE_SIZE = 256
FIELD_OF_VIEW = np.pi / 2


class Task(BaseEnv):
    """One RoboMME task as a ManiSkill environment (paper, appendix on tasks).

    Args:
        seed: fixes the scene and the script; the `seed` of `reset` has no effect.
        difficulty: `easy`, `medium` or `hard`; by default seed % 3 decides.
        recovery: `z` or `xy` draws the pick that a recovery demonstration fails once, and how.
        second_tries: the demonstrator goes on where the benchmark's own gives up; without it, it fails where that does.
        robomme_failure_recovery, robomme_failure_recovery_mode: the benchmark's own words for `recovery`.

    Raises:
        UserError: an unknown difficulty or recovery mode, or a negative seed.
    """

    SUPPORTED_REWARD_MODES = ("none", "dense")
    stick: ClassVar[bool] = False
    """The robot holds a stick instead of a gripper."""
    shared_draws: ClassVar[bool] = False
    """`plan`, `build` and `start_episode` draw from one generator; otherwise `plan` has one of its own."""
    spectator: ClassVar[tuple[Sequence[float], Sequence[float]]] = ((0.6, 0.7, 0.6), (0, 0, 0.35))
    """From where, and to where, the camera for people looks; no policy sees its pictures."""
    latch_failure: ClassVar[bool] = False
    """A failure lasts; otherwise it is judged anew at each step."""
    recovery_drawn_per_episode: ClassVar[bool] = False
    """The failed pick is drawn in every initialisation (there are two), not once after the scene."""

    def __init__(
        self,
        *args: Any,
        seed: int = 0,
        difficulty: str | None = None,
        recovery: str | None = None,
        second_tries: bool = True,
        robomme_failure_recovery: bool = False,
        robomme_failure_recovery_mode: str | None = None,
        robot_uids: str | None = None,
        control_mode: str = "pd_joint_pos",
        **kwargs: Any,
    ) -> None:
        if seed < 0:
            raise UserError(f"seed is {seed}; expected a non-negative integer.")
        if difficulty is not None and difficulty not in DIFFICULTIES:
            raise UserError(f"Unknown difficulty {difficulty!r}. {did_you_mean(str(difficulty), DIFFICULTIES)}")
        if robomme_failure_recovery:
            recovery = robomme_failure_recovery_mode or recovery
            if recovery is None:
                raise UserError(f"robomme_failure_recovery needs a robomme_failure_recovery_mode of {RECOVERY_MODES}.")
        if recovery is not None and recovery not in RECOVERY_MODES:
            raise UserError(f"Unknown recovery mode {recovery!r}. {did_you_mean(str(recovery), RECOVERY_MODES)}")
        self.seed = seed
        self.difficulty = difficulty or DIFFICULTIES[seed % 3]
        self.recovery = recovery
        self.second_tries = second_tries
        self.recording = False
        """A demonstrator is recording: `dropped` is judged as it was when the official data were recorded."""
        self.observe: Callable[[dict[str, Any]], None] | None = None
        """Called in every step when the moment has come to observe: after the evaluation, whose info it gets, and
        before `after_step`."""
        self.reset_in_progress = False
        """The arm is being driven back between the conditioning video and the execution."""
        self.after_video = False
        """The arm has begun to be driven back after the conditioning video."""
        self.stored_qpos: np.ndarray | None = None
        """Joint angles [7] at the end of the stick's first approach, where its execution begins."""
        self.failed_pick: int | None = None
        """Index, among the picks of the execution, of the one that a recovery demonstration fails first."""
        super().__init__(
            *args,
            robot_uids=robot_uids or (STICK if self.stick else WRISTCAM),
            control_mode=control_mode,
            **kwargs,
        )

    # What a task supplies -----------------------------------------------------------------------------------------

    def plan(self, draws: Draws) -> None:
        """Draw what is decided before there is a scene."""

    def build(self, draws: Draws) -> None:
        """Draw the layout and put the objects on the table; each goes through `self.add`."""
        raise NotImplementedError

    def start_episode(self, draws: Draws) -> None:
        """Draw what is decided per episode and set the script's state; objects are already in their places."""

    def subtasks(self) -> list[SubTask]:
        """The sub-tasks in order."""
        raise NotImplementedError

    def goals(self) -> list[str]:
        """Equivalent wordings of the goal, the one used for evaluation first."""
        raise NotImplementedError

    def choices(self) -> list[Choice]:
        """The options of the multi-choice action space."""
        raise NotImplementedError

    def before_physics(self, k: int) -> None:
        """Scripted changes before the physics of a step; `k` steps have been done."""

    def after_step(self, k: int) -> None:
        """Scripted changes after a step's physics, evaluation and observation; `k` steps have been done."""

    def failure(self) -> bool:
        """What counts as failure at any time, whatever the sub-task."""
        return False

    def success(self) -> bool:
        """What counts as success: by default that every sub-task is done."""
        return self.progress.succeeded

    # The scene ----------------------------------------------------------------------------------------------------

    def add[T: Thing](self, thing: T) -> T:
        """Count an object as part of the scene, so that a reset brings it back."""
        self.things.append(thing)
        return thing

    def _setup_scene(self) -> None:
        super()._setup_scene()
        if self.scene.can_render():
            keep_renderer(self._render_device)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(ROBOT_BASE))

    def _load_scene(self, options: dict) -> None:
        self.table = TableSceneBuilder(self, robot_init_qpos_noise=0)
        self.table.build()
        self.things: list[Thing] = []
        draws = Draws(self.seed)
        self.plan(draws)
        if not self.shared_draws:
            draws = Draws(self.seed)
        self.build(draws)
        self.draws, self._drawn = draws, draws.state()

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.table.initialize(env_idx)
        fingers = [] if self.stick else [0.04, 0.04]
        self.agent.reset(np.concatenate([RESET_QPOS, fingers]).astype(np.float32))
        self.agent.robot.set_pose(sapien.Pose(ROBOT_BASE))
        self.reset_in_progress = self.after_video = False
        self.stored_qpos = None
        self.draws.restore(self._drawn)
        # The official construction initialises an episode twice, and what the second one draws counts.
        for attempt in range(2):
            for thing in self.things:
                thing.restore()
            self.start_episode(self.draws)
            subtasks = self.subtasks()
            if self.recovery and (attempt == 0 or self.recovery_drawn_per_episode):
                self.failed_pick = self.draw_failed_pick(self.draws, sum(s.pick and not s.video for s in subtasks))
        self.progress = Progress(subtasks, self.latch_failure)

    def draw_failed_pick(self, draws: Draws, picks: int) -> int | None:
        """Which pick of the execution a recovery demonstration fails first; None where there is none to fail."""
        return draws.integer(0, picks) if picks else None

    # A step -------------------------------------------------------------------------------------------------------

    def step(self, action: Any) -> tuple:
        result = super().step(action)
        self.after_step(self.steps_done)
        return result

    def get_obs(self, info: dict | None = None, unflattened: bool = False) -> Any:
        if self.observe is not None and info is not None:
            self.observe(info)
        return super().get_obs(info, unflattened)

    def _before_control_step(self) -> None:
        self.before_physics(self.steps_done)

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Move the pointer over the sub-tasks; success and failure, each bool [1]."""
        self.progress.update(self.failure())
        return {
            "success": torch.tensor([self.success() and not self.progress.failed]),
            "fail": torch.tensor([self.progress.failed]),
        }

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Always zero: the benchmark has no reward."""
        return torch.zeros(self.num_envs)

    @property
    def steps_done(self) -> int:
        """Control steps since the reset."""
        return int(self._elapsed_steps[0])

    @property
    def reset_action(self) -> np.ndarray:
        """The action that holds the arm at its start: [8], or [7] for the stick."""
        return RESET_QPOS if self.stick else np.append(RESET_QPOS, np.float32(1))

    @property
    def start_action(self) -> np.ndarray:
        """The action whose step gives the first observation of the execution."""
        return self.reset_action if self.stored_qpos is None else self.stored_qpos

    # Robot state --------------------------------------------------------------------------------------------------

    @property
    def tcp_pose(self) -> sapien.Pose:
        """Pose of the tool centre point in the world."""
        return self.agent.tcp.pose.sp

    @property
    def qpos(self) -> np.ndarray:
        """Joint positions [9] (seven angles, two fingers), or [7] for the stick."""
        return self.agent.robot.get_qpos()[0].cpu().numpy()

    @property
    def fingers(self) -> np.ndarray:
        """Finger positions [2] in metres; zeros for the stick."""
        return np.zeros(2) if self.stick else self.qpos[-2:]

    def is_grasping(self, thing: Thing) -> bool:
        """Whether both fingers press on the object; never for the stick."""
        return not self.stick and bool(self.agent.is_grasping(thing.entity)[0])

    # Cameras ------------------------------------------------------------------------------------------------------

    @property
    def _default_sensor_configs(self) -> Sequence[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.3, 0, 0.4], target=[0, 0, -0.2])
        return [CameraConfig("base_camera", pose, IMAGE_SIZE, IMAGE_SIZE, FIELD_OF_VIEW, 0.01, 100)]

    @property
    def _default_human_render_camera_configs(self) -> Sequence[CameraConfig]:
        eye, target = self.spectator
        pose = sapien_utils.look_at(eye=eye, target=target)
        return [CameraConfig("render_camera", pose, 512, 512, 1, 0.01, 100)]
