"""What clients say: two message schemas, told apart by their keys, checked whole before anything is
done.

The MME-VLA schema (openpi's, with memory) sends past frames and the current observation apart:
`add_buffer`, then an `observation/…` message. The RoboMME challenge sends lists of all frames since
its last request. Both reset alike.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mme_vla.embodiment import ROBOMME_JOINT, Embodiment, Option
from mme_vla.embodiment.action_space import read_options
from mme_vla.embodiment.robomme import ARM_JOINTS, benchmark_state
from mme_vla.errors import UserError, did_you_mean, require
from mme_vla.utils import is_text

POSE = (3, 4)
DEEPEST = 32_767  # millimetres: the benchmark's depth is int16


def read_beside(
    robot: Embodiment, images: Mapping[str, np.ndarray], message: Mapping[str, Any], key: str
) -> dict[str, np.ndarray]:
    """Depth and poses of every camera that has them, one for each of its images.

    Args:
        images: [t, H, W, 3] by camera. message: lists (or arrays) of t readings. key: how it spells
            their names.

    Returns:
        By the robot's names: depth float32 [t, H, W, 1] in millimetres, poses float32 [t, 3, 4]
        from the world to the camera.
    """
    readings = {}
    for camera in robot.cameras:
        for name, shape in zip(
            camera.readings, (images[camera.name].shape[1:3], POSE), strict=False
        ):
            readings[name] = _reading_rows(
                key.format(name), message, len(images[camera.name]), shape
            )
        if camera.readings:
            depth = camera.readings[0]
            if (readings[depth] < 0).any() or (readings[depth] > DEEPEST).any():
                raise UserError(f"{key.format(depth)} must be millimetres from 0 to {DEEPEST}.")
            readings[depth] = readings[depth][..., None]
    return readings


def _reading_rows(
    key: str, message: Mapping[str, Any], count: int, shape: tuple[int, ...]
) -> np.ndarray:
    if key not in message:
        expected = (
            "one pose [3, 4] from the world to the camera"
            if shape == POSE
            else "depth in millimetres"
        )
        raise UserError(
            f"The request lacks {key}: this policy reads {expected} beside every image of the"
            " camera."
        )
    value = message[key]
    rows = (
        list(value)
        if isinstance(value, list) or (isinstance(value, np.ndarray) and value.ndim)
        else None
    )
    if rows is None or len(rows) != count:
        got = type(value).__name__ if rows is None else f"{len(rows)} entries"
        raise UserError(f"{key} must have one entry for each of {count} frames, got {got}.")
    readings = []
    for row in rows:
        try:
            array = np.asarray(row)
        except ValueError:  # rows of different lengths
            array = np.empty(0, object)
        fits = array.dtype.kind in "fiu" and array.shape in (shape, (*shape, 1))
        got = (
            f"{array.dtype} {list(array.shape)}"
            if isinstance(row, np.ndarray)
            else type(row).__name__
        )
        require(fits, f"{key} must hold arrays {list(shape)} of numbers, got {got}.")
        readings.append(_numbers(key, array).reshape(shape))
    return np.stack(readings)


SUBGOALS = ("simple_subgoal", "grounded_subgoal")
OPTIONS = (  # beside an observation, for policies that choose; the benchmark's name
    "available_multi_choices"
)
IMAGE_KEYS = {
    "front": "observation/image",
    "wrist": "observation/wrist_image",
}  # openpi's names of RoboMME's cameras
MOST_GOAL = 4000  # characters
SIDES = (8, 4096)  # pixels of an image's side
KNOWN = ("reset", "add_buffer", "observation/image", "front_rgb_list")


@dataclass(frozen=True)
class Reset:
    """Forget the episode and begin another."""


@dataclass(frozen=True)
class AddBuffer:
    """Frames to remember, the current one included; nothing is chosen yet.

    frames: t images [H, W, 3] uint8 of the camera that feeds memory.
    exec_start: index of the episode's first execution frame; 0 where it is not said.
    states: what the robot felt at these frames, [t, s]; only a memory of its own motion needs them.
    """

    frames: Sequence[np.ndarray]
    exec_start: int
    states: np.ndarray | None = None


@dataclass(frozen=True)
class Infer:
    """Choose a chunk.

    images: the current ones, by camera. state [s]. goal: the task in words. subgoals: by kind,
    those given. frames: frames to remember first, the current one last (challenge); None where they
    came by `add_buffer`. first: whether the message begins an episode; None where the schema does
    not say. options: what can be chosen, for a policy that chooses; none where they stay as they
    were. states: what the robot felt at `frames`, [t, s].
    observed: for a robot that reads more than images, all that its cameras delivered at the frames
    of this message, in
        the form of `Episode.observe`: images by camera, depth and poses; `states` goes with it.
    """

    images: Mapping[str, np.ndarray]
    state: np.ndarray
    goal: str
    subgoals: Mapping[str, str] = field(default_factory=dict)
    frames: Sequence[np.ndarray] | None = None
    first: bool | None = None
    options: tuple[Option, ...] = ()
    states: np.ndarray | None = None
    observed: Mapping[str, np.ndarray] | None = None


Request = Reset | AddBuffer | Infer


def parse(message: Any, most_frames: int, robot: Embodiment = ROBOMME_JOINT) -> Request:
    """Recognise a decoded message.

    Args:
        most_frames: longest list of frames taken. robot: the policy's, which says what an
            observation is made of.
    """
    require(isinstance(message, dict), f"A request is a map, got {type(message).__name__}.")
    space_name = robot.action.answers
    space = message.get("action_space", space_name)
    require(
        space == space_name,
        f"action_space={str(space)[:40]!r}: this policy returns {space_name} only.",
    )
    if _flag(message, "reset"):
        return Reset()
    if _flag(message, "add_buffer"):
        return _add_buffer(message, most_frames, robot)
    require(
        not robot.action.of_pose or "action_space" in message,
        "This policy returns differences to the tool's pose at each step, to be added to the pose"
        f" at that step: send action_space={space_name!r} in the request to confirm it.",
    )
    if "front_rgb_list" in message or "task_goal" in message:
        return _challenge(message, most_frames, robot)
    if any(isinstance(key, str) and key.startswith("observation/") for key in message):
        return _observation(message, robot)
    keys = [key for key in message if isinstance(key, str)][:10]
    require(
        not keys or not set(keys) <= set(KNOWN),  # flags: true was handled above
        f"{' and '.join(f'{key}=false' for key in keys)}: no request. Send reset=true, or an"
        " observation with the keys observation/image, … or front_rgb_list, …",
    )
    unknown = [key for key in keys if key not in KNOWN]
    near = did_you_mean(unknown[0], KNOWN) if unknown else f"Known: {', '.join(KNOWN)}."
    raise UserError(f"No known request has the keys {keys}. {near}")


def _flag(message: dict[Any, Any], key: str) -> bool:
    """Whether a message says `key`; false beside other keys is as good as leaving it out."""
    value = message.get(key, False)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if value is None or (type(value) is int and value in (0, 1)):
        return value == 1
    raise UserError(f"{key} must be true or false, got {type(value).__name__}.")


def _add_buffer(message: dict[Any, Any], most_frames: int, robot: Embodiment) -> AddBuffer:
    require(
        not robot.readings,
        f"This policy reads {', '.join(robot.readings)} at every frame, and add_buffer has no place"
        " for them: send past frames in the challenge's lists, and the current one in either"
        " schema.",
    )
    images = _array(message, "images")
    if images.ndim != 5 or images.shape[1] != 1:
        raise UserError(
            f"images must be uint8 [frames, 1, height, width, 3], got {images.dtype}"
            f" {list(images.shape)}."
        )
    count = len(images)
    frames = _frames("images", list(images[:, 0]), most_frames)
    states = _numbers("state", _array(message, "state"))
    width = robot.state.width
    require(
        states.shape == (count, width),
        f"state must be [{count}, {width}], one row a frame, got {list(states.shape)}.",
    )
    start = message.get("exec_start_idx", 0)
    if isinstance(start, np.integer):
        start = int(start)
    require(
        type(start) is int and start >= 0,
        f"exec_start_idx must be a whole number from 0, got {str(start)[:40]!r}.",
    )
    return AddBuffer(frames, start, states)


def _observation(message: dict[Any, Any], robot: Embodiment) -> Infer:
    keys = {name: IMAGE_KEYS.get(name, f"observation/{name}") for name in robot.camera_names}
    images = {name: _image(key, _get(message, key)) for name, key in keys.items()}
    state = _numbers("observation/state", _array(message, "observation/state"))
    if state.shape != (robot.state.width,):
        raise UserError(
            f"observation/state must be [{robot.state.width}], got {list(state.shape)}."
        )
    goal, options = _goal("prompt", _get(message, "prompt")), _options(message, robot)
    if not robot.readings:
        return Infer(images, state, goal, _subgoals(message), options=options)
    readings = {
        f"observation/{name}": [_get(message, f"observation/{name}")] for name in robot.readings
    }
    frames = {name: image[None] for name, image in images.items()}
    frames |= read_beside(robot, frames, readings, "observation/{}")
    return Infer(
        images,
        state,
        goal,
        _subgoals(message),
        options=options,
        states=state[None],
        observed=frames,
    )


def _challenge(message: dict[Any, Any], most_frames: int, robot: Embodiment) -> Infer:
    require(
        robot.action.space is not None,
        f"The robot {robot.name!r} is not the benchmark's: send observation/… messages.",
    )
    keys = {name: f"{name}_rgb_list" for name in robot.camera_names}
    views = {name: _frames(key, _get(message, key), most_frames) for name, key in keys.items()}
    sizes = (("joint_state_list", ARM_JOINTS), ("gripper_state_list", 2))
    joints, grippers = (_rows(message, key, size) for key, size in sizes)
    lengths = {keys[name]: len(view) for name, view in views.items()}
    lengths |= {"joint_state_list": len(joints), "gripper_state_list": len(grippers)}
    if len(set(lengths.values())) != 1:
        counts = ", ".join(f"{key} has {length}" for key, length in lengths.items())
        raise UserError(f"All lists need one entry a frame: {counts}.")
    first = _get(message, "is_first_step")
    require(
        isinstance(first, bool | np.bool_),
        f"is_first_step must be true or false, got {type(first).__name__}.",
    )
    goal = _goal("task_goal", _get(message, "task_goal"))
    states = np.stack([benchmark_state(*proprio) for proprio in zip(joints, grippers, strict=True)])
    images = {name: view[-1] for name, view in views.items()}
    frames, options = views[robot.memory_camera], _options(message, robot)
    frame_views = None
    if robot.readings:
        frame_views = {name: np.stack(view) for name, view in views.items()}
        frame_views |= read_beside(robot, frame_views, message, "{}_list")
    return Infer(
        images,
        states[-1],
        goal,
        _subgoals(message),
        frames,
        bool(first),
        options,
        states,
        frame_views,
    )


def _subgoals(message: dict[Any, Any]) -> dict[str, str]:
    return {key: _text(key, message[key]) for key in SUBGOALS if message.get(key) is not None}


def _options(message: dict[Any, Any], robot: Embodiment) -> tuple[Option, ...]:
    """What the message offers to a robot that chooses; others are not offered anything."""
    letters = len(robot.action.choice)
    return (
        read_options(message[OPTIONS], letters)
        if letters and message.get(OPTIONS) is not None
        else ()
    )


def _get(message: dict[Any, Any], key: str) -> Any:
    if key not in message:
        raise UserError(
            f"The request lacks {key}; it has {sorted(str(k)[:40] for k in list(message)[:20])}."
        )
    return message[key]


def _array(message: dict[Any, Any], key: str) -> np.ndarray:
    value = _get(message, key)
    if isinstance(value, list):  # plain numbers are as good
        try:
            value = np.asarray(value)
        except (ValueError, TypeError, OverflowError):
            value = None
    require(isinstance(value, np.ndarray), f"{key} must be an array.")
    return value


def _numbers(key: str, value: np.ndarray) -> np.ndarray:
    require(value.dtype.kind in "fiu", f"{key} must hold numbers, got dtype {value.dtype}.")
    with np.errstate(over="ignore"):
        numbers = value.astype(np.float32)
    require(np.isfinite(numbers).all(), f"{key} holds numbers that are not finite.")
    return numbers


def _rows(message: dict[Any, Any], key: str, size: int) -> list[np.ndarray]:
    rows = _get(message, key)
    if isinstance(rows, np.ndarray):
        rows = list(rows) if rows.ndim else None
    require(isinstance(rows, list), f"{key} must be a list of arrays [{size}].")
    arrays = [_numbers(key, _array({key: row}, key)) for row in rows]
    for row in arrays:
        require(row.shape == (size,), f"{key} must hold arrays [{size}], got {list(row.shape)}.")
    return arrays


def _frames(key: str, frames: Any, most: int) -> list[np.ndarray]:
    if isinstance(frames, np.ndarray):
        frames = list(frames) if frames.ndim == 4 else None
    require(isinstance(frames, list), f"{key} must be a list of uint8 images [height, width, 3].")
    if not 1 <= len(frames) <= most:
        raise UserError(
            f"{key} holds {len(frames)} frames; this server takes 1 … {most} (limits.frames)."
        )
    shapes = {_image(key, frame).shape for frame in frames}
    require(len(shapes) <= 1, f"All images of {key} need one size, got {sorted(shapes)[:3]}.")
    return frames


def _image(key: str, image: Any) -> np.ndarray:
    array = isinstance(image, np.ndarray)
    got = f"{image.dtype} {list(image.shape)}" if array else type(image).__name__
    fits = array and image.dtype == np.uint8 and image.ndim == 3 and image.shape[-1] == 3
    require(fits, f"{key} must be a uint8 image [height, width, 3], got {got}.")
    low, high = sorted(image.shape[:2])
    require(
        low >= SIDES[0] and high <= SIDES[1],
        f"{key}: an image's sides are {SIDES[0]} … {SIDES[1]} pixels, got {got}.",
    )
    require(high <= 8 * low, f"{key}: an image {got} is too narrow to be scaled into a square.")
    checked: np.ndarray = image
    return checked


def _goal(key: str, value: Any) -> str:
    goal = _text(key, value)
    require(
        goal.strip(),
        f"{key} is {goal[:40]!r}: a policy is told what to do in words. Send the task as a text.",
    )
    return goal


def _text(key: str, value: Any) -> str:
    if isinstance(value, list | tuple) and value:
        value = value[0]  # the benchmark gives a goal as a list of wordings
    if not isinstance(value, str):
        raise UserError(
            f"{key} must be a text (or a list that begins with one), got {type(value).__name__}."
        )
    require(
        len(value) <= MOST_GOAL,
        f"{key} has {len(value)} characters; at most {MOST_GOAL} are taken.",
    )
    require(
        is_text(value),
        f"{key} holds half of a surrogate pair, which is no character: {value[:40]!a}.",
    )
    return str(value)
