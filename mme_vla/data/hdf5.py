"""The official demonstration files, `record_dataset_<Task>.h5`: their episodes, read frame by
frame.

A value is checked where it is read: the files hold tens of gigabytes, and conversion reads each
value once.
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from h5py import Dataset as H5Dataset
from h5py import Empty, h5d, h5s

from mme_vla.data.waypoints import CHOICE_NUMBERS, known_poses, row_of
from mme_vla.embodiment.action_space import POSE_WIDTH, read_options
from mme_vla.embodiment.robomme import CAMERAS, LETTERS
from mme_vla.errors import UserError, brief, require
from mme_vla.utils import decoding, parse_json, require_file

REMEDY = "Download or copy the file again."

is_goal = re.compile(r"(?=.*\w)[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f]+", re.DOTALL).fullmatch
"""Whether a text tells what to do: it has a word, and no control characters but ends of lines."""


@dataclass(frozen=True)
class EpisodeRef:
    """Where one recorded episode lies: `group` (episode_<index>) of `file`; `task` is taken from
    the file's name.
    """

    file: Path
    index: int
    task: str

    @property
    def group(self) -> str:
        return f"episode_{self.index}"


SUBGOALS = (
    "simple_subgoal",
    "grounded_subgoal",
    "simple_subgoal_online",
    "grounded_subgoal_online",
)
POSE_STATE = "eef_state"
"""The dataset's column of the tool's pose [6], and the file's name of it among a step's
observations.
"""
POSE_ACTIONS = {
    "ee_pose_actions": "action/eef_action",
    "waypoint_actions": "action/waypoint_action",
}
"""Columns of the tool's poses (x, y, z, roll, pitch, yaw, gripper) and where they
stand in a file.
"""
CHOICES = (
    "setup/available_multi_choices",
    "timestep_0/action/choice_action",
    "timestep_0/info/is_subgoal_boundary",
)
"""What an episode has whose options and choices were recorded."""
_LIMITS = {
    "obs/joint_state": np.full(7, 20.0),
    "obs/gripper_state": np.full(2, 0.1),
    f"obs/{POSE_STATE}": np.full(POSE_WIDTH, 20.0),
    "action/joint_action": np.array([20.0] * 7 + [1.0]),
    "action/eef_action": np.array([20.0] * POSE_WIDTH + [1.0]),
    "action/waypoint_action": np.array([20.0] * POSE_WIDTH + [1.0]),
}
"""The vectors of a step: the greatest size that each number can have, in radians and metres; a
gripper's command lies between −1 and 1. Degrees, millimetres and quaternions do not fit.
"""
FRAMES = "setup/frames"
"""Where a file keeps the choice of frames it was recorded at, as JSON, if not all were rendered."""
_IMAGE_KEYS = {camera: f"obs/{camera}_rgb" for camera in CAMERAS}
_REQUIRED = (
    "obs/joint_state",
    "obs/gripper_state",
    "action/joint_action",
    "info/is_video_demo",
    "info/is_completed",
    *(f"info/{name}" for name in SUBGOALS),
)


@dataclass(frozen=True)
class RawFrame:
    """One recorded time step. The observation was taken after the action of the same step.

    front, wrist: [H, W, 3] uint8.
    state: [8] float32, seven joint angles and the first finger's position.
    action: [8] as stored, seven absolute joint targets and the gripper command (−1 close, 1 open).
    is_demo: the step belongs to the conditioning video.
    subgoals: the four texts of `SUBGOALS`, lower-case; after completion the last ones stay, as
        released.
    rendered: the cameras that were rendered at this step; of the others `front` and `wrist` repeat
        an earlier image (the first one, before there is any).
    """

    front: np.ndarray
    wrist: np.ndarray
    state: np.ndarray
    action: np.ndarray
    is_demo: bool
    subgoals: dict[str, str]
    rendered: frozenset[str] = frozenset(CAMERAS)


class RawEpisode:
    """An open episode. Use `with open_episode(ref) as episode`; frames are read one by one, on
    demand.
    """

    def __init__(self, ref: EpisodeRef, group: Any) -> None:
        self.ref = ref
        self._group = group
        self._shape: tuple[int, ...] = ()  # of its images, once one was read
        steps = []
        with decoding(f"{ref.file} {ref.group}", "an episode", REMEDY):
            for name in group:
                if re.fullmatch(r"timestep_\d{1,9}", name):
                    steps.append(int(name.removeprefix("timestep_")))
        steps.sort()
        self.length = len(steps)
        require(
            steps and steps == list(range(self.length)),
            f"{ref.file} {ref.group}: expected timestep_0 … timestep_{max(self.length - 1, 0)}"
            f" without gaps, found {self.length} steps up to number {max(steps, default=-1)}. The"
            " file is damaged.",
        )
        needed = ["setup/task_goal"]
        needed += [f"timestep_0/{name}" for name in _REQUIRED]
        with decoding(f"{ref.file} {ref.group}", "an episode", REMEDY):
            # A recording at a chosen list of frames has images at these alone.
            if FRAMES not in group:
                needed += [f"timestep_0/{name}" for name in _IMAGE_KEYS.values()]
            missing = [name for name in needed if name not in group]
        require(
            not missing,
            f"{ref.file} {ref.group} lacks {', '.join(missing)}: not the layout of RoboMME's"
            " recorder.",
        )
        demo = np.array([self._flag(k, "info/is_video_demo") for k in range(self.length)])
        self.exec_start = int(demo.sum())
        require(
            self.exec_start < self.length and not demo[self.exec_start :].any(),
            f"{ref.file} {ref.group}: video frames must come first, then at least one execution"
            " frame.",
        )

    def _value(self, name: str) -> Any:
        with decoding(self._path(name), "a dataset of HDF5", REMEDY):
            # An episode has thousands: opened as h5py's own objects, each takes more than twice as
            # long.
            stored = h5d.open(self._group.id, name.encode())
            if stored.get_space().get_simple_extent_type() == h5s.NULL:
                return Empty(stored.dtype)
            array = np.empty(stored.shape, stored.dtype)
            stored.read(h5s.ALL, h5s.ALL, array)
            return array[()]

    def _path(self, name: str) -> str:
        return f"{self.ref.file} {self.ref.group}/{name}"

    def _checked(self, name: str, valid: Callable[[np.ndarray], bool], expected: str) -> np.ndarray:
        """An array of numbers; raises an error if it is not valid."""
        array = np.asarray(self._value(name))
        if array.dtype.kind not in "biuf" or not valid(array):
            value = f"{array.dtype} {list(array.shape)} {brief(array.reshape(-1)[:8].tolist())}"
            raise UserError(f"{self._path(name)} holds {value}; expected {expected}. {REMEDY}")
        return array

    def _numbers(self, step: int, name: str, absent: bool = False) -> np.ndarray:
        """A vector of `_LIMITS` at a step; with `absent` all of it may be NaN."""
        limits = _LIMITS[name]
        expected = (
            f"{len(limits)} floating-point numbers of sizes up to {limits.tolist()} (radians,"
            " metres, a gripper's command from −1 to 1)"
        )
        if absent:
            expected += ", or NaN alone"

        def is_valid(numbers: np.ndarray) -> bool:
            if numbers.shape != limits.shape or numbers.dtype.kind != "f":
                return False
            is_within = (np.abs(numbers) <= limits).all()  # NaN is not
            return bool(is_within or (absent and np.isnan(numbers).all()))

        return self._checked(f"timestep_{step}/{name}", is_valid, expected)

    def _flag(self, step: int, name: str) -> bool:
        flag = self._checked(
            f"timestep_{step}/{name}",
            lambda x: x.size == 1 and x.dtype.kind in "biu" and bool(0 <= x <= 1),
            "a flag, false or true",
        )
        return bool(flag.reshape(-1)[0])

    def _text(self, name: str) -> str:
        value = self._value(name)
        with decoding(self._path(name), "a text", REMEDY):
            return _decode(value)

    def _image(self, step: int, camera: str) -> np.ndarray:
        if self.frames is not None and not self.rendered[camera][step]:
            raise UserError(
                f"{self.ref.file} {self.ref.group}: {camera} was not rendered at step {step}; the"
                f" episode was recorded with frames={self.frames.get('at')}."
            )
        image = self._checked(
            f"timestep_{step}/{_IMAGE_KEYS[camera]}",
            lambda x: x.dtype == np.uint8 and x.ndim == 3 and x.shape[-1] == 3,
            "uint8 [height, width, 3]",
        )
        self._shape = self._shape or image.shape
        require(
            image.shape == self._shape,
            f"{self.ref.file} {self.ref.group}: the image of {camera!r} at step {step} is"
            f" {list(image.shape)}, the one read first {list(self._shape)}. All images of a dataset"
            f" have one size. {REMEDY}",
        )
        return image

    @property
    def goals(self) -> list[str]:
        """All wordings of the goal, lower-case; the first is the one to train with."""
        with decoding(self._path("setup/task_goal"), "texts", REMEDY):
            goals = np.atleast_1d(self._value("setup/task_goal"))
            texts = [_decode(goal).lower() for goal in goals]
        require(
            texts and all(map(is_goal, texts)),
            f"{self._path('setup/task_goal')} is empty or holds control characters:"
            f" {brief(texts)}. A policy is told what to do in words. {REMEDY}",
        )
        return texts

    @property
    def seed(self) -> int | None:
        if "setup/seed" not in self._group:
            return None
        seed = self._checked(
            "setup/seed", lambda x: x.size == 1 and x.dtype.kind in "iu", "a whole number"
        )
        return int(seed.reshape(-1)[0])

    @property
    def difficulty(self) -> str | None:
        return self._text("setup/difficulty") if "setup/difficulty" in self._group else None

    @cached_property
    def frames(self) -> dict[str, Any] | None:
        """The choice of frames it was recorded at; None for one that was rendered whole."""
        if FRAMES not in self._group:
            return None
        settings: dict[str, Any] = parse_json(self._text(FRAMES), self._path(FRAMES))
        return settings

    @cached_property
    def rendered(self) -> dict[str, np.ndarray]:
        """Which steps each camera shows, bool [t]."""
        rendered = {camera: np.ones(self.length, bool) for camera in CAMERAS}
        if self.frames is not None:
            for camera, name in _IMAGE_KEYS.items():
                for k in range(self.length):
                    rendered[camera][k] = f"timestep_{k}/{name}" in self._group
        return rendered

    def subgoals(self) -> Iterator[dict[str, str]]:
        """The four texts of every step, as in `RawFrame`, without reading images."""
        subgoals: dict[str, str] = {}
        for k in range(self.length):
            if not subgoals or not self._flag(k, "info/is_completed"):
                place = f"timestep_{k}/info"
                subgoals = {name: self._text(f"{place}/{name}").lower() for name in SUBGOALS}
            yield subgoals

    def joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint angles and joint targets of every step, [t, 7] each, in the file's own
        precision.
        """
        steps = range(self.length)
        targets = np.stack([self._numbers(k, "action/joint_action") for k in steps])
        return np.stack([self._numbers(k, "obs/joint_state") for k in steps]), targets[:, :7]

    def pose_actions(self, column: str) -> np.ndarray:
        """A column of `POSE_ACTIONS`, [t, 7] float32.

        Of waypoints, which are noted when a motion begins: the one under way, and before the first
        one of the video or the execution that first one; a part without any is one motion to where
        it ends.
        """
        name = POSE_ACTIONS[column]
        is_motion = column == "waypoint_actions"
        steps = np.stack([self._numbers(k, name, absent=is_motion) for k in range(self.length)])
        if not is_motion:
            for k, pose in enumerate(steps):
                command = self._numbers(k, "action/joint_action")[-1]
                require(
                    pose[-1] == command,
                    f"{self._path(f'timestep_{k}/{name}')} commands {pose[-1]} to the gripper, and"
                    f" joint_action of the same step {command}. {REMEDY}",
                )
            return steps.astype(np.float32)
        is_known = np.isfinite(steps).all(1)
        is_lost = ~is_known & np.roll(is_known, 1)
        is_lost[[0, self.exec_start]] = False  # where the video and the execution begin
        require(
            not is_lost.any(),
            f"{self._path(f'timestep_{is_lost.argmax()}/{name}')} holds NaN after a step that has a"
            f" pose. {REMEDY}",
        )
        return known_poses(steps, self.exec_start, lambda k: self._numbers(k, "action/eef_action"))

    def tool_poses(self) -> np.ndarray:
        """Where the tool was at every step: position and roll, pitch, yaw, [t, 6] float32."""
        steps = [self._numbers(k, f"obs/{POSE_STATE}") for k in range(self.length)]
        return np.stack(steps).astype(np.float32)

    def choice_actions(self) -> np.ndarray:
        """What was chosen among `options`, [t, 10] float32: at the first frame of each, zeros at
        all others.
        """
        rows = np.zeros((self.length, len(CHOICE_NUMBERS)), np.float32)
        for k in range(self.length):
            begins = self._flag(k, "info/is_subgoal_boundary")
            if begins and self._flag(k, "info/is_completed"):
                begins = False
            if begins or k == self.exec_start:
                name = f"timestep_{k}/action/choice_action"
                with self._reported_at(name):
                    row = row_of(self._text(name), self.options)
                if row is not None:
                    rows[k] = row
        return rows

    @cached_property
    def options(self) -> list[dict[str, Any]]:
        """What could be chosen: `label`, `action` and `need_parameter` of each option."""
        values = parse_json(self._text(CHOICES[0]), self._path(CHOICES[0]), list)
        with self._reported_at(CHOICES[0]):
            options = read_options(values, len(LETTERS))
        return [option.to_dict() for option in options]

    def shot(self, step: int, camera: str) -> dict[str, np.ndarray]:
        """What a camera (`front`, `wrist`) recorded at a step, and where it stood.

        Returns:
            `colours` [H, W, 3] uint8; `depth` [H, W] float32 in millimetres; `intrinsic` [3, 3] and
            the world-to-camera `extrinsic` [3, 4] float64.
        """
        colours = self._image(step, camera)
        parts = {
            "depth": f"timestep_{step}/obs/{camera}_depth",
            "intrinsic": f"setup/{camera}_camera_intrinsic",
            "extrinsic": f"timestep_{step}/obs/{camera}_camera_extrinsic",
        }
        missing = [name for name in parts.values() if name not in self._group]
        require(
            not missing,
            f"{self.ref.file} {self.ref.group} lacks {', '.join(missing)}: record it with depth.",
        )
        shapes = {"depth": colours.shape[:2], "intrinsic": (3, 3), "extrinsic": (3, 4)}
        arrays: dict[str, np.ndarray] = {"colours": colours}
        for name, shape in shapes.items():
            valid = partial(_is_finite_array, size=math.prod(shape))
            values = self._checked(parts[name], valid, f"{list(shape)} finite numbers")
            precision = np.float32 if name == "depth" else np.float64
            arrays[name] = values.reshape(shape).astype(precision)
        return arrays

    @contextmanager
    def _reported_at(self, name: str) -> Iterator[None]:
        """Name the value that an error is about."""
        try:
            yield
        except UserError as error:
            raise UserError(f"{self._path(name)}: {error} {REMEDY}") from None

    def commanded_open(self, step: int) -> bool:
        """Whether the gripper's command at a step is to be open."""
        return bool(self._numbers(step, "action/joint_action")[7] > 0)

    def front(self, step: int) -> np.ndarray:
        return self._image(step, "front")

    def __iter__(self) -> Iterator[RawFrame]:
        # The latest image of each camera; before there is any, the first one that follows.
        latest: dict[str, np.ndarray] = {}
        for camera, rendered in self.rendered.items():
            require(
                rendered.any(),
                f"{self.ref.file} {self.ref.group} has no image of the camera {camera!r}. {REMEDY}",
            )
            latest[camera] = self._image(int(rendered.argmax()), camera)
        for k, subgoals in enumerate(self.subgoals()):
            joints = self._numbers(k, "obs/joint_state")
            fingers = self._numbers(k, "obs/gripper_state")[:1]
            now = frozenset(camera for camera, rendered in self.rendered.items() if rendered[k])
            for camera in now:
                latest[camera] = self._image(k, camera)
            yield RawFrame(
                **latest,
                rendered=now,
                state=np.concatenate([joints, fingers]).astype(np.float32),
                action=self._numbers(k, "action/joint_action"),
                is_demo=k < self.exec_start,
                subgoals=subgoals,
            )


def _is_finite_array(array: np.ndarray, size: int) -> bool:
    return array.size == size and bool(np.isfinite(array).all())


def _decode(value: Any) -> str:
    # Numbers would be read as the characters that their bytes are.
    if not isinstance(value, bytes | str):
        raise TypeError(f"a text is expected, not {brief(value)}")
    return value if isinstance(value, str) else str(value, "utf-8")


def find_files(inputs: Sequence[str | Path]) -> list[Path]:
    """Expand files and folders into HDF5 files, sorted by name."""
    files: set[Path] = set()
    for entry in map(Path, inputs):
        matches = sorted(entry.glob("*.h5")) if entry.is_dir() else [entry]
        if not matches or not all(path.is_file() for path in matches):
            advice = "give record_dataset_<Task>.h5 files or their folder."
            if (entry / "meta" / "info.json").is_file():
                advice = (
                    "it is a LeRobot dataset already, named by data.sources as it is. What"
                    " conversion keeps besides, such as keyframes, needs the HDF5 files: `mme-vla"
                    " record` writes them with hdf5=…"
                )
            raise UserError(f"No HDF5 file at {str(entry)!r}: {advice}")
        files.update(matches)
    return sorted(files, key=lambda path: (path.name, str(path)))


def list_episodes(files: Sequence[Path]) -> list[EpisodeRef]:
    """All episodes of these files: file by file, each in numerical order."""
    refs = []
    for file in files:
        task = re.sub(r"^record_dataset_", "", file.stem)
        numbers = []
        with _open(file) as handle, decoding(file, "HDF5", REMEDY):
            for name in handle:
                if re.fullmatch(r"episode_\d{1,9}", name):
                    numbers.append(int(name.removeprefix("episode_")))
        require(
            numbers,
            f"{file} has no episode_<number> group: it is not a RoboMME demonstration file.",
        )
        refs += [EpisodeRef(file, number, task) for number in sorted(numbers)]
    return refs


def recorded_options(refs: Sequence[EpisodeRef]) -> dict[str, Any]:
    """What was recorded with these episodes, as `ConvertOptions` names it.

    Returns:
        `poses`: the columns of `POSE_ACTIONS` that all episodes have. `tool_pose`, `choices`:
        whether all have the tool's poses, options and choices. `partly`: whether one of them has
        images of selected frames alone.

    Raises:
        UserError: two episodes have images of different sizes.
    """
    poses = list(POSE_ACTIONS)
    tool_pose = choices = True
    partly = False
    first: dict[str, Any] = {}
    groups: dict[Path, list[str]] = {}
    for ref in refs:
        groups.setdefault(ref.file, []).append(ref.group)
    for file, groups_of_file in groups.items():
        with _open(file) as handle:
            for group in groups_of_file:
                step = f"{group}/timestep_0"
                poses = [name for name in poses if f"{step}/{POSE_ACTIONS[name]}" in handle]
                tool_pose &= f"{step}/obs/{POSE_STATE}" in handle
                choices &= all(f"{group}/{name}" in handle for name in CHOICES)
                partly |= f"{group}/{FRAMES}" in handle
                image = handle.get(f"{step}/{_IMAGE_KEYS[CAMERAS[0]]}")
                if isinstance(image, H5Dataset):  # anything else is refused when it is read
                    first = first or {"shape": image.shape, "place": f"{file} {group}"}
                    require(
                        image.shape == first["shape"],
                        f"{file} {group} has images {list(image.shape)}, {first['place']}"
                        f" {list(first['shape'])}. All images of a dataset have one size: convert"
                        " them into two.",
                    )
    return {"poses": tuple(poses), "tool_pose": tool_pose, "choices": choices, "partly": partly}


@contextmanager
def open_episode(ref: EpisodeRef) -> Iterator[RawEpisode]:
    with _open(ref.file) as handle:
        with decoding(ref.file, "HDF5", REMEDY):
            group = handle.get(ref.group)
        require(group is not None, f"{ref.file} has no {ref.group}.")
        yield RawEpisode(ref, group)


@contextmanager
def _open(file: Path) -> Iterator[Any]:
    import h5py

    with decoding(require_file(file, "HDF5"), "HDF5", REMEDY):
        handle = h5py.File(file, "r")
    with handle:
        yield handle
