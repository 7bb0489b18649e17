"""The frames of a task: robot state and the requested camera images.

A frame is a dict with one value per observation key; the interface hands out lists of them, as the
benchmark does.
"""

from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from mme_vla.embodiment.robomme import ARM_JOINTS, CAMERAS, SIDE
from mme_vla.envs.rendering import links_culled
from mme_vla.errors import require

if TYPE_CHECKING:
    from torch import Tensor

    from mme_vla.envs.task import Task


@dataclass(frozen=True)
class RenderRequest:
    """The frames of an episode that are rendered: a control step costs milliseconds, an image of it
    some fifty.

    frames: camera (`front`, `wrist`) → numbers of the frames it shows, counted from the reset on,
        those of the conditioning video first. A `range` may reach beyond the episode's end.
    now: the cameras that show, whatever its number, the newest frame of each call of `reset` and
        `step`.
    grounded: whether texts need pixels, for which the front camera renders where a sub-task begins.
    """

    frames: Mapping[str, Container[int]] = field(default_factory=dict)
    now: tuple[str, ...] = CAMERAS
    grounded: bool = True

    def cameras(self, frame: int, newest: bool) -> tuple[str, ...]:
        """The cameras that show a frame of this number."""
        cameras = []
        # some environments have more cameras than the benchmark
        for camera in dict.fromkeys((*CAMERAS, *self.frames, *self.now)):
            if frame in self.frames.get(camera, ()) or (newest and camera in self.now):
                cameras.append(camera)
        return tuple(cameras)


FOCAL_LENGTH = SIDE / 2  # pixels: the side is seen under 90 degrees
INTRINSIC = np.array(
    [[FOCAL_LENGTH, 0, SIDE / 2], [0, FOCAL_LENGTH, SIDE / 2], [0, 0, 1]], np.float32
)
"""Intrinsic matrix of both cameras, [3, 3]."""
SENSORS = {"front": "base_camera", "wrist": "hand_camera"}
"""The benchmark's names of the cameras, and the simulator's."""
_SCALAR_LAST = [1, 2, 3, 0]
_OPENCV = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # from x forward, y left, z up
_FRONT_EYE, _FRONT_TARGET = np.array([0.3, 0.0, 0.4]), np.array([0.0, 0.0, -0.2])


@dataclass(frozen=True)
class Include:
    """What a frame or an info dict holds beyond the standard keys.

    possible: where options are listed, whether an object that each option fits is within reach.
        (The benchmark offers such options, and choosing one ends the episode.)
    """

    front_depth: bool = False
    wrist_depth: bool = False
    front_camera_extrinsic: bool = False
    wrist_camera_extrinsic: bool = False
    front_camera_intrinsic: bool = False
    wrist_camera_intrinsic: bool = False
    available_multi_choices: bool = False
    maniskill_obs: bool = False
    possible: bool = False

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(isinstance(value, bool), f"{name} is {value!r}; expected True or False.")


class AngleTrack:
    """Roll, pitch and yaw that continue where the previous frame's left off instead of jumping by a
    full turn.

    Extrinsic x-y-z angles; the quaternion's sign follows the previous frame's, and each angle's
    change is folded into [-π, π) and added, so that values may leave ±π.
    """

    def __init__(self) -> None:
        self._quaternion: np.ndarray | None = None
        self._angles: np.ndarray | None = None

    def follow(self, quaternion: np.ndarray) -> np.ndarray:
        """Angles [3] float64 of the next frame, from its quaternion [4] (w, x, y, z)."""
        from scipy.spatial.transform import Rotation

        q = np.asarray(quaternion, np.float64)
        q = q / np.linalg.norm(q)
        if self._quaternion is not None and q @ self._quaternion < 0:
            q = -q
        angles = Rotation.from_quat(q[_SCALAR_LAST]).as_euler("xyz")
        if self._angles is not None:
            change = (angles - self._angles + np.pi) % (2 * np.pi) - np.pi
            angles = self._angles + change
        self._quaternion, self._angles = q, angles
        return angles.copy()


class Observer:
    """Makes frames of an episode.

    Args:
        task: the simulated task, after its reset.
        include: what the frames hold beyond the standard keys.
        render: take images; without it frames hold the robot's state only.
    """

    def __init__(self, task: "Task", include: Include, render: bool) -> None:
        self.task = task
        self.include = include
        self.render = render
        self._angles = AngleTrack()
        self._taken: set[str] = set()
        self.follow()

    def follow(self) -> None:
        """Take note of the tool's pose; due at every control step, whether or not it becomes a
        frame.
        """
        pose = self.task.tcp_pose
        self._eef = np.concatenate([pose.p, self._angles.follow(pose.q)]).astype(np.float64)

    def frame(
        self, info: dict[str, Any], cameras: Collection[str] = tuple(SENSORS)
    ) -> dict[str, Any]:
        """The present frame; `info` is what the task has just evaluated.

        Args:
            cameras: those that take an image; the others' are None.
        """
        self._taken = set()
        qpos = self.task.qpos
        fingers: np.ndarray = np.zeros(2)
        if not self.task.stick:
            fingers = qpos[-2:].astype(np.float32)
        frame: dict[str, Any] = {
            "joint_state": qpos[:ARM_JOINTS].astype(np.float32),
            "eef_state": self._eef.copy(),
            "gripper_state": fingers,
        }
        if self.include.maniskill_obs:
            frame["maniskill_obs"] = self.task.simulator_obs(info)
            self._taken |= set(SENSORS)
        elif self.render:
            self._render_cameras(cameras)
        for name in SENSORS:
            if self.render:
                depth = getattr(self.include, f"{name}_depth")
                images: dict[str, Any] = {"rgb": None, "depth": None}
                if name in cameras:
                    images = read_images(self.task, name, rgb=True, depth=depth)
                    if depth:
                        images["depth"] = images["depth"].astype(np.int16)
                frame[f"{name}_rgb"] = images["rgb"]
                if depth:
                    frame[f"{name}_depth"] = images["depth"]
            if getattr(self.include, f"{name}_camera_extrinsic"):
                frame[f"{name}_camera_extrinsic"] = self.extrinsic(name)
        return frame

    def segmentation(self) -> np.ndarray:
        """Object ids [256, 256] of the present front image, which is taken if the
        frame has none.
        """
        if "front" not in self._taken:
            self._render_cameras(["front"])
        return read_images(self.task, "front", segmentation=True)["segmentation"][..., 0]

    def extrinsic(self, name: str) -> np.ndarray:
        """World to camera in OpenCV's axes, float32 [3, 4], of `front` or `wrist`."""
        if name == "front":
            return front_extrinsic().copy()
        pose = self.task.agent.robot.links_map["camera_link"]._objs[0].entity_pose
        world_to_camera = np.asarray(pose.inv().to_transformation_matrix(), np.float64)
        return (_OPENCV @ world_to_camera[:3]).astype(np.float32)

    def _render_cameras(self, cameras: Collection[str]) -> None:
        cameras = [name for name in cameras if name in SENSORS]
        capture(self.task, cameras)
        self._taken |= set(cameras)


def capture(task: "Task", cameras: Collection[str]) -> None:
    """Render the scene by these cameras of `SENSORS`."""
    if cameras:
        task.scene.update_render(update_sensors=True, update_human_render_cameras=False)
    for name in cameras:
        sensor = task.scene.sensors[SENSORS[name]]
        with links_culled(task, sensor.camera):
            sensor.capture()


def read_images(
    task: "Task", camera: str, rgb: bool = False, depth: bool = False, segmentation: bool = False
) -> dict[str, np.ndarray]:
    """What a camera last captured: `rgb`, `depth` and `segmentation`, each [256, 256, channels]."""
    import torch

    sensor = task.scene.sensors[SENSORS[camera]]
    on_cpu = sensor.camera.scene.backend.render_backend == "sapien_cpu"
    shader = sensor.config.shader_config
    images: dict[str, Tensor] = {}
    flags = {"rgb": rgb, "depth": depth, "segmentation": segmentation}
    requested = {name for name, flag in flags.items() if flag}
    for texture, kinds in shader.texture_names.items():
        if not requested.intersection(kinds):
            continue
        if on_cpu:  # ManiSkill's own copy takes 8 ms
            picture = torch.from_numpy(sensor.camera._render_cameras[0].get_picture(texture))
        else:
            picture = sensor.camera.get_picture(texture)[0][0]
        images |= shader.texture_transforms[texture](picture)
    return {name: np.ascontiguousarray(images[name].cpu().numpy()) for name in requested}


@cache
def front_extrinsic() -> np.ndarray:
    """World-to-camera matrix of the front camera, float32 [3, 4]; it never moves."""
    forward = _FRONT_TARGET - _FRONT_EYE
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ _FRONT_EYE]).astype(np.float32)


def as_lists(frames: Sequence[dict[str, Any]], keys: Sequence[str]) -> dict[str, list[Any]]:
    """The benchmark's observation: for each key the values of all frames, in time order."""
    lists = {}
    for key in keys:
        name = key if key == "maniskill_obs" else f"{key}_list"
        lists[name] = [frame[key] for frame in frames]
    return lists


def frame_keys(include: Include, render: bool) -> list[str]:
    """The keys of every frame, in the benchmark's order."""
    keys = ["joint_state", "eef_state", "gripper_state"]
    if render:
        keys = ["front_rgb", "wrist_rgb", *keys]
    for kind in ("depth", "camera_extrinsic"):
        for name in SENSORS:
            if getattr(include, f"{name}_{kind}") and (render or kind != "depth"):
                keys.append(f"{name}_{kind}")
    if include.maniskill_obs:
        keys.append("maniskill_obs")
    return keys
