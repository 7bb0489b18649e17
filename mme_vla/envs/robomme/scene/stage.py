"""The stage of a task: robot, table, cameras and the step counter."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.scene_builder.table import TableSceneBuilder

from mme_vla.embodiment.robomme import SIDE
from mme_vla.envs.rendering import keep_renderer, lean_shaders
from mme_vla.envs.robomme.robot.robots import ROBOT_BASE, STICK, WRISTCAM
from mme_vla.envs.robomme.scene.things import Thing, pose_of

RESET_QPOS = np.array([0, 0, 0, -np.pi / 2, 0, np.pi / 2, np.pi / 4], np.float32)
"""Joint angles at the start of every episode, and the target of the reset action; radians."""
FIELD_OF_VIEW = np.pi / 2


class Stage(BaseEnv):
    """A robot at a table under two cameras; `Task` adds the objects and the script."""

    SUPPORTED_REWARD_MODES = ("none", "dense")
    tier: str = ""
    """Of RoboMME-OOD, whose rules then hold; empty for the benchmark's."""
    stick: ClassVar[bool] = False
    """The robot holds a stick instead of a gripper."""
    spectator: ClassVar[tuple[Sequence[float], Sequence[float]]] = ((0.6, 0.7, 0.6), (0, 0, 0.35))
    """From where, and to where, the camera for people looks; no policy sees its images."""

    _custom_sensor_configs: dict[str, Any] | None  # ManiSkill's: the requested camera settings

    def __init__(
        self,
        *args: Any,
        seed: int = 0,
        second_tries: bool = True,
        robot_uids: str | None = None,
        control_mode: str = "pd_joint_pos",
        **kwargs: Any,
    ) -> None:
        self.seed = seed
        self.second_tries = second_tries
        self.recording = False
        """`dropped` is evaluated as it was when the official data were recorded; see
        `as_recorded`.
        """
        self.reset_in_progress = False
        """The arm is being driven back between the conditioning video and the execution."""
        self.after_video = False
        """The arm has begun to be driven back after the conditioning video."""
        self.stored_qpos: np.ndarray | None = None
        """Joint angles [7] at the end of the stick's first approach, where its execution begins."""
        self.unrecorded_steps = 0
        """Steps of this episode that a recording of it does not have."""
        super().__init__(
            *args,
            robot_uids=robot_uids or (STICK if self.stick else WRISTCAM),
            control_mode=control_mode,
            **kwargs,
        )

    # The scene ------------------------------------------------------------------------------------

    def add[T: Thing](self, thing: T) -> T:
        """Count an object as part of the scene, so that a reset brings it back."""
        self.things.append(thing)
        return thing

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(ROBOT_BASE))

    def _setup_scene(self) -> None:
        super()._setup_scene()
        if self.scene.can_render():
            keep_renderer(self._render_device)

    def _clear(self) -> None:
        """Release the scene by cutting its reference cycle.

        ManiSkill collects all garbage instead, which is 0.4 s of the 0.5 s that an episode without
        images takes to begin and end.
        """
        self._close_viewer()
        if self.scene is not None:
            self.scene.__dict__.clear()
        self.__dict__.update(
            scene=None, agent=None, _sensors={}, _human_render_cameras={}, _hidden_objects=[]
        )

    def _setup_sensors(self, options: dict) -> None:
        configs = self._custom_sensor_configs
        lit_by_lamps = self.scene.sub_scenes[0].render_system.cubemap is None
        if not configs and lit_by_lamps and self._render_device.is_cpu():
            lean = lean_shaders()
            if lean is not None:
                self._custom_sensor_configs = {"shader_config": lean}
        super()._setup_sensors(options)
        self._custom_sensor_configs = configs

    def _load_scene(self, options: dict) -> None:
        """Put up the table, with nothing on it."""
        self.table = TableSceneBuilder(self, robot_init_qpos_noise=0)
        self.table.build()
        self.things: list[Thing] = []

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        """Bring table and robot back to their start."""
        self.table.initialize(env_idx)
        qpos = RESET_QPOS
        if not self.stick:
            qpos = np.concatenate([RESET_QPOS, [0.04, 0.04]])
        self.agent.reset(qpos.astype(np.float32))
        self.agent.robot.set_pose(sapien.Pose(ROBOT_BASE))
        self.reset_in_progress = self.after_video = False
        self.stored_qpos = None
        self.unrecorded_steps = 0

    # Steps ----------------------------------------------------------------------------------------

    @contextmanager
    def as_recorded(self) -> Iterator[None]:
        """Evaluate as when the official data were recorded, while a demonstrator acts; afterwards
        as before.
        """
        before, self.recording = self.recording, True
        try:
            yield
        finally:
            self.recording = before

    @property
    def steps_done(self) -> int:
        """Control steps since the reset."""
        return int(self._elapsed_steps[0])

    @property
    def steps_waited(self) -> int:
        """Likewise, as a wait counts them: evaluated `as_recorded`, without those that a recording
        does not have.
        """
        if self.recording:
            return self.steps_done - self.unrecorded_steps
        return self.steps_done

    @property
    def reset_action(self) -> np.ndarray:
        """The action that holds the arm at its start: [8], or [7] for the stick."""
        return RESET_QPOS if self.stick else np.append(RESET_QPOS, np.float32(1))

    @property
    def start_action(self) -> np.ndarray:
        """The action whose step gives the first observation of the execution."""
        return self.reset_action if self.stored_qpos is None else self.stored_qpos

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Always zero: the benchmark has no reward."""
        return torch.zeros(self.num_envs)

    # Robot state ----------------------------------------------------------------------------------

    @property
    def tcp_pose(self) -> sapien.Pose:
        """Pose of the tool centre point in the world."""
        return pose_of(self.agent.tcp)

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

    # Cameras --------------------------------------------------------------------------------------

    @property
    def _default_sensor_configs(self) -> Sequence[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.3, 0, 0.4], target=[0, 0, -0.2])
        return [CameraConfig("base_camera", pose, SIDE, SIDE, FIELD_OF_VIEW, 0.01, 100)]

    @property
    def _default_human_render_camera_configs(self) -> Sequence[CameraConfig]:
        eye, target = self.spectator
        pose = sapien_utils.look_at(eye=eye, target=target)
        return [CameraConfig("render_camera", pose, 512, 512, 1, 0.01, 100)]
