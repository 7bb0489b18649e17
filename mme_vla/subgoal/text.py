"""Texts of the subgoal predictors: questions, answers, and points in them.

Models write points in thousandths of the image's sides, `(row, column)` from 0 to 1000. The policy
reads pixels of the 256×256 front image, `<row, column>`. An answer that cannot be read raises
`MalformedReply`, which the predictors count.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError, brief
from mme_vla.utils import is_text, parse_json

IMAGE, VIDEO, BBOX = "<image>", "<video>", "<bbox>"
KINDS = ("simple", "grounded")

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
    """Return the system prompt of the simple or the grounded predictor."""
    return _SYSTEM.format(_PHRASE[kind])


def subgoal_user(kind: str, goal: str, history: Sequence[str], video: bool) -> str:
    """Return the question for the next subgoal.

    Args:
        kind: `simple` or `grounded`.
        goal: the task in words.
        history: the subgoals predicted before, points as `<bbox>`; empty on the first turn.
        video: whether a conditioning video comes with it.
    """
    phrase = _PHRASE[kind]
    mark = VIDEO if video else ""
    past = "This is the initial turn for prediction"
    if history:
        past = f"The history of previous predicted {phrase}s are: {numbered(history)}"
    question = f"What's the next {phrase} based on current observation?"
    return f"{mark}The task goal is: {goal}\n{past}\n{IMAGE}{question}"


def numbered(texts: Sequence[str]) -> str:
    """Join texts as `1. pick up the cube; 2. put it down`."""
    return "; ".join(f"{i}. {text}" for i, text in enumerate(texts, 1))


def memer_user(goal: str, keyframes: int, recent: int, video: bool) -> str:
    """Return MemER's question.

    Args:
        goal: the task in words.
        keyframes, recent: how many images of each kind come with it, in this order.
        video: whether a conditioning video comes before them.
    """
    setup = f"The task has a video input for initial setup: {VIDEO}\n" if video else ""
    keyframe_marks = ", ".join([IMAGE] * keyframes)
    recent_marks = ", ".join([IMAGE] * recent)
    return (
        f"{setup}The task goal is: {goal}\nHere are the selected frames from the entirety of the"
        f" full execution that are of particular importance:[{keyframe_marks}]\nHere is"
        f" current input image list from the front-view camera: [{recent_marks}]\n\nWhat"
        " subtask should the robot execute and what is the keyframe position?"
    )


def memer_reply(subtask: str, positions: Sequence[int]) -> str:
    """Return MemER's answer, as the training set has it."""
    space = " " if positions else ""  # as in the released training set
    return f'{{"current_subtask":{space}"{subtask}", "keyframe_positions": {list(positions)}}}'


def split_media(text: str) -> list[str]:
    """Split a text at its `<image>` and `<video>` marks, which are pieces too.

    Empty pieces are left out.
    """
    return [piece for piece in re.split(f"({IMAGE}|{VIDEO})", text) if piece]


class MalformedReply(ValueError):  # noqa: N818  (what the model gave, not a mistake of the program)
    """An answer without a usable subgoal; the message says why."""


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


def to_pixels(value: float) -> int:
    """Thousandths → pixel, rounded down: 0 → 0, 1000 → 256."""
    return int(value * SIDE // THOUSAND)


def to_thousandths(pixel: int) -> int:
    """Pixel → thousandths, rounded to the nearest, as ms-swift does in training."""
    return round(pixel / SIDE * THOUSAND)


def write_boxes(text: str, points: Sequence[Point]) -> str:
    """Replace each `<bbox>` by its point as the model writes it.

    Raises:
        ValueError: another number of marks than of points.
    """
    start, *pieces = text.split(BBOX)
    if len(pieces) != len(points):
        raise ValueError(f"{len(pieces)} {BBOX} marks for {len(points)} points in {brief(text)}.")
    text_with_boxes = start
    for (y, x), piece in zip(points, pieces, strict=True):
        text_with_boxes += (
            f"<|box_start|>({to_thousandths(y)},{to_thousandths(x)})<|box_end|>{piece}"
        )
    return text_with_boxes


def parse_subgoal(reply: str) -> Parsed:
    """Read the answer of a fine-tuned predictor: text with `<|box_start|>(a,b)<|box_end|>` points.

    Raises:
        MalformedReply: it is empty, or holds a damaged point or a mark of this library's questions.
    """
    text = " ".join(reply.split())
    if not text:
        raise MalformedReply("the answer is empty")
    if any(mark in text for mark in (IMAGE, VIDEO, BBOX)):  # the next question repeats the answer
        raise MalformedReply(f"the answer holds a mark of questions: {IMAGE}, {VIDEO} or {BBOX}")
    points: list[Point] = []

    def pixel(match: re.Match[str]) -> str:
        y = int(match[1])
        x = int(match[2])
        if max(y, x) > THOUSAND:
            raise MalformedReply("a point lies outside 0…1000")
        points.append((to_pixels(y), to_pixels(x)))
        return "<{}, {}>".format(*points[-1])

    display_text = _BOX.sub(pixel, text)
    if _BOX_MARK.search(_BOX.sub("", text)):
        raise MalformedReply("a point is not of the form <|box_start|>(a,b)<|box_end|>")
    return Parsed(display_text, _BOX.sub(BBOX, text), tuple(points))


def parse_memer(reply: str, recent: int) -> tuple[Parsed, list[int]]:
    """Read MemER's answer.

    Args:
        reply: JSON with `current_subtask` and `keyframe_positions`, possibly in a code fence.
        recent: how many recent frames were shown; positions outside 1…recent are left out.

    Returns:
        The subgoal and the positions, from 1, in ascending order.

    Raises:
        MalformedReply: a field is missing or of another type.
    """
    fields = json_object(reply)
    subtask = fields.get("current_subtask")
    positions = fields.get("keyframe_positions", [])
    if not isinstance(subtask, str):
        raise MalformedReply("the answer has no current_subtask")
    if not isinstance(positions, list) or any(type(position) is not int for position in positions):
        raise MalformedReply("keyframe_positions is not a list of whole numbers")
    parsed = parse_subgoal(_writable(subtask))
    return parsed, sorted({position for position in positions if 1 <= position <= recent})


def parse_gemini(reply: str) -> str:
    """Return the subgoal of a prompted model's reply, points still in thousandths.

    The first quoted string after a `"subgoal"` key on that line counts; failing that, the answer
    read as JSON.
    """
    for remainder in _SUBGOAL_KEY.findall(reply):
        quoted = _QUOTED.search(remainder)
        if quoted and quoted[1].strip():
            try:
                text = json.loads(quoted[0])
            except ValueError:  # a backslash that JSON does not know
                text = quoted[1].replace('\\"', '"')
            return _writable(text.strip())
    text = json_object(reply).get("subgoal")
    if not isinstance(text, str) or not text.strip():
        raise MalformedReply("the answer names no subgoal")
    return _writable(text.strip())


def pixels_of_pairs(text: str) -> Parsed:
    """Convert each `<y, x>` of a prompted model's subgoal from thousandths to pixels.

    Pixels are clipped to [0, 256].
    """
    points: list[Point] = []

    def pixel(match: re.Match[str]) -> str:
        try:
            y = to_pixels(float(match[1]))
            x = to_pixels(float(match[2]))
        except (ValueError, OverflowError):
            raise MalformedReply("a point's number is too long") from None
        y = min(max(y, 0), SIDE)
        x = min(max(x, 0), SIDE)
        points.append((y, x))
        return f"<{y}, {x}>"

    return Parsed(_PAIR.sub(pixel, text), _PAIR.sub(BBOX, text), tuple(points))


def says_done(text: str) -> bool:
    """Return whether a prompted model reports completion instead of naming a subgoal."""
    return any(words in text.lower() for words in _DONE)


def mark_points(text: str) -> tuple[str, list[Point]]:
    """Replace each `at <y, x>` of a label by `at <bbox>`; return the points in pixels as well."""
    return _PIXELS.sub(f"at {BBOX}", text), list(points_of(text))


def points_of(text: str) -> tuple[Point, ...]:
    """Return the points `at <y, x>` of a label, in pixels."""
    return tuple((int(y), int(x)) for y, x in _PIXELS.findall(text))


def json_object(reply: str) -> dict[str, Any]:
    """Read the outermost braces of an answer as JSON.

    Raises:
        MalformedReply: there is no JSON object.
    """
    start = reply.find("{")
    stop = reply.rfind("}")
    if not 0 <= start <= stop:
        raise MalformedReply("the answer holds no JSON object")
    try:
        fields: dict[str, Any] = parse_json(reply[start : stop + 1], "the answer", finite=False)
    except UserError as error:
        raise MalformedReply(f"the answer is not JSON: {error}") from None
    return fields


def _writable(text: str) -> str:
    """Return the text, unless it holds half a character, which JSON's escapes allow."""
    if not is_text(text):
        raise MalformedReply("the answer holds half a character")
    return text
