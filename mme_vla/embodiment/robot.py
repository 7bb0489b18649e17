"""`Embodiment`: everything of a robot that a policy, its data and its evaluation must agree on.

One YAML of `configs/embodiment` describes one; it is saved with every checkpoint.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StrictBool
from pydantic.dataclasses import dataclass as checked_dataclass

from mme_vla.embodiment.action_space import ActionSpace, Columns, Size, compare_names
from mme_vla.errors import UserError, brief, did_you_mean, require
from mme_vla.utils.validation import validated

log = logging.getLogger(__name__)
_STRICT = ConfigDict(extra="forbid")


@checked_dataclass(frozen=True, config=_STRICT)
class Camera:
    """One view of the scene.

    name: the same from the simulator or the robot to the policy.
    key: its column in the dataset; None for the usual names.
    augment: in training, `all` (crop, rotation, colour), `colour`, or `none`.
    depth: whether the policy also reads how far each pixel is, and where the camera stands.
    """

    name: str
    key: str | None = None
    augment: Literal["all", "colour", "none"] = "all"
    depth: StrictBool = False

    @property
    def lerobot_key(self) -> str:
        """The column of its images by LeRobot's name; a key that is such a name stays."""
        name = self.key or self.name
        return name if name.startswith("observation.") else f"observation.images.{name}"

    @property
    def readings(self) -> tuple[str, ...]:
        """What is delivered beside the images: depth [H, W, 1] int16 in millimetres, and the
        camera's pose [3, 4].

        The pose is from the world to the camera, in OpenCV's axes.
        """
        if not self.depth:
            return ()
        return f"{self.name}_depth", f"{self.name}_camera_extrinsic"


@checked_dataclass(frozen=True, config=_STRICT)
class State:
    """What the robot feels: `width` numbers, in the columns `key` of the dataset (empty for the
    usual names).
    """

    width: Size
    key: Columns = ()


class _Section(BaseModel):
    """The section `embodiment`; its parts are checked one by one, each by its own key."""

    model_config = _STRICT
    name: str
    cameras: Any
    memory_camera: str | None = None
    state: Any
    action: Any
    fps: Annotated[float, Field(strict=True, gt=0, le=1000)] | None = None
    conditioning_video: StrictBool = False


@dataclass(frozen=True)
class Embodiment:
    """A robot as a policy knows it.

    cameras: in the order the network sees them.
    memory_camera: the one whose frames memories store.
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

    @classmethod
    def from_dict(cls, section: Any) -> Self:
        """Read the section `embodiment` of a configuration.

        Raises:
            UserError: an unknown or missing key, or a value that cannot be; it is named.
        """
        values = validated(_Section, section, "embodiment", "embodiment")
        require(
            isinstance(values.cameras, Mapping) and values.cameras,
            "embodiment.cameras must name at least one camera with its settings, got"
            f" {brief(values.cameras)}.",
        )
        cameras = []
        for key, settings in values.cameras.items():
            name = str(key)  # YAML reads a camera called 0 as a number
            where = f"embodiment.cameras.{name}"
            options = settings or {}
            require(
                isinstance(options, Mapping),
                f"{where} must be a section of keys, got {brief(options)}.",
            )
            require(
                name != "state",
                f"{where}: the state goes under this name in messages; call the camera something"
                " else.",
            )
            require(
                "name" not in options,
                f"{where}.name: a camera is named by its key, {brief(name)}; remove `name`.",
            )
            cameras.append(validated(Camera, {**options, "name": name}, where, where))
        names = [camera.name for camera in cameras]
        memory_camera = values.memory_camera or names[0]
        if memory_camera not in names:
            near = did_you_mean(memory_camera, names)
            raise UserError(
                f"embodiment.memory_camera={brief(memory_camera)} is none of the cameras. {near}"
            )
        state = validated(State, values.state, "embodiment.state", "embodiment.state")
        return cls(
            name=values.name,
            cameras=tuple(cameras),
            memory_camera=memory_camera,
            state=state,
            action=ActionSpace.from_dict(values.action, state.width),
            fps=values.fps,
            conditioning_video=values.conditioning_video,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the section that `from_dict` reads, fit for JSON."""
        cameras: dict[str, dict[str, Any]] = {}
        for camera in self.cameras:
            cameras[camera.name] = {"key": camera.key, "augment": camera.augment}
            if camera.depth:
                cameras[camera.name]["depth"] = True
        return {
            "name": self.name,
            "cameras": cameras,
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

    def check_place(self, local: Self) -> None:
        """Make sure that a policy of this robot can act where there is another, `local`.

        Raises:
            UserError: a camera that is not there, another number of numbers, or their names in
                another order.
        """
        require(
            set(self.camera_names) <= set(local.camera_names)
            and self.state.width == local.state.width
            and self.action.width == local.action.width,
            f"The robot {self.name!r} of this policy, with the cameras"
            f" {', '.join(self.camera_names)}, {self.state.width} numbers of state and"
            f" {self.action.width} of an action, does not fit the environment's {local.name!r},"
            f" which has the cameras {', '.join(local.camera_names)}, {local.state.width} numbers"
            f" of state and {local.action.width} of an action. Train with env=<this environment>.",
        )
        compare_names(
            self.action.names,
            local.action.names,
            "action",
            f"the policy's robot {self.name}",
            f"the environment's {local.name}",
            "Bring the environment's embodiment into the order that the policy was trained in.",
        )
        if None not in (self.fps, local.fps) and self.fps != local.fps:
            log.warning(
                "The policy's robot %s has %g frames per second, the environment's %s has %g: one"
                " action is another time.",
                self.name,
                self.fps,
                local.name,
                local.fps,
            )
