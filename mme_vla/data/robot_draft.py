"""A first version of the YAML file of a robot, from what a dataset says of itself."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mme_vla.data.hdf5 import SUBGOALS
from mme_vla.data.lerobot_files import Feature, Info, names_of
from mme_vla.errors import listed, printable, require
from mme_vla.utils import write_text

CHECK = "check:"
"""Begins the comments of lines that a dataset cannot tell."""
_PREFIX = "observation.images."
_ON_A_HAND = re.compile(r"wrist|hand|gripper|tool|eef", re.IGNORECASE)
_GRIPPER = re.compile(r"gripper|finger|jaw|claw", re.IGNORECASE)
_UNQUOTED = re.compile(r"[A-Za-z_][A-Za-z0-9_.\-]*")
_WORDS = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
"""Texts that YAML takes for values."""
HORIZON, EXECUTE = 20, 16
"""As the paper's robot has them."""


@dataclass(frozen=True)
class RobotDraft:
    """The file, and what of it only its reader knows.

    name: of the robot, and of the file.
    text: of the file.
    open_lines: the lines to check.
    """

    name: str
    text: str
    open_lines: tuple[str, ...]


def draft_robot(root: Path, info: Info, taken: Sequence[str] = ()) -> RobotDraft:
    """Write the YAML file of the robot that a dataset is of.

    Cameras, widths, names and rate are the dataset's. Guessed, and marked so: the camera that feeds
    memory, columns that are joined, cameras that move with a hand (by their names), numbers that
    are relative to the state (those that state and action call the same, without grippers), and
    the length of chunks.

    Args:
        root: of the dataset; its folder's name becomes the robot's.
        info: its description.
        taken: names that other robots have.

    Raises:
        UserError: no camera, no state or no action was found.
    """
    name = re.sub(r"\W+", "_", root.resolve().name.lower(), flags=re.ASCII).strip("_") or "robot"
    if name in taken or name in _WORDS or name[0].isdigit():
        name = f"own_{name}"
    cameras = _cameras(info.features)
    state = _vectors(info.features, ("observation.state", "state"), "observation.")
    action = _vectors(info.features, ("action", "actions"), "action")
    needed = {"a camera": cameras, "a state": state, "an action": action}
    absent = [part for part, columns in needed.items() if not columns]
    require(
        not absent,
        f"{root} has no column of {' and none of '.join(absent)}, and a policy needs all three:"
        f" observation.images.<camera>, observation.state and action. It has"
        f" {listed(info.features)}. Name others in a file of your own, which"
        " docs/extend/your-robot.md explains, or record them.",
    )
    state_features = [info.features[column] for column in state]
    action_features = [info.features[column] for column in action]
    state_width = sum(feature.width for feature in state_features)
    action_width = sum(feature.width for feature in action_features)
    relative = _relative(names_of(state_features), names_of(action_features))

    lines = [
        f"# Drafted from meta/info.json of {printable(root.name)}; “{CHECK}” marks guesses.",
        f"name: {name}",
        "cameras: # in the order the network sees them",
    ]
    for camera, column in cameras.items():
        lines += _camera_lines(camera, column, info.features[column])
    first = next(iter(cameras))
    lines.append(f"memory_camera: {_text(first)} # {CHECK} the camera whose frames memories store")
    lines.append("state:")
    lines += _key_lines(state, ("observation.state", "state"))
    lines.append(f"  width: {state_width}")
    lines.append("action:")
    lines += _key_lines(action, ("action", "actions"))
    lines.append(f"  width: {action_width}")
    names = names_of(action_features)
    if names:
        lines.append(f"  names: [{', '.join(map(_text, names))}]")
    lines.append(
        f"  relative: [{', '.join(map(str, relative))}] # {CHECK} numbers that are positions of the"
        " state's number at the same place; grippers and velocities are not"
    )
    seconds = HORIZON / info.fps
    lines.append(
        f"  horizon: {HORIZON} # {CHECK} actions of a chunk, {seconds:.2g} s at {info.fps:g} frames"
        " per second"
    )
    lines.append(f"  execute: {EXECUTE} # {CHECK} of which so many are executed")
    lines.append(f"fps: {str(info.fps).removesuffix('.0')}")  # all digits: 29.97002997002997
    marks_video = "is_demo" in info.features or "exec_start_idx" in info.features
    lines.append(
        f"conditioning_video: {str(marks_video).lower()} # whether episodes may begin with a video"
    )
    open_lines = [line.strip() for line in lines[1:] if CHECK in line]
    return RobotDraft(name, "\n".join(lines) + "\n", tuple(open_lines))


def _cameras(features: Mapping[str, Feature]) -> dict[str, str]:
    """The columns of colour images, each under a name for the camera."""
    cameras: dict[str, str] = {}
    for column, feature in features.items():
        about = feature.about_images
        is_depth = bool(about.get("is_depth_map", about.get("video.is_depth_map", False)))
        if feature.dtype not in ("image", "video") or is_depth:
            continue
        name = re.sub(r"[^\w\-]+", "_", column.removeprefix(_PREFIX)) or "camera"
        if name == "state" or name in cameras:  # a message has the state under this name
            name = f"{name}_{len(cameras) + 1}"
        cameras[name] = column
    return cameras


def _vectors(
    features: Mapping[str, Feature], defaults: Sequence[str], prefix: str
) -> tuple[str, ...]:
    """The columns that are the state or the action: the usual one, else all numbers whose names
    begin alike.
    """
    for column in defaults:
        if column in features and features[column].width:
            return (column,)
    columns = []
    for column, feature in features.items():
        # A gripper is often a flag or a whole number beside the joints.
        is_vector = feature.width and feature.dtype.startswith(("float", "int", "uint", "bool"))
        if is_vector and column.startswith(prefix) and column not in SUBGOALS:
            columns.append(column)
    return tuple(columns)


def _relative(state: Sequence[str], action: Sequence[str]) -> list[int]:
    """Places that state and action call the same, without grippers; none where names are
    missing.
    """
    places = []
    for place, (before, after) in enumerate(zip(state, action, strict=False)):
        if before == after and not _GRIPPER.search(after):
            places.append(place)
    return places


def _camera_lines(name: str, column: str, feature: Feature) -> list[str]:
    augment, why = "all", "a fixed camera; colour: one that moves with a hand"
    if _ON_A_HAND.search(name):
        augment, why = "colour", "a camera that moves with a hand; all: a fixed one"
    lines = [f"  {_text(name)}: # {' × '.join(map(str, feature.shape))}"]
    if column not in (name, f"{_PREFIX}{name}"):
        lines.append(f"    key: {_text(column)}")
    lines.append(f"    augment: {augment} # {CHECK} {why}")
    return lines


def _key_lines(columns: Sequence[str], defaults: Sequence[str]) -> list[str]:
    if len(columns) == 1 and columns[0] in defaults:
        return []
    return [f"  key: [{', '.join(map(_text, columns))}] # {CHECK} the columns that are joined"]


def _text(value: str) -> str:
    """A text in YAML that stays the text it is: no value, and no reference to another key."""
    if _UNQUOTED.fullmatch(value) and value.lower() not in _WORDS:
        return value
    return json.dumps(value.replace("${", "\\${"), ensure_ascii=False)


def save_draft(draft: RobotDraft, folder: Path) -> tuple[Path, bool]:
    """Write a draft to `folder`/embodiment, where `--config-dir folder` finds it; a file of that
    name stays as it is.

    Returns:
        The file, and whether it was written now.
    """
    path = folder / "embodiment" / f"{draft.name}.yaml"
    if path.exists():
        return path, False
    write_text(path, draft.text)
    return path, True
