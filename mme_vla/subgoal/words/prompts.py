"""What the fine-tuned subgoal predictors are asked and answer, in words (paper, appendix: VLM subgoal prediction).

One place for all templates: the predictors and their training sets use the same functions, so they cannot differ.
`<image>`, `<video>` and `<bbox>` mark where pictures and points go, as ms-swift writes them.
"""

import re
from collections.abc import Sequence

IMAGE, VIDEO, BBOX = "<image>", "<video>", "<bbox>"
KINDS = ("simple", "grounded")

_PHRASE = {"simple": "language subgoal", "grounded": "grounded language subgoal"}
_SYSTEM = "You are a helpful assistant to help guide the robot to complete the task by predicting a sequence of {}s"
_MEMER_SYSTEM = (
    "You are a robot program that predicts actions. The current input images from the front-view camera shows the most "
    "recent actions the robot has executed. The past keyframes are selected frames of particular importance from all "
    "the actions the robot has executed so far. Based on these, output the current subtask the robot should execute "
    "and nothing else. Some tasks may have a video input for initial setup, some may not.\n\n"
    "Return a JSON with:\n"
    "- current_subtask: the action that should be executed at the current timestep\n"
    "- keyframe_positions: list of frame positions (1-indexed) from the current input images where actions change"
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


def memer_system() -> str:
    """The system prompt of MemER."""
    return _MEMER_SYSTEM


def memer_user(goal: str, keyframes: int, recent: int, video: bool) -> str:
    """MemER's question.

    Args:
        goal: the task in words.
        keyframes, recent: how many pictures of each kind come with it, in this order.
        video: whether a conditioning video comes before them.
    """
    setup = f"The task has a video input for initial setup: {VIDEO}\n" if video else ""
    return (
        f"{setup}The task goal is: {goal}\n"
        "Here are the selected frames from the entirety of the full execution that are of particular importance:"
        f"{_pictures(keyframes)}\n"
        f"Here is current input image list from the front-view camera: {_pictures(recent)}\n\n"
        "What subtask should the robot execute and what is the keyframe position?"
    )


def memer_answer(subtask: str, positions: Sequence[int]) -> str:
    """MemER's answer; without keyframes there is no space after the first colon, as in the released training set."""
    space = " " if positions else ""
    return f'{{"current_subtask":{space}"{subtask}", "keyframe_positions": {list(positions)}}}'


def split_media(text: str) -> list[str]:
    """Cut a text at its `<image>` and `<video>` marks, which stay as entries; empty pieces are left out."""
    return [piece for piece in re.split(f"({IMAGE}|{VIDEO})", text) if piece]


def _pictures(count: int) -> str:
    return f"[{', '.join([IMAGE] * count)}]"
