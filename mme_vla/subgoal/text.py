"""From a language model's answer to a subgoal: points, JSON, coordinates.

Models write points in thousandths of the image's sides, `(row, column)` from 0 to 1000; the policy
reads pixels of the 256×256 front image, `<row, column>`. What cannot be read raises
`MalformedReply`, which the predictors count and survive.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError, brief, require
from mme_vla.utils import is_text, parse_json

IMAGE, VIDEO, BBOX = "<image>", "<video>", "<bbox>"
KINDS = ("simple", "grounded")

_PHRASE = {"simple": "language subgoal", "grounded": "grounded language subgoal"}
_SYSTEM = (
    "You are a helpful assistant to help guide the robot to complete the task by predicting a"
    " sequence of {}s"
)
MEMER_SYSTEM = (
    "You are a robot program that predicts actions. The current input images from the front-view"
    " camera shows the most recent actions the robot has executed. The past keyframes are selected"
    " frames of particular importance from all the actions the robot has executed so far. Based on"
    " these, output the current subtask the robot should execute and nothing else. Some tasks may"
    " have a video input for initial setup, some may not.\n\nReturn a JSON with:\n-"
    " current_subtask: the action that should be executed at the current timestep\n-"
    " keyframe_positions: list of frame positions (1-indexed) from the current input images where"
    " actions change"
)


def subgoal_system(kind: str) -> str:
    """The system prompt of the simple or the grounded predictor."""
    return _SYSTEM.format(_PHRASE[kind])


def subgoal_user(kind: str, goal: str, history: Sequence[str], video: bool) -> str:
    """The question for the next subgoal.

    Args:
        kind: `simple` or `grounded`.
        goal: the task in words.
        history: the subgoals predicted before, points as `<bbox>`; empty on the first turn.
        video: whether a conditioning video comes with it.
    """
    phrase = _PHRASE[kind]
    past = (
        f"The history of previous predicted {phrase}s are: {numbered(history)}"
        if history
        else "This is the initial turn for prediction"
    )
    question = f"What's the next {phrase} based on current observation?"
    return f"{VIDEO if video else ''}The task goal is: {goal}\n{past}\n{IMAGE}{question}"


def numbered(history: Sequence[str]) -> str:
    """`1. pick up the cube; 2. put it down`."""
    return "; ".join(f"{i}. {text}" for i, text in enumerate(history, 1))


def memer_user(goal: str, keyframes: int, recent: int, video: bool) -> str:
    """MemER's question.

    Args:
        goal: the task in words.
        keyframes, recent: how many images of each kind come with it, in this order.
        video: whether a conditioning video comes before them.
    """
    setup = f"The task has a video input for initial setup: {VIDEO}\n" if video else ""
    return (
        f"{setup}The task goal is: {goal}\nHere are the selected frames from the entirety of the"
        f" full execution that are of particular importance:{_image_tags(keyframes)}\nHere is"
        f" current input image list from the front-view camera: {_image_tags(recent)}\n\nWhat"
        " subtask should the robot execute and what is the keyframe position?"
    )


def memer_reply(subtask: str, positions: Sequence[int]) -> str:
    """MemER's answer; without keyframes there is no space after the first colon, as in the released
    training set.
    """
    space = " " if positions else ""
    return f'{{"current_subtask":{space}"{subtask}", "keyframe_positions": {list(positions)}}}'


def split_media(text: str) -> list[str]:
    """Cut a text at its `<image>` and `<video>` marks, which stay as entries; empty pieces are left
    out.
    """
    return [piece for piece in re.split(f"({IMAGE}|{VIDEO})", text) if piece]


def _image_tags(count: int) -> str:
    return f"[{', '.join([IMAGE] * count)}]"


THOUSAND = 1000
Point = tuple[int, int]

# Runs of digits are bounded: Python refuses to read thousands of them.
_BOX = re.compile(r"<\|box_start\|>\(\s*(\d{1,6})\s*,\s*(\d{1,6})\s*\)<\|box_end\|>")
_BOX_MARK = re.compile(r"<\|box_(?:start|end)\|>")
_PIXELS = re.compile(r"at <(-?\d{1,6}), (-?\d{1,6})>")
_PAIR = re.compile(r"<\s*(-?\d+(?:\.\d+)?)\s*,\s*(-?\d+(?:\.\d+)?)\s*>")
_SUBGOAL_KEY = re.compile(r'"subgoal"([^\n]*)')
_QUOTED = re.compile(r'"((?:[^"\\]|\\.)*)"')
_DONE = ("is complete", "is finished")


class MalformedReply(ValueError):  # noqa: N818  (what the model gave, not a mistake of the program)
    """An answer that holds no usable subgoal; the message says why."""


@dataclass(frozen=True)
class Parsed:
    """One answer.

    text: for the policy, points as `<row, column>` in pixels.
    entry: for the history, points as `<bbox>`.
    points: the points in order, pixels.
    """

    text: str
    entry: str
    points: tuple[Point, ...] = ()


def to_pixels(value: float, side: int = SIDE) -> int:
    """Thousandths → pixel, rounded down: 0 → 0, 1000 → `side`."""
    return int(value * side // THOUSAND)


def to_thousandths(pixel: int, side: int = SIDE) -> int:
    """Pixel → thousandths, rounded to the nearest, as ms-swift does in training."""
    return round(pixel / side * THOUSAND)


def write_boxes(text: str, points: Sequence[Point], side: int = SIDE) -> str:
    """Replace each `<bbox>` by its point as the model writes it.

    Raises:
        ValueError: another number of marks than of points.
    """
    pieces = text.split(BBOX)
    if len(pieces) != len(points) + 1:
        raise ValueError(
            f"{len(pieces) - 1} {BBOX} marks for {len(points)} points in {brief(text)}."
        )
    boxes = [
        f"<|box_start|>({to_thousandths(y, side)},{to_thousandths(x, side)})<|box_end|>"
        for y, x in points
    ]
    return "".join(piece + box for piece, box in zip(pieces, [*boxes, ""], strict=True))


def parse_subgoal(reply: str, side: int = SIDE) -> Parsed:
    """Read the answer of the fine-tuned predictor: a line of text with
    `<|box_start|>(a,b)<|box_end|>` points.
    """
    text = " ".join(reply.split())
    require(text, "the answer is empty", MalformedReply)
    pixels = [(int(y), int(x)) for y, x in _BOX.findall(text)]
    require(
        not any(value > THOUSAND for point in pixels for value in point),
        "a point lies outside 0…1000",
        MalformedReply,
    )
    require(
        not _BOX_MARK.search(_BOX.sub("", text)),
        "a point is not of the form <|box_start|>(a,b)<|box_end|>",
        MalformedReply,
    )
    points = tuple((to_pixels(y, side), to_pixels(x, side)) for y, x in pixels)
    values = iter(points)
    display_text = _BOX.sub(lambda _: "<{}, {}>".format(*next(values)), text)
    return Parsed(display_text, _BOX.sub(BBOX, text), points)


def parse_memer(reply: str, recent: int, side: int = SIDE) -> tuple[Parsed, list[int]]:
    """Read MemER's answer.

    Args:
        reply: JSON with `current_subtask` and `keyframe_positions`, possibly in a code fence.
        recent: how many recent frames were shown; positions outside 1…recent are left out.

    Returns:
        The subgoal and the positions, from 1, in ascending order.
    """
    fields = json_object(reply)
    subtask: Any = fields.get("current_subtask")
    positions: Any = fields.get("keyframe_positions", [])
    require(isinstance(subtask, str), "the answer has no current_subtask", MalformedReply)
    require(
        isinstance(positions, list)
        and not any(isinstance(p, bool) or not isinstance(p, int) for p in positions),
        "keyframe_positions is not a list of whole numbers",
        MalformedReply,
    )
    return parse_subgoal(_writable(subtask), side), sorted(
        {p for p in positions if 1 <= p <= recent}
    )


def parse_gemini(reply: str) -> str:
    """Return the subgoal of a prompted model's reply, points still in thousandths.

    The first quoted string after a `"subgoal"` key on that line counts; failing that, the answer
    read as JSON.
    """
    for remainder in _SUBGOAL_KEY.findall(reply):
        quoted = _QUOTED.search(remainder)
        if quoted and quoted[1].strip():
            return _writable(quoted[1].strip().replace('\\"', '"'))
    text: Any = json_object(reply).get("subgoal")
    require(isinstance(text, str) and text.strip(), "the answer names no subgoal", MalformedReply)
    return _writable(text.strip())


def pixels_of_pairs(text: str, side: int = SIDE) -> Parsed:
    """Turn every `<y, x>` of a prompted model's subgoal from thousandths into pixels, clipped to
    [0, side].
    """
    points: list[Point] = []

    def pixel(match: re.Match[str]) -> str:
        try:
            y, x = (min(max(to_pixels(float(match[i]), side), 0), side) for i in (1, 2))
        except (ValueError, OverflowError):
            raise MalformedReply("a point's number is too long") from None
        points.append((y, x))
        return f"<{y}, {x}>"

    return Parsed(_PAIR.sub(pixel, text), _PAIR.sub(BBOX, text), tuple(points))


def says_done(text: str) -> bool:
    """Whether a prompted model reports that all is done instead of naming a subgoal."""
    return any(words in text.lower() for words in _DONE)


def mark_points(text: str) -> tuple[str, list[Point]]:
    """Replace each `at <y, x>` of a label by `at <bbox>`; return the text and the
    points in pixels.
    """
    points = [(int(y), int(x)) for y, x in _PIXELS.findall(text)]
    return _PIXELS.sub(f"at {BBOX}", text), points


def points_of(text: str) -> tuple[Point, ...]:
    return tuple((int(y), int(x)) for y, x in _PIXELS.findall(text))


def json_object(reply: str) -> dict[str, Any]:
    """The outermost braces of an answer as JSON."""
    start, stop = reply.find("{"), reply.rfind("}")
    require(start >= 0 and stop >= start, "the answer holds no JSON object", MalformedReply)
    try:
        fields: dict[str, Any] = parse_json(reply[start : stop + 1], "the answer", finite=False)
    except UserError as error:
        raise MalformedReply(f"the answer is not JSON: {error}") from None
    return fields


def _writable(text: str) -> str:
    """The text, unless it holds half a character (JSON's escapes allow that), which no file or
    tokenizer takes.
    """
    require(is_text(text), "the answer holds half a character", MalformedReply)
    return text
