"""Requests: what clients send, checked completely before anything is done.

There are two message schemas, told apart by their keys. The MME-VLA schema (openpi's, with memory)
sends past frames and the current observation apart: `add_buffer`, then an `observation/…` message.
The RoboMME challenge sends lists of all frames since its last request. Both reset alike.

`RequestReader` turns a decoded message into a `Reset`, an `AddBuffer` or an `Infer`. The code
behind it trusts these.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    AliasChoices,
    BaseModel,
    BeforeValidator,
    FailFast,
    Field,
    PlainValidator,
    StrictBool,
    StrictInt,
    create_model,
)

from mme_vla.embodiment import Embodiment, Option
from mme_vla.embodiment.action_space import read_options
from mme_vla.embodiment.robomme import ARM_JOINTS, benchmark_state
from mme_vla.errors import UserError, counted, did_you_mean, require
from mme_vla.utils import is_text
from mme_vla.utils.validation import described, validated


def _integer(value: Any) -> Any:
    return int(value) if isinstance(value, np.integer) else value


@dataclass(frozen=True)
class Reset:
    """Forget the episode and begin another.

    seed: of its noise; None for the server's.
    """

    seed: Annotated[StrictInt, Field(ge=0, lt=2**63), BeforeValidator(_integer)] | None = None


@dataclass(frozen=True)
class AddBuffer:
    """Store frames, the current one included, without choosing actions.

    frames: t images [H, W, 3] uint8 of the camera that feeds memory.
    exec_start: index of the episode's first execution frame; 0 where the client does not say.
    states: the robot's state at these frames, [t, s] float32.
    """

    frames: Sequence[np.ndarray]
    exec_start: int
    states: np.ndarray


@dataclass(frozen=True)
class Infer:
    """Choose a chunk of actions.

    goal: the task in words.
    views: what the cameras delivered at t frames, the current one last. Images by camera, each
        [t, H, W, 3] uint8; for a robot that reads them also depth [t, H, W, 1] and poses [t, 3, 4].
    states: [t, s] float32.
    stored: whether the frames go into memory; False where they came by `AddBuffer`, and t is 1.
    first: whether the message begins an episode; None in the MME-VLA schema, which does not say.
    exec_start: index of the episode's first execution frame, in the message that begins it; None
        where the last frame of that message is the first.
    executed: actions [k, w] that led to the last k frames, where the client says so; None for
        those of the last chunk.
    subgoals: by kind; kinds that the message lacks are left out.
    options: what can be chosen, for a policy that chooses; empty where the options stay as they
        were.
    """

    goal: str
    views: Mapping[str, Sequence[np.ndarray]]
    states: np.ndarray
    stored: bool
    first: bool | None = None
    exec_start: int | None = None
    executed: np.ndarray | None = None
    subgoals: Mapping[str, str] = field(default_factory=dict)
    options: tuple[Option, ...] = ()


Request = Reset | AddBuffer | Infer


# Values of messages. The text of a ValueError continues the name of the key.

MOST_TEXT = 4000  # characters of a goal or a subgoal
SIDES = (8, 4096)  # pixels of an image's side
NARROWEST = 8  # times that one side of an image may be longer than the other
DEEPEST = 32_767  # millimetres: the benchmark's depth is int16


def _image(value: Any) -> np.ndarray:
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8:
        raise ValueError("must be a uint8 image [height, width, 3]")
    if value.ndim != 3 or value.shape[-1] != 3:
        raise ValueError("must be a uint8 image [height, width, 3]")
    short, long = sorted(value.shape[:2])
    if short < SIDES[0] or long > SIDES[1]:
        raise ValueError(f"must have sides of {SIDES[0]} to {SIDES[1]} pixels")
    if long > NARROWEST * short:
        raise ValueError("is too narrow to be scaled into a square")
    return value


def _images(value: Any) -> list[Any]:
    if isinstance(value, np.ndarray) and value.ndim == 4:
        return list(value)
    if not isinstance(value, list):
        raise ValueError("must be a list of uint8 images [height, width, 3]")
    return value


def _buffer(value: Any) -> list[Any]:
    if not isinstance(value, np.ndarray) or value.ndim != 5 or value.shape[1] != 1:
        raise ValueError("must be uint8 [frames, 1, height, width, 3]")
    return list(value[:, 0])


def _counted(images: list[Any], least: int, most: int) -> list[Any]:
    if not least <= len(images) <= most:
        raise ValueError(
            f"holds {counted(len(images), 'frame')}; this server takes {least} … {most}"
            f" (limits.frames)."
        )
    return images


def _same_size(images: list[np.ndarray]) -> list[np.ndarray]:
    sizes = sorted({image.shape for image in images})
    if len(sizes) > 1:
        raise ValueError(f"must hold images of one size, got {sizes[:3]}.")
    return images


def _numbers(value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Finite float32 numbers of a shape, in which None stands for one row a frame."""
    words = ", ".join("frames" if size is None else str(size) for size in shape)
    expected = f"must be an array of numbers [{words}]"
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, OverflowError):  # rows of different lengths
        raise ValueError(expected) from None
    if array.shape == (0,) and shape[0] is None:  # an empty list of rows
        array = array.reshape(0, *[size or 0 for size in shape[1:]])
    if array.dtype.kind not in "fiu" or array.ndim != len(shape):
        raise ValueError(expected)
    for size, expected_size in zip(array.shape, shape, strict=True):
        if expected_size is not None and size != expected_size:
            raise ValueError(expected)
    return _finite(array)


def _finite(array: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        numbers = array.astype(np.float32)
    if not np.isfinite(numbers).all():
        raise ValueError("holds numbers that are not finite.")
    return numbers


def _depth(value: Any, n_axes: int) -> np.ndarray:
    """Depth [H, W] or [t, H, W] in millimetres as float32, with a last axis of 1."""
    expected = "must be depth in millimetres, one number a pixel"
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, OverflowError):  # images of different sizes
        raise ValueError(expected) from None
    if array.ndim == n_axes + 1 and array.shape[-1] == 1:
        array = array[..., 0]
    if array.dtype.kind not in "fiu" or array.ndim != n_axes:
        raise ValueError(expected)
    depth = _finite(array)
    if (depth < 0).any() or (depth > DEEPEST).any():
        raise ValueError(f"must be millimetres from 0 to {DEEPEST}.")
    return depth[..., None]


def _text(value: Any) -> str:
    if isinstance(value, list | tuple) and value:
        value = value[0]  # the benchmark gives a goal as a list of wordings
    if not isinstance(value, str):
        raise ValueError("must be a text (or a list that begins with one)")
    if len(value) > MOST_TEXT:
        raise ValueError(f"has {len(value)} characters; at most {MOST_TEXT} are taken.")
    if not is_text(value):
        raise ValueError(f"holds half of a surrogate pair, which is no character: {value[:40]!a}.")
    return value


def _goal(value: str) -> str:
    if not value.strip():
        raise ValueError(
            f"is {value[:40]!r}: a policy is told what to do in words. Send the task as a text."
        )
    return value


def _truth(value: Any) -> Any:
    return bool(value) if isinstance(value, np.bool_) else value


def _flag(value: Any) -> Any:
    """A flag that some clients send as a number, or leave empty."""
    if value is None or (type(value) is int and value in (0, 1)):
        return value == 1
    return _truth(value)


Image = Annotated[np.ndarray, PlainValidator(_image)]
Text = Annotated[str, PlainValidator(_text)]
Goal = Annotated[Text, AfterValidator(_goal)]
Truth = Annotated[StrictBool, BeforeValidator(_truth)]
Flag = Annotated[StrictBool, BeforeValidator(_flag)]


def _shaped(*shape: int | None) -> Any:
    return Annotated[np.ndarray, PlainValidator(partial(_numbers, shape=shape))]


# Messages.

_RELEASED = {"front": "image", "wrist": "wrist_image"}


def released_keys(robot: Embodiment) -> dict[str, str]:
    """The released keys of RoboMME's cameras, of those the robot has, where none is called so."""
    keys = {}
    for name, released in _RELEASED.items():
        if name in robot.camera_names and released not in robot.camera_names:
            keys[name] = f"observation/{released}"
    return keys


Index = Annotated[StrictInt, Field(ge=0), BeforeValidator(_integer)]


class Flags(BaseModel):
    reset: Flag = False
    add_buffer: Flag = False


class InferMessage(BaseModel):
    """What a request for actions can have in both schemas. Its reader adds what the robot sees."""

    simple_subgoal: Text | None = None
    grounded_subgoal: Text | None = None
    available_multi_choices: Any = None

    @property
    def subgoals(self) -> dict[str, str]:
        texts = {"simple_subgoal": self.simple_subgoal, "grounded_subgoal": self.grounded_subgoal}
        return {kind: text for kind, text in texts.items() if text is not None}


class ListMessage(InferMessage):
    """All frames since the last request. Its reader adds what the robot sees.

    exec_start_idx, executed_action_list: extensions of the challenge's schema, see `Infer`.
    """

    task_goal: Goal
    is_first_step: Truth
    exec_start_idx: Index | None = None


class RequestReader:
    """Checks the messages that clients send to one policy.

    Args:
        robot: the policy's, which says what an observation is made of.
        most_frames: longest list of frames that a message may have.
    """

    def __init__(self, robot: Embodiment, most_frames: int) -> None:
        self._robot = robot
        self._released = released_keys(robot)
        width = robot.state.width
        counted = BeforeValidator(partial(_counted, least=1, most=most_frames))
        # A choice may move nothing, and the next request then has no new frame.
        least = 0 if robot.action.choice else 1
        listed_count = BeforeValidator(partial(_counted, least=least, most=most_frames))
        same_size = AfterValidator(_same_size)
        images = BeforeValidator(_images)
        one_size = Annotated[list[Image], FailFast(), listed_count, images, same_size]
        buffer = Annotated[list[Image], FailFast(), counted, BeforeValidator(_buffer), same_size]
        depth = Annotated[np.ndarray, PlainValidator(partial(_depth, n_axes=2))]
        depths = Annotated[np.ndarray, PlainValidator(partial(_depth, n_axes=3))]

        # One field for each camera and reading, by its name in the message.
        observed: dict[str, Any] = {
            "prompt": (Goal, ...),
            "state": (_shaped(width), Field(alias="observation/state")),
        }
        listed: dict[str, Any] = {}
        for camera in robot.cameras:
            key = f"observation/{camera.name}"
            # An error names the first of the two, which released clients send.
            keys = AliasChoices(self._released.get(camera.name, key), key)
            meaning = f"an image of the camera {camera.name!r}"
            observed[f"see_{camera.name}"] = (
                Image,
                Field(validation_alias=keys, description=meaning),
            )
            listed[f"see_{camera.name}"] = (one_size, Field(alias=f"{camera.name}_rgb_list"))
            if camera.depth:
                depth_name, pose_name = camera.readings
                meaning = "depth in millimetres beside every image of the camera"
                one = Field(alias=f"observation/{depth_name}", description=meaning)
                many = Field(alias=f"{depth_name}_list", description=meaning)
                observed[f"see_{depth_name}"] = (depth, one)
                listed[f"see_{depth_name}"] = (depths, many)
                meaning = "one pose [3, 4] from the world to the camera beside every image"
                one = Field(alias=f"observation/{pose_name}", description=meaning)
                many = Field(alias=f"{pose_name}_list", description=meaning)
                observed[f"see_{pose_name}"] = (_shaped(3, 4), one)
                listed[f"see_{pose_name}"] = (_shaped(None, 3, 4), many)
        self._observation = create_model("Observation", __base__=InferMessage, **observed)
        listed["executed_action_list"] = (_shaped(None, robot.action.width) | None, None)
        # The challenge has the benchmark's two lists of states, others have one.
        self._challenge = create_model(
            "Challenge",
            __base__=ListMessage,
            joint_state_list=(_shaped(None, ARM_JOINTS), ...),
            gripper_state_list=(_shaped(None, 2), ...),
            **listed,
        )
        listed["state_list"] = (_shaped(None, width), ...)
        self._list = create_model("Frames", __base__=ListMessage, **listed)
        self._buffer = create_model(
            "Buffer",
            exec_start_idx=(Index, 0),
            images=(buffer, ...),
            state=(_shaped(None, width), ...),
        )

    def parse(self, message: Any) -> Request:
        """Recognise and check a decoded message.

        Raises:
            UserError: what is wrong with the first value that does not fit, by its key.
        """
        require(isinstance(message, dict), f"A request is a map, got {described(message)}.")
        action = self._robot.action
        space = message.get("action_space", action.answers)
        is_text = space is None or isinstance(space, str)
        if not is_text or space != action.answers:
            raise UserError(
                f"action_space={described(space)}: this policy returns {action.answers} only."
            )
        flags = validated(Flags, message, "The request")
        if flags.reset:
            return validated(Reset, {"seed": message.get("seed")}, "The request")
        if flags.add_buffer:
            return self._add_buffer(message)
        require(
            not action.of_pose or "action_space" in message,
            "This policy returns differences to the tool's pose at each step, to be added to the"
            f" pose at that step: send action_space={action.answers!r} in the request to confirm"
            " it.",
        )
        if "front_rgb_list" in message or "task_goal" in message:
            return self._listed_frames(message)
        keys = [key for key in message if isinstance(key, str)]
        if any(key.startswith("observation/") for key in keys):
            return self._one_observation(message)
        raise self._unknown(keys[:10])

    def _add_buffer(self, message: dict[Any, Any]) -> AddBuffer:
        readings = ", ".join(self._robot.readings)
        require(
            not readings,
            f"This policy reads {readings} at every frame, and add_buffer has no place for them:"
            " send past frames in the challenge's lists, and the current one in either schema.",
        )
        buffer: Any = validated(self._buffer, message, "The request")
        _check_lengths({"images": len(buffer.images), "state": len(buffer.state)})
        return AddBuffer(buffer.images, buffer.exec_start_idx, buffer.state)

    def _one_observation(self, message: dict[Any, Any]) -> Infer:
        for name, released in self._released.items():
            require(
                released not in message or f"observation/{name}" not in message,
                f"observation/{name} and {released} are both images of the camera {name!r}: send"
                " one of them.",
            )
        observation: Any = validated(self._observation, message, "The request")
        views = {name: view[None] for name, view in self._views(observation).items()}
        self._check_depth(views, "observation/{}")
        return Infer(
            goal=observation.prompt,
            views=views,
            states=observation.state[None],
            stored=bool(self._robot.readings),
            subgoals=observation.subgoals,
            options=self._options(observation),
        )

    def _listed_frames(self, message: dict[Any, Any]) -> Infer:
        # The benchmark's robots have their states in two lists, others in one.
        is_challenge = "state_list" not in message
        require(
            not is_challenge or self._robot.action.space is not None,
            f"The robot {self._robot.name!r} is not the benchmark's: send its states as state_list,"
            " or observation/… messages.",
        )
        frames: Any = validated(
            self._challenge if is_challenge else self._list, message, "The request"
        )
        views = self._views(frames)
        lengths = {}
        for name, view in views.items():
            suffix = "_rgb_list" if name in self._robot.camera_names else "_list"
            lengths[name + suffix] = len(view)
        if is_challenge:
            joints = frames.joint_state_list
            grippers = frames.gripper_state_list
            lengths["joint_state_list"] = len(joints)
            lengths["gripper_state_list"] = len(grippers)
            _check_lengths(lengths)
            rows = [benchmark_state(*row) for row in zip(joints, grippers, strict=True)]
            states = np.array(rows, np.float32).reshape(-1, self._robot.state.width)
        else:
            states = frames.state_list
            lengths["state_list"] = len(states)
            _check_lengths(lengths)
        require(
            len(states) or not frames.is_first_step,
            "The request with is_first_step holds 0 frames: send the current one at least.",
        )
        if len(states):
            self._check_depth(views, "{}_list")
        executed = frames.executed_action_list
        exec_start = frames.exec_start_idx
        if executed is not None and len(executed) > len(states):
            raise UserError(
                f"executed_action_list has {counted(len(executed), 'action')} for"
                f" {counted(len(states), 'frame')}: send one for each of the last frames."
            )
        if exec_start is not None and not (frames.is_first_step and exec_start < len(states)):
            raise UserError(
                f"exec_start_idx={exec_start}: it is one of the {len(states)} frames, in the"
                " request with is_first_step."
            )
        return Infer(
            goal=frames.task_goal,
            views=views,
            states=states,
            stored=True,
            first=frames.is_first_step,
            exec_start=exec_start,
            executed=executed,
            subgoals=frames.subgoals,
            options=self._options(frames),
        )

    def _views(self, message: InferMessage) -> dict[str, Any]:
        """What the cameras deliver, by the robot's names."""
        names = (*self._robot.camera_names, *self._robot.readings)
        return {name: getattr(message, f"see_{name}") for name in names}

    def _check_depth(self, views: Mapping[str, Any], key: str) -> None:
        """Make sure that depth has the size of its camera's image. `key` spells a name."""
        for camera in self._robot.cameras:
            if camera.depth:
                name = camera.readings[0]
                size = views[name].shape[1:3]
                image = views[camera.name][0].shape[:2]
                if size != image:
                    raise UserError(
                        f"{key.format(name)} must have one number a pixel of the image"
                        f" {list(image)}, got {list(size)}."
                    )

    def _options(self, message: InferMessage) -> tuple[Option, ...]:
        """What the message offers to a robot that chooses; others are not offered anything."""
        letters = len(self._robot.action.choice)
        if not letters or message.available_multi_choices is None:
            return ()
        return read_options(message.available_multi_choices, letters)

    def _unknown(self, keys: list[str]) -> UserError:
        """Explain that these keys are of no request of this robot."""
        camera = self._robot.camera_names[0]
        image, images = f"observation/{camera}", f"{camera}_rgb_list"
        known = ["reset", "add_buffer", image, images]
        if camera in self._released:
            known.append(self._released[camera])
        unknown = [key for key in keys if key not in known]
        if keys and not unknown:  # reset=true and add_buffer=true are requests
            false = " and ".join(f"{key}=false" for key in keys)
            return UserError(
                f"{false}: no request. Send reset=true, or an observation with the keys"
                f" {image}, … or {images}, …"
            )
        hint = f"Known: {', '.join(known)}."
        if unknown:
            hint = did_you_mean(unknown[0], known)
        return UserError(f"No known request has the keys {keys}. {hint}")


def _check_lengths(lengths: Mapping[str, int]) -> None:
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{key} has {length}" for key, length in lengths.items())
        raise UserError(f"All lists need one entry a frame: {counts}.")
