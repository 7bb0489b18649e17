"""What a vision-language model is told and asked when it plays, and how its answer is read.

Points are (row, column) in thousandths of the picture's sides, as with the subgoal predictors.
"""

import math
import re
from collections.abc import Sequence
from typing import Any

from mme_vla.embodiment.options import Option
from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError, brief
from mme_vla.files import parse_json
from mme_vla.play.game import Decision
from mme_vla.subgoal.words.parsing import THOUSAND, MalformedAnswer, to_pixels, to_thousandths
from mme_vla.subgoal.words.prompts import IMAGE, VIDEO

_OBJECT = re.compile(r"\{[^{}]*\}")

SYSTEM = """You decide what a robot arm does next. A task is described in words; it cannot be solved from the present \
picture alone, but from what the clips have shown so far. All pictures come from one fixed camera in front of the robot.

Each time you get the frames since your last decision and choose exactly one option. A planner then carries it out \
without fault, so only your choice counts. Options marked [point] need the place of the object you mean in the present \
picture: the candidate nearest to it is taken.

A point is [row, column], both from 0 (top, left) to 1000 (bottom, right).
End your answer with one JSON object and nothing after it: {"choice": "<letter>", "point": [row, column]}. \
Leave "point" as null for options without [point]."""


def option_list(options: Sequence[Option]) -> str:
    """`a: pick up the cube [point]`, one a line."""
    return "\n".join(f"{option.label}: {option.action}{' [point]' if option.needs_point else ''}" for option in options)


def said(decision: Decision) -> str:
    """A past decision in words: `a: pick up the cube at [442, 617]`."""
    point = decision.point
    place = "" if point is None else " at [{}, {}]".format(*(to_thousandths(int(value), SIDE) for value in point))
    return f"{decision.choice}: {decision.action}{place}"


def whole_question(goal: str, options: Sequence[Option], clips: Sequence[tuple[str, bool]], complaint: str = "") -> str:
    """One question that tells the whole episode, `<video>` and `<image>` where pictures go.

    Args:
        goal: the task in words.
        clips: what each clip that was shown is, in order, and whether it has frames.
        complaint: why the last answer to the same question could not be used; empty the first time.
    """
    lines = [f"The task: {goal}"]
    lines += [f"{title}: {VIDEO if frames else 'nothing moved.'}" for title, frames in clips]
    lines += [f"The present picture: {IMAGE}", "Options:", option_list(options)]
    if complaint:
        lines.append(complaint)
    lines.append("What next?")
    return "\n".join(lines)


def opening(goal: str, options: Sequence[Option], video: bool) -> str:
    """The first question of a conversation."""
    shown = (
        "The video comes before you act; the picture is the present one." if video else "This is the present picture."
    )
    return f"The task: {goal}\n{shown}\nOptions:\n{option_list(options)}\nWhat next?"


def following(decision: Decision, options: Sequence[Option], moved: bool) -> str:
    """A later question of a conversation."""
    shown = (
        "the video shows it, the picture is the present one" if moved else "nothing moved; this is the present picture"
    )
    return f"You chose {said(decision)}; {shown}.\nOptions:\n{option_list(options)}\nWhat next?"


def complaint(reason: str) -> str:
    """What is said after an answer that cannot be used."""
    return (
        f"Your last answer could not be used: {reason}. Answer again, ending with one JSON object "
        '{"choice": "<letter>", "point": [row, column] or null}.'
    )


def parse_choice(answer: str, options: Sequence[Option]) -> dict[str, Any]:
    """Read an answer: the last JSON object in it, whatever stands before.

    Returns:
        {"choice": letter, "point": [y, x] in pixels or None}.

    Raises:
        MalformedAnswer: no object, an unknown option, or a point that is missing or none.
    """
    if not answer.strip():
        raise MalformedAnswer("the answer is empty")
    found = _last_object(answer)
    letter = found.get("choice")
    if not isinstance(letter, str):
        raise MalformedAnswer('the answer has no "choice"')
    label = letter.strip().strip("().:[]").lower()
    option = next((option for option in options if option.label == label), None)
    if option is None:
        raise MalformedAnswer(
            f"there is no option {brief(letter)}; the options are {', '.join(o.label for o in options)}"
        )
    return {"choice": label, "point": _pixel(found.get("point"), option) if option.needs_point else None}


def _pixel(point: Any, option: Option) -> list[int]:
    if not isinstance(point, list) or len(point) != 2:
        raise MalformedAnswer(f'option {option.label} needs "point": [row, column]')
    for value in point:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise MalformedAnswer("a point is made of two numbers")
        if isinstance(value, float) and not math.isfinite(value):  # of a whole number too long, isfinite raises
            raise MalformedAnswer("a point is made of two numbers")
        if not 0 <= value <= THOUSAND:
            raise MalformedAnswer(f"a point lies within 0 and {THOUSAND}")
    return [min(to_pixels(value, SIDE), SIDE - 1) for value in point]


def _last_object(answer: str) -> dict[str, Any]:
    for text in reversed(_OBJECT.findall(answer)):
        try:
            found: dict[str, Any] = parse_json(text, "the answer", finite=False)
            return found
        except UserError:
            continue
    raise MalformedAnswer("the answer holds no JSON object")
