"""One episode of the official demonstration files, read frame by frame."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from h5py import Empty, h5d, h5s

from mme_vla.data.waypoints import CHOICE_NUMBERS, known_poses, row_of
from mme_vla.embodiment.action_space import POSE_WIDTH, read_options
from mme_vla.embodiment.robomme import CAMERAS, LETTERS
from mme_vla.errors import UserError, brief
from mme_vla.utils import decoding, parse_json

REMEDY = "Download or copy the file again."


@dataclass(frozen=True)
class EpisodeRef:
    """Where one recorded episode lies: `group` (episode_<index>) of `file`; `task` is taken from the file's name."""

    file: Path
    index: int
    task: str

    @property
    def group(self) -> str:
        return f"episode_{self.index}"


class StoredValues:
    """Reads the datasets below one episode's group."""

    def __init__(self, ref: EpisodeRef, group: Any) -> None:
        self.ref = ref
        self._group = group

    def _step(self, step: int, name: str) -> Any:
        return self._value(f"timestep_{step}/{name}")

    def _value(self, name: str) -> Any:
        place = f"{self.ref.file} {self.ref.group}/{name}"
        with decoding(place, "a dataset of HDF5", REMEDY):
            # An episode has thousands: opened as h5py's own objects, each takes more than twice as long.
            stored = h5d.open(self._group.id, name.encode())
            if stored.get_space().get_simple_extent_type() == h5s.NULL:
                return Empty(stored.dtype)
            array = np.empty(stored.shape, stored.dtype)
            stored.read(h5s.ALL, h5s.ALL, array)
            return array[()]

    def _numbers(self, step: int, name: str, least: int, finite: bool = True) -> np.ndarray:
        """A list of at least `least` numbers, finite unless told otherwise."""
        numbers = np.atleast_1d(np.asarray(self._step(step, name)))
        right = numbers.dtype.kind in "fiu" and numbers.ndim == 1 and len(numbers) >= least
        if not right or (finite and not np.isfinite(numbers).all()):
            raise UserError(
                f"{self.ref.file} {self.ref.group}/timestep_{step}/{name} holds {brief(numbers.tolist())}; expected at "
                f"least {least} {'finite ' if finite else ''}numbers. {REMEDY}"
            )
        return numbers

    def _flag(self, step: int, name: str) -> bool:
        flag = np.asarray(self._step(step, name))
        if flag.size != 1 or flag.dtype.kind not in "biu":
            raise UserError(
                f"{self.ref.file} {self.ref.group}/timestep_{step}/{name} holds {brief(flag.tolist())}; expected a "
                f"flag. {REMEDY}"
            )
        return bool(flag.reshape(-1)[0])

    def _text(self, value: Any) -> str:
        if not isinstance(value, bytes | str):
            raise UserError(f"{self.ref.file} {self.ref.group} has {brief(value)} for a text. {REMEDY}")
        try:
            return value.decode("utf-8") if isinstance(value, bytes) else value.encode().decode()
        except UnicodeError:
            raise UserError(f"{self.ref.file} {self.ref.group} has a text that is not UTF-8. {REMEDY}") from None


SUBGOALS = ("simple_subgoal", "grounded_subgoal", "simple_subgoal_online", "grounded_subgoal_online")
POSE_STATE = "eef_state"
"""The dataset's column of the tool's pose [6], and the file's name of it among a step's observations."""
POSE_ACTIONS = {"ee_pose_actions": "action/eef_action", "waypoint_actions": "action/waypoint_action"}
"""Columns of the tool's poses (x, y, z, roll, pitch, yaw, gripper) and where they stand in a file."""
CHOICES = ("setup/available_multi_choices", "timestep_0/action/choice_action", "timestep_0/info/is_subgoal_boundary")
"""What an episode has whose options and choices were recorded."""
FRAMES = "setup/frames"
"""Where a file keeps the choice of frames it was recorded at, as JSON, if not all were drawn."""
_IMAGE_KEYS = {camera: f"obs/{camera}_rgb" for camera in CAMERAS}
_REQUIRED = (
    "obs/joint_state", "obs/gripper_state", "action/joint_action", "info/is_video_demo", "info/is_completed",
    *(f"info/{name}" for name in SUBGOALS),
)  # fmt: skip


@dataclass(frozen=True)
class RawFrame:
    """One recorded time step. The observation was taken after the action of the same step.

    front, wrist: [H, W, 3] uint8. state: [8] float32, seven joint angles and the first finger's position.
    action: [8] as stored, seven absolute joint targets and the gripper command (−1 close, 1 open).
    is_demo: the step belongs to the conditioning video.
    subgoals: the four texts of `SUBGOALS`, lower-case; after completion the last ones stay, as released.
    drawn: the cameras that were drawn at this step; of the others `front` and `wrist` repeat an earlier image (the
        first one, before there is any).
    """

    front: np.ndarray
    wrist: np.ndarray
    state: np.ndarray
    action: np.ndarray
    is_demo: bool
    subgoals: dict[str, str]
    rendered: frozenset[str] = frozenset(CAMERAS)


class RawEpisode(StoredValues):
    """An open episode. Use `with open_episode(ref) as episode`; frames are read one by one, on demand."""

    def __init__(self, ref: EpisodeRef, group: Any) -> None:
        super().__init__(ref, group)
        with decoding(f"{ref.file} {ref.group}", "an episode", REMEDY):
            steps = sorted(int(name[9:]) for name in group if re.fullmatch(r"timestep_\d{1,9}", name))
        if steps != list(range(len(steps))) or not steps:
            raise UserError(
                f"{ref.file} {ref.group}: expected timestep_0 … timestep_{max(len(steps) - 1, 0)} without gaps, found "
                f"{len(steps)} steps{f', the last is {steps[-1]}' if steps else ''}. The file is damaged."
            )
        self.length = len(steps)
        with decoding(f"{ref.file} {ref.group}", "an episode", REMEDY):
            # A recording at a chosen list of frames has images at these alone.
            image_keys = () if FRAMES in group else _IMAGE_KEYS.values()
            needed = ("setup/task_goal", *(f"timestep_0/{x}" for x in (*image_keys, *_REQUIRED)))
            missing = [name for name in needed if name not in group]
        if missing:
            raise UserError(f"{ref.file} {ref.group} lacks {', '.join(missing)}: not the layout of RoboMME's recorder.")
        demo = np.array([self._flag(k, "info/is_video_demo") for k in range(self.length)])
        self.exec_start = int(demo.sum())
        if demo[self.exec_start :].any() or self.exec_start == self.length:
            raise UserError(f"{ref.file} {ref.group}: video frames must come first, then at least one execution frame.")

    def _image(self, step: int, camera: str) -> np.ndarray:
        name = _IMAGE_KEYS[camera]
        if self.frames is not None and not self.rendered[camera][step]:
            raise UserError(
                f"{self.ref.file} {self.ref.group}: {camera} was not drawn at step {step}; the episode was recorded "
                f"with frames={self.frames['at']}."
            )
        image = np.asarray(self._step(step, name))
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[-1] != 3:
            raise UserError(
                f"{self.ref.file} {self.ref.group}/timestep_{step}/{name} holds {image.dtype} {list(image.shape)}; "
                f"expected uint8 [height, width, 3]. {REMEDY}"
            )
        return image

    @property
    def goals(self) -> list[str]:
        """All wordings of the goal, lower-case; the first is the one to train with."""
        goals = [self._text(goal).lower() for goal in np.atleast_1d(self._value("setup/task_goal"))]
        if not goals:
            raise UserError(f"{self.ref.file} {self.ref.group}/setup/task_goal is empty. {REMEDY}")
        return goals

    @property
    def seed(self) -> int | None:
        if "setup/seed" not in self._group:
            return None
        value = np.asarray(self._value("setup/seed"))
        if value.size != 1 or value.dtype.kind not in "iu":
            raise UserError(f"{self.ref.file} {self.ref.group}/setup/seed is {brief(value.tolist())}. {REMEDY}")
        return int(value.reshape(-1)[0])

    @property
    def difficulty(self) -> str | None:
        return self._text(self._value("setup/difficulty")) if "setup/difficulty" in self._group else None

    def __len__(self) -> int:
        return self.length

    @cached_property
    def frames(self) -> dict[str, Any] | None:
        """The choice of frames it was recorded at; None for one that was drawn whole."""
        if FRAMES not in self._group:
            return None
        settings: dict[str, Any] = parse_json(
            self._text(self._value(FRAMES)), f"{self.ref.file} {self.ref.group}/{FRAMES}"
        )
        return settings

    @cached_property
    def rendered(self) -> dict[str, np.ndarray]:
        """Which steps each camera shows, bool [t]."""
        if self.frames is None:
            return {camera: np.ones(self.length, bool) for camera in CAMERAS}
        return {
            camera: np.array([f"timestep_{k}/{name}" in self._group for k in range(self.length)])
            for camera, name in _IMAGE_KEYS.items()
        }

    def subgoals(self) -> Iterator[dict[str, str]]:
        """The four texts of every step, as in `RawFrame`, without reading images."""
        subgoals: dict[str, str] = {}
        for k in range(self.length):
            if not subgoals or not self._flag(k, "info/is_completed"):
                subgoals = {name: self._text(self._step(k, f"info/{name}")).lower() for name in SUBGOALS}
            yield subgoals

    def joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint angles and joint targets of every step, [t, 7] each, in the file's own precision."""
        angles = [self._numbers(k, "obs/joint_state", 7)[:7] for k in range(self.length)]
        targets = [self._numbers(k, "action/joint_action", 7)[:7] for k in range(self.length)]
        return np.stack(angles), np.stack(targets)

    def pose_actions(self, column: str) -> np.ndarray:
        """A column of `POSE_ACTIONS`, [t, 7] float32.

        Of waypoints, which are noted when a motion begins: the one under way, and before the first one of the video
        or the execution that first one; a part without any is one motion to where it ends.
        """
        steps = [self._numbers(k, POSE_ACTIONS[column], 7, finite=False)[:7] for k in range(self.length)]
        return known_poses(
            np.stack(steps), self.exec_start, lambda k: self._numbers(k, POSE_ACTIONS["ee_pose_actions"], 7)[:7]
        )

    def tool_poses(self) -> np.ndarray:
        """Where the tool was at every step: position and roll, pitch, yaw, [t, 6] float32."""
        steps = [self._numbers(k, f"obs/{POSE_STATE}", POSE_WIDTH)[:POSE_WIDTH] for k in range(self.length)]
        return np.stack(steps).astype(np.float32)

    def choice_actions(self) -> np.ndarray:
        """What was chosen among `options`, [t, 10] float32: at the first frame of each, zeros at all others."""
        rows = np.zeros((self.length, len(CHOICE_NUMBERS)), np.float32)
        for k in range(self.length):
            begins = self._flag(k, "info/is_subgoal_boundary") and not self._flag(k, "info/is_completed")
            if begins or k == self.exec_start:
                try:
                    row = row_of(self._text(self._step(k, "action/choice_action")))
                except UserError as error:
                    place = f"{self.ref.file} {self.ref.group}/timestep_{k}/action/choice_action"
                    raise UserError(f"{place}: {error} {REMEDY}") from None
                rows[k] = 0 if row is None else row
        return rows

    @cached_property
    def options(self) -> list[dict[str, Any]]:
        """What could be chosen: `label`, `action` and `need_parameter` of each option."""
        place = f"{self.ref.file} {self.ref.group}/{CHOICES[0]}"
        values = parse_json(self._text(self._value(CHOICES[0])), place, list)
        try:
            options = read_options(values, len(LETTERS))
        except UserError as error:
            raise UserError(f"{place}: {error} {REMEDY}") from None
        return [option.to_dict() for option in options]

    def shot(self, step: int, camera: str) -> dict[str, np.ndarray]:
        """What a camera (`front`, `wrist`) recorded at a step, and where it stood.

        Returns:
            `colours` [H, W, 3] uint8; `depth` [H, W] float32 in millimetres; `intrinsic` [3, 3] and the world-to-camera
            `extrinsic` [3, 4] float64.
        """
        colours = self._image(step, camera)
        parts = {"depth": f"timestep_{step}/obs/{camera}_depth", "intrinsic": f"setup/{camera}_camera_intrinsic",
                 "extrinsic": f"timestep_{step}/obs/{camera}_camera_extrinsic"}  # fmt: skip
        missing = [name for name in parts.values() if name not in self._group]
        if missing:
            raise UserError(f"{self.ref.file} {self.ref.group} lacks {', '.join(missing)}: record it with depth.")
        arrays = {name: np.asarray(self._value(place)) for name, place in parts.items()}
        arrays["depth"] = arrays["depth"].reshape(arrays["depth"].shape[:2])
        shapes = {"depth": colours.shape[:2], "intrinsic": (3, 3), "extrinsic": (3, 4)}
        for name, shape in shapes.items():
            numbers = arrays[name].dtype.kind in "fiu" and np.isfinite(arrays[name]).all()
            if arrays[name].shape != shape or not numbers:
                raise UserError(
                    f"{self.ref.file} {self.ref.group}/{parts[name]} holds {arrays[name].dtype} "
                    f"{list(arrays[name].shape)}; expected {list(shape)} finite numbers. {REMEDY}"
                )
        kinds = {"depth": np.float32, "intrinsic": np.float64, "extrinsic": np.float64}
        return {"colours": colours, **{name: arrays[name].astype(kind) for name, kind in kinds.items()}}

    def commanded_open(self, step: int) -> bool:
        """Whether the gripper's command at a step is to be open."""
        return bool(self._numbers(step, "action/joint_action", 8)[7] > 0)

    def front(self, step: int) -> np.ndarray:
        """The front image of one step, [H, W, 3] uint8."""
        return self._image(step, "front")

    def __iter__(self) -> Iterator[RawFrame]:
        for camera, rendered in self.rendered.items():
            if not rendered.any():
                raise UserError(f"{self.ref.file} {self.ref.group} has no image of the camera {camera!r}. {REMEDY}")
        latest = {camera: self._image(int(rendered.argmax()), camera) for camera, rendered in self.rendered.items()}
        for k, subgoals in enumerate(self.subgoals()):
            fingers = self._numbers(k, "obs/gripper_state", 1)
            now = frozenset(camera for camera, rendered in self.rendered.items() if rendered[k])
            latest |= {camera: self._image(k, camera) for camera in now}
            yield RawFrame(
                **latest,
                rendered=now,
                state=np.concatenate([self._numbers(k, "obs/joint_state", 7), fingers[:1]]).astype(np.float32),
                action=self._numbers(k, "action/joint_action", 8),
                is_demo=k < self.exec_start,
                subgoals=subgoals,
            )
