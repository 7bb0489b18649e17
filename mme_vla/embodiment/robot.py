"""`Embodiment`: everything of a robot that a policy, its data and its evaluation must agree on.

One YAML of `configs/embodiment` describes one; it is saved with every checkpoint.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from mme_vla.config.sections import section_keys
from mme_vla.embodiment import action_space
from mme_vla.embodiment.action_space import ActionSpace
from mme_vla.errors import UserError, brief, check_choice, check_integer, did_you_mean, require

AUGMENTATIONS = ("all", "colour", "none")
_KEYS = ("name", "cameras", "memory_camera", "state", "action", "fps", "conditioning_video")


@dataclass(frozen=True)
class Camera:
    """One view of the scene.

    name: the same from the simulator or the robot to the policy. key: its column in the dataset;
    None for the usual names. augment: in training, `all` (crop, rotation, colour), `colour`, or
    `none`. depth: whether the policy also reads how far each pixel is, and where the camera stands.
    """

    name: str
    key: str | None = None
    augment: str = "all"
    depth: bool = False

    @property
    def readings(self) -> tuple[str, ...]:
        """What is delivered beside the images: depth [H, W, 1] int16 in millimetres, and the
        camera's pose [3, 4].

        The pose is from the world to the camera, in OpenCV's axes.
        """
        return (f"{self.name}_depth", f"{self.name}_camera_extrinsic") if self.depth else ()


@dataclass(frozen=True)
class State:
    """What the robot feels: `width` numbers, in the columns `key` of the dataset (empty for the
    usual names).
    """

    width: int
    key: tuple[str, ...] = ()


@dataclass(frozen=True)
class Embodiment:
    """A robot as a policy knows it.

    cameras: in the order the network sees them. memory_camera: the one whose frames memories store.
    fps: frames per second of cameras and control; None where it does not matter.
    conditioning_video: whether episodes may begin with a video, which a dataset then has to mark.
    """

    name: str
    cameras: tuple[Camera, ...]
    memory_camera: str
    state: State
    action: ActionSpace
    fps: float | None = None
    conditioning_video: bool = False

    @property
    def camera_names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    @property
    def readings(self) -> tuple[str, ...]:
        """What all cameras deliver beside their images, by the benchmark's names."""
        return tuple(name for camera in self.cameras for name in camera.readings)

    @property
    def augmentations(self) -> tuple[str, ...]:
        """What is done to each camera's images in training."""
        return tuple(camera.augment for camera in self.cameras)

    @classmethod
    def from_dict(cls, section: Mapping[str, Any]) -> Self:
        """Read the section `embodiment` of a configuration.

        Raises:
            UserError: an unknown or missing key, or a value that cannot be; it is named.
        """
        values = section_keys(
            section, "embodiment", _KEYS, required=("name", "cameras", "state", "action")
        )
        cameras = _cameras(values["cameras"])
        names = [camera.name for camera in cameras]
        memory_camera = values.get("memory_camera") or names[0]
        if memory_camera not in names:
            near = did_you_mean(str(memory_camera), names)
            raise UserError(
                f"embodiment.memory_camera={brief(memory_camera)} is none of the cameras. {near}"
            )
        state = section_keys(
            values["state"], "embodiment.state", ("key", "width"), required=("width",)
        )
        width = check_integer("embodiment.state.width", state["width"])
        fps, video = values.get("fps"), values.get("conditioning_video", False)
        require(
            not (
                fps is not None
                and (
                    isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps <= 1000
                )
            ),
            f"embodiment.fps must be a positive number to 1000 or null, got {brief(fps)}.",
        )
        require(
            isinstance(video, bool),
            f"embodiment.conditioning_video must be true or false, got {brief(video)}.",
        )
        return cls(
            name=str(values["name"]),
            cameras=cameras,
            memory_camera=str(memory_camera),
            state=State(width, action_space.columns(state.get("key"), "embodiment.state.key")),
            action=ActionSpace.from_dict(values["action"], width),
            fps=None if fps is None else float(fps),
            conditioning_video=video,
        )

    def to_dict(self) -> dict[str, Any]:
        """The section that `from_dict` reads, fit for JSON."""
        depth = {True: {"depth": True}, False: {}}  # absent in files of earlier versions
        return {
            "name": self.name,
            "cameras": {
                c.name: {"key": c.key, "augment": c.augment, **depth[c.depth]} for c in self.cameras
            },
            "memory_camera": self.memory_camera,
            "state": {"key": list(self.state.key), "width": self.state.width},
            "action": self.action.to_dict(),
            "fps": self.fps,
            "conditioning_video": self.conditioning_video,
        }

    def with_horizon(self, horizon: int) -> "Embodiment":
        """The same robot with chunks of another length; no more than a chunk is executed."""
        execute = min(self.action.execute, horizon)
        return replace(self, action=replace(self.action, horizon=horizon, execute=execute))

    def check_network(self, action_dim: int, horizon: int) -> None:
        """Make sure that a network has the sizes of this robot.

        Raises:
            UserError: its actions are too narrow, or its chunks have another length.
        """
        require(
            self.action.width <= action_dim,
            f"The robot {self.name!r} takes {self.action.width} numbers an action, more than "
            f"backbone.action_dim={action_dim}: raise it.",
        )
        require(
            self.action.horizon == horizon,
            f"embodiment.action.horizon={self.action.horizon} and backbone.horizon={horizon} are"
            " the same length of a chunk: set the embodiment's, which the backbone follows.",
        )


def _cameras(section: Any) -> tuple[Camera, ...]:
    require(
        isinstance(section, Mapping) and section,
        "embodiment.cameras must name at least one camera with its settings, got"
        f" {brief(section)}.",
    )
    cameras = []
    for name, settings in section.items():
        where = f"embodiment.cameras.{name}"
        options = section_keys(settings or {}, where, ("key", "augment", "depth"))
        augment, key = options.get("augment", "all"), options.get("key")
        check_choice(f"{where}.augment", augment, AUGMENTATIONS)
        require(
            isinstance(key, str | None),
            f"{where}.key must be a column of the dataset, got {brief(key)}.",
        )
        if not isinstance(depth := options.get("depth", False), bool):
            raise UserError(f"{where}.depth must be true or false, got {brief(depth)}.")
        require(
            name != "state",
            f"{where}: the state goes under this name in messages; call the camera something else.",
        )
        cameras.append(Camera(str(name), key, augment, depth))
    return tuple(cameras)
