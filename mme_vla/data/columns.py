"""Which columns of a dataset hold a robot's pictures, states and actions; both of LeRobot's spellings are taken."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mme_vla.data.hdf5_episode import SUBGOALS
from mme_vla.embodiment import Camera, Embodiment
from mme_vla.embodiment.actions import POSE_WIDTH
from mme_vla.errors import UserError, brief, listed

OPTIONAL = ("is_demo", "exec_start_idx", *SUBGOALS)
DRAWN = "_drawn"
"""After a camera's name: the column that says which frames it was drawn at, where not at all."""
NAMES: Mapping[str, Mapping[str, str]] = {
    "robomme": {},
    "lerobot": {
        "image": "observation.images.image",
        "wrist_image": "observation.images.wrist_image",
        "state": "observation.state",
        "actions": "action",
    },
}
"""Spellings of a dataset's columns, each by how it differs from the released datasets'."""
_USUAL = {"state": ("observation.state",), "action": ("action", "actions")}


@dataclass(frozen=True)
class Columns:
    """Where things are: a column for every camera, and those whose numbers, joined, are the state and the action.

    pose: the same of the tool's pose, where actions are differences to it.
    tables: the columns that are read from the tables; pictures are among them only where they are stored there.
    """

    cameras: Mapping[str, str]
    state: tuple[str, ...]
    action: tuple[str, ...]
    pose: tuple[str, ...]
    tables: tuple[str, ...]


def find_columns(root: Path, features: Mapping[str, Mapping[str, Any]], robot: Embodiment) -> Columns:
    """Match a robot with a dataset.

    Raises:
        UserError: a feature is absent, or the numbers are more or fewer than the robot's; `root` is for the message.
    """
    found = {
        **{camera.name: _first(_spellings_of(camera), features) for camera in robot.cameras},
        **{key: _first((key, f"observation.{key}"), features) for key in robot.state.key},
        **{key: _first((key, *_also(key)), features) for key in robot.action.key},
        **{key: _first((key, f"observation.{key}"), features) for key in robot.action.pose_key},
    }
    if not robot.state.key:
        found["state"] = _first(("observation.state", "state"), features)
    if not robot.action.key:
        found["action"] = _first(("action", "actions"), features)
    keys = {camera.name: camera.key or camera.name for camera in robot.cameras}
    missing = [keys.get(name, name) for name, column in found.items() if column is None]
    if missing:
        raise UserError(
            f"{root} lacks the feature{'s'[: len(missing) > 1]} {', '.join(missing)}; it has {listed(features)}. "
            f"These are the names of the robot {robot.name!r}: choose embodiment=<the robot this dataset is of>, or "
            "name its columns in a configs/embodiment file of your own. (RoboMME's poses and waypoints are columns of "
            "datasets that this library converts or records.)"
        )
    columns = {name: str(column) for name, column in found.items()}
    cameras = {name: columns[name] for name in robot.camera_names}
    for name, column in cameras.items():
        if features[column]["dtype"] not in ("image", "video"):
            raise UserError(
                f"{root}: {column} holds {brief(features[column]['dtype'])}, no pictures: it cannot be the camera "
                f"{name!r} of the robot {robot.name!r} (embodiment.cameras.{name}.key)."
            )
    state = tuple(columns[key] for key in robot.state.key or ("state",))
    action = tuple(columns[key] for key in robot.action.key or ("action",))
    _check_width(root, "state", state, features, robot.state.width, robot)
    _check_width(root, "action", action, features, robot.action.width, robot)
    pose = tuple(columns[key] for key in robot.action.pose_key)
    if pose:
        _check_width(root, "tool's pose", pose, features, POSE_WIDTH, robot)
    tables = ["episode_index", *state, *action, *pose, *(name for name in OPTIONAL if name in features)]
    tables += [f"{name}{DRAWN}" for name in cameras if f"{name}{DRAWN}" in features]
    tables += [column for column in cameras.values() if features[column]["dtype"] == "image"]
    return Columns(cameras, state, action, pose, tuple(dict.fromkeys(tables)))


def width_of(feature: Mapping[str, Any]) -> int:
    """How many numbers a row of this feature holds."""
    shape = tuple(feature["shape"])
    return shape[0] if len(shape) == 1 else 0


def names_of(features: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """What a dataset calls the numbers of some features, joined; empty where one of them has no name for each number.

    LeRobot writes a list, or a list under one key such as `motors`.
    """
    names: list[str] = []
    for feature in features:
        listed = feature.get("names")
        if isinstance(listed, Mapping) and len(listed) == 1:
            listed = next(iter(listed.values()))
        if not isinstance(listed, list | tuple) or len(listed) != width_of(feature):
            return ()
        names += map(str, listed)
    return tuple(names)


def _spellings_of(camera: Camera) -> list[str]:
    names = [camera.key, camera.name] if camera.key else [camera.name]
    return [spelling for name in names for spelling in (name, f"observation.images.{name}")]


def _also(key: str) -> tuple[str, ...]:
    return tuple(name for name in _USUAL["action"] if key in _USUAL["action"] and name != key)


def _first(names: Iterable[str], features: Mapping[str, Any]) -> str | None:
    return next((name for name in names if name in features), None)


def _check_width(
    root: Path,
    what: str,
    columns: Sequence[str],
    features: Mapping[str, Mapping[str, Any]],
    width: int,
    robot: Embodiment,
) -> None:
    if sum(width_of(features[name]) for name in columns) != width:
        shapes = ", ".join(f"{name} has shape {list(features[name]['shape'])}" for name in columns)
        raise UserError(f"{root}: {shapes}; expected [{width}], the {what} of the robot {robot.name!r}.")
