"""Small HDF5 files in the layout of RoboMME's recorder, and small datasets, for tests that need no
other data.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from omegaconf import OmegaConf

from mme_vla.config.composition import compose
from mme_vla.embodiment import Embodiment


@dataclass
class Recorded:
    """What a written episode holds, for comparison."""

    front: np.ndarray
    wrist: np.ndarray
    state: np.ndarray
    actions: np.ndarray


def pose_at(number: int) -> np.ndarray:
    """A pose of the tool and a gripper command, another for every number."""
    return np.array(
        [0.1 * number, 0.2, 0.3, np.pi, 0.0, 0.01 * number, 1.0 if number % 2 else -1.0]
    )


def tool_at(number: int) -> np.ndarray:
    """Where the tool is: short of the pose that is commanded, and on the other side of
    a half turn.
    """
    lag = np.array([0.01, -0.02, 0.001 * number, 0.05, 0.1, -0.1])
    return (pose_at(number)[:6] - lag + [0, 0, 0, -2 * np.pi, 0, 0]).astype(np.float32)


OPTIONS = [
    {"label": "a", "action": "pick up the cube", "need_parameter": True},
    {"label": "b", "action": "press the button", "need_parameter": False},
    {"label": "c", "action": "wait", "need_parameter": False},
]


def choice_at(number: int) -> dict[str, Any]:
    """A choice: pick up, press, press again, nothing at all, and from the start; only picking up
    has a point.
    """
    letter = ("A", "B", "B", "")[number % 4]
    return {"choice": letter, "point": [64, 128 + number] if letter == "A" else []}


def write_file(
    path: Path,
    lengths: Sequence[int],
    videos: Sequence[int] = (),
    numbers: Sequence[int] = (),
    size: int = 16,
    poses: bool = False,
    depth: bool = False,
    choices: bool = False,
) -> list[Recorded]:
    """Write an HDF5 file of random episodes: a square moves over a still background, "Complete" for
    the last steps.

    With `poses` they hold the tool's poses too, and a waypoint every fourth step: the first one
    after three. With `choices` something is chosen every fourth step, as `choice_at` says, among
    `OPTIONS`. With `depth` both cameras look down from one metre above the table at what stands 20
    cm high.
    """
    rng = np.random.default_rng(len(path.stem))
    videos, numbers = videos or [0] * len(lengths), numbers or range(len(lengths))
    recorded = []
    with h5py.File(path, "w") as file:
        for length, video, number in zip(lengths, videos, numbers, strict=True):
            episode = file.create_group(f"episode_{number}")
            episode["setup/task_goal"] = np.array(
                [f"Do Task {number}", "Another wording"], dtype=h5py.string_dtype()
            )
            episode["setup/seed"], episode["setup/difficulty"] = 100 * number, "easy"
            background = rng.integers(0, 255, (2, size, size, 3), np.uint8)
            frames = np.repeat(background[:, None], length, axis=1)
            for t in range(length):
                frames[:, t, t % size, :4] = 255
            joints, actions = rng.normal(size=(length, 7)), rng.normal(size=(length, 8))
            actions[:, 7] = [pose_at(t)[6] for t in range(length)]
            for t in range(length):
                step = episode.create_group(f"timestep_{t}")
                step["obs/front_rgb"], step["obs/wrist_rgb"] = frames[0, t], frames[1, t]
                step["obs/joint_state"] = joints[t].astype(np.float32)
                step["obs/gripper_state"] = np.array([0.04, 0.03], np.float32)
                step["action/joint_action"] = actions[t]
                if depth:
                    _add_depth(episode, step, size)
                if choices:
                    _add_choice(episode, step, t, t < length - 2)
                if poses:
                    since = t - video if t >= video else t
                    step["obs/eef_state"] = tool_at(t)
                    step["action/eef_action"] = pose_at(t)
                    step["action/waypoint_action"] = (
                        pose_at(100 + t // 4) if since >= 3 else np.full(7, np.nan)
                    )
                done = t >= length - 2
                for name in ("simple_subgoal", "grounded_subgoal"):
                    text = f"Pick Up {t // 4}" + (
                        " at <1, 2>" if name.startswith("grounded") else ""
                    )
                    step[f"info/{name}"] = "Complete" if done else text
                    step[f"info/{name}_online"] = "Complete" if done else text + " online"
                step["info/is_video_demo"], step["info/is_completed"] = t < video, done
            state = np.concatenate([joints, np.full((length, 1), 0.04)], axis=1).astype(np.float32)
            recorded.append(Recorded(frames[0], frames[1], state, actions))
    return recorded


def _add_choice(episode: h5py.Group, step: h5py.Group, t: int, goes_on: bool) -> None:
    """What is under way at a step; the last switch, to the end of the task, is marked too, as in
    the official files.
    """
    if t == 0:
        episode["setup/available_multi_choices"] = json.dumps(OPTIONS)
    step["action/choice_action"] = json.dumps(choice_at(t // 4))
    step["info/is_subgoal_boundary"] = t % 4 == 0 or not goes_on


def _add_depth(episode: h5py.Group, step: h5py.Group, size: int) -> None:
    """Two cameras one metre above the table that look straight down, with the view of a square half
    a metre wide.
    """
    down = np.array([[0, -1, 0, 0.0], [-1, 0, 0, 0.0], [0, 0, -1, 1.0]], np.float32)
    for camera in ("front", "wrist"):
        step[f"obs/{camera}_depth"] = np.full((size, size, 1), 800, np.int16)
        step[f"obs/{camera}_camera_extrinsic"] = down
        if f"setup/{camera}_camera_intrinsic" not in episode:
            focal, centre = 2.0 * size, size / 2
            intrinsic = np.array([[focal, 0, centre], [0, focal, centre], [0, 0, 1]], np.float32)
            episode[f"setup/{camera}_camera_intrinsic"] = intrinsic


def robomme_robot(name: str, *words: str) -> Embodiment:
    """The embodiment of that name, with changes of its configuration."""
    section: Any = OmegaConf.to_container(
        compose("policy", [f"embodiment={name}", *words]).embodiment, resolve=True
    )
    return Embodiment.from_dict(section)
