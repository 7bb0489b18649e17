"""`gemini`: a foundation model behind an API, prompted and not trained; one conversation an
episode.
"""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mme_vla.errors import require
from mme_vla.processing.prompt import POINT
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.models.api import ApiFailure, Reply, make_api, side_by_side
from mme_vla.subgoal.models.connection import MediaPart
from mme_vla.subgoal.text import MalformedReply, parse_gemini, pixels_of_pairs, says_done

AT = " at <y, x>"

# `@` marks where a grounded subgoal has a point. [ordinal]: first, second, …; [colour]: red, blue
# or green.
VOCABULARY: dict[str, tuple[str, ...]] = {
    "BinFill": (
        "pick up the [ordinal] [colour] cube@",
        "put it into the bin@",
        "press the button@",
    ),
    "PickXtimes": (
        "pick up the [colour] cube@ for the [ordinal] time",
        "place the [colour] cube onto the target@",
        "press the button to stop@",
    ),
    "SwingXtimes": (
        "pick up the [colour] cube@",
        "move to the top of the right-side target@ for the [ordinal] time",
        "move to the top of the left-side target@ for the [ordinal] time",
        "put the [colour] cube on the table",
        "press the button@",
    ),
    "StopCube": (
        "move to the top of the button@ to prepare",
        "remain static",
        "press the button to stop the cube on the target@",
    ),
    "ButtonUnmask": (
        "press the button@",
        "pick up the container@ that hides the [colour] cube",
        "put down the container",
    ),
    "ButtonUnmaskSwap": (
        "press the first button@",
        "press the second button@",
        "pick up the container@ that hides the [colour] cube",
        "put down the container",
    ),
    "VideoUnmask": (
        "pick up the container@ that hides the [colour] cube",
        "put down the container",
    ),
    "VideoUnmaskSwap": (
        "pick up the container@ that hides the [colour] cube",
        "put down the container",
    ),
    "PickHighlight": (
        "press the button@",
        "pick up the [ordinal] highlighted cube@, which is [colour]",
        "place the cube onto the table",
    ),
    "VideoRepick": (
        "pick up the correct cube@ for the [ordinal] time",
        "put it down",
        "press the button@ to finish",
    ),
    "VideoPlaceButton": ("pick up the cube@", "place the cube onto the correct target@"),
    "VideoPlaceOrder": ("pick up the cube@", "place the cube onto the correct target@"),
    "MoveCube": (
        "close gripper and push the cube@ to the target@",
        "pick up the cube@",
        "place the cube onto the target@",
        "pick up the peg@",
        "hook the cube@ to the target@ with the peg",
    ),
    "InsertPeg": (
        "pick up the peg by grasping the near end@",
        "pick up the peg by grasping the far end@",
        "insert the peg from the left side of the box@",
        "insert the peg from the right side of the box@",
    ),
    "PatternLock": (
        "move forward",
        "move backward",
        "move left",
        "move right",
        "move forward-left",
        "move forward-right",
        "move backward-left",
        "move backward-right",
    ),
    "RouteStick": tuple(
        f"move to the nearest {side} target by circling around the stick {direction}"
        for side in ("left", "right")
        for direction in ("clockwise", "counterclockwise")
    ),
}

LATE = frozenset(
    {
        "BinFill",
        "PickXtimes",
        "SwingXtimes",
        "ButtonUnmask",
        "ButtonUnmaskSwap",
        "PickHighlight",
        "VideoRepick",
        "VideoPlaceButton",
        "VideoPlaceOrder",
        "MoveCube",
        "InsertPeg",
    }
)
"""Tasks whose second question waits: their first subgoal takes longer than one interval."""

_NOTES = {
    "PickHighlight": (
        "The scene changes while the robot acts: after the button is pressed, cubes are highlighted"
        " one after another for a short time. Remember which cubes they were, and in which order."
    ),
    "MoveCube": (
        "The video shows which of three ways to use: pushing, picking and placing, or hooking with"
        " the peg."
    ),
    "InsertPeg": (
        "The video shows which end of the peg is grasped and from which side it is inserted."
    ),
    "PatternLock": (
        "Directions are those of the robot's base. The camera faces the robot: forward, away from"
        " the robot, is down in the image, and the robot's left is on the right-hand side of the"
        " image."
    ),
    "RouteStick": (
        "Directions are those of the robot's base. The camera faces the robot, so the robot's left"
        " is on the right-hand side of the image, and turning is judged from above."
    ),
}


def gemini_system(task: str, kind: str) -> str:
    """The system prompt.

    Args:
        task: its name; for an unknown one the subgoals of all tasks are listed. kind: `simple` or
            `grounded`.
    """
    example = example_of(task, kind)
    parts = [
        (
            "You watch a robot arm at a table through a camera in front of it, and tell it what to"
            " do next. You are given the task in words, then images or short videos of what"
            " happened. Break the task down into subgoals and name the one the robot has to work on"
            " now."
        ),
        *what_there_is(task, kind),
    ]
    parts.append(
        "Answer with JSON alone. To the first question: "
        f'{{"subgoal_sequence": ["{example}", …], "subgoal": "{example}"}}, the whole plan and the'
        " first subgoal. To "
        f'every later one: {{"description": "what happened since", "subgoal": "{example}"}}. Repeat'
        " the last subgoal "
        "while it is not finished yet."
    )
    return "\n\n".join(parts)


def what_there_is(task: str, kind: str) -> list[str]:
    """Paragraphs on a task: the subgoals it may have, what points are, and what is special about
    it.

    Args:
        task: its name; for an unknown one the subgoals of all tasks are listed. kind: `simple` or
            `grounded`.
    """
    templates = _subgoals(task, kind)
    parts = [
        "Subgoals of this task, to be used word for word ([ordinal] is first, second, third, …;"
        " [colour] is red, blue or green):\n" + "\n".join(f"- {text}" for text in templates)
    ]
    if kind == "grounded" and any(AT in text for text in templates):
        parts.append(
            "<y, x> is a point in the latest image: y is its row and x its column, whole numbers"
            " from 0 (top, left) to 1000 (bottom, right). Point at the middle of the object that is"
            " meant."
        )
    if task in _NOTES:
        parts.append(_NOTES[task])
    return parts


def example_of(task: str, kind: str) -> str:
    """One subgoal of a task, as a model is to write it."""
    text = _subgoals(task, kind)[0]
    filled = (
        text.replace("[ordinal]", "first")
        .replace("[colour]", "red")
        .replace("<y, x>", "<512, 430>")
    )
    assert POINT.search(filled) or "<" not in filled
    return filled


def _subgoals(task: str, kind: str) -> list[str]:
    templates = VOCABULARY.get(task) or tuple(
        dict.fromkeys(t for one in VOCABULARY.values() for t in one)
    )
    return [template.replace("@", AT if kind == "grounded" else "") for template in templates]


def first_query(goal: str, video: bool) -> str:
    """The first question; its images come before it, the demonstration video first."""
    context = (
        "The video shows what happened before the robot's turn, the image shows the scene now."
        if video
        else "The image shows the scene at the start."
    )
    return f"The task: {goal}\n{context} Plan the subgoals, and name the first one."


def next_query(clip: bool) -> str:
    """A later question; its video, or the single image of a very short stretch, comes before it."""
    context = (
        "This video shows what the robot did since." if clip else "This image shows the scene now."
    )
    return f"{context} Describe what happened, and name the current subgoal."


CLIP = 4  # frames: fewer are not worth a video


class GeminiEpisode(SubgoalEpisode):
    """An episode, its conversation, and the frames the model has not seen.

    messages: what was asked and answered, each a role and parts; a part is a text, or an image [H,
    W, 3] or video [t, H, W, 3], which is encoded once for all questions that show it.
    """

    def __init__(self, goal: str, video: np.ndarray | None, task: str) -> None:
        super().__init__(goal, video, task)
        self.messages: list[tuple[str, list[Any]]] = []
        self.unseen: list[np.ndarray] = []
        self.again = False

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        super().observe(frames, info)
        self.unseen += list(frames)

    def next_message(self) -> list[Any]:
        if self.messages:
            return self._since(self.unseen)
        video = [MediaPart(self.video)] if len(self.video) else []
        image = MediaPart(self.unseen[0] if self.unseen else self.frame)
        opening: list[Any] = [*video, image, first_query(self.goal, bool(video))]
        return opening + (self._since(self.unseen[1:]) if len(self.unseen) > 1 else [])

    def _since(self, frames: list[np.ndarray]) -> list[Any]:
        clip = len(frames) >= CLIP
        return [MediaPart(np.stack(frames) if clip else self.frame), next_query(clip)]


class PromptedPredictor(SubgoalPredictor):
    """What predictors with a model behind an API share; a subclass has `_ask`, which returns an
    episode's subgoal.

    Args:
        interval: steps between two questions. workers: questions under way at once.
        api: how the model is spoken to, a key of `mme_vla.subgoal.models.api.CONNECTIONS`.
        client: what the questions go to; None makes one. settings: of that API, checked here.
    """

    def __init__(
        self,
        kind: str,
        interval: int,
        workers: int,
        api: str,
        client: Any,
        settings: Mapping[str, Any],
    ) -> None:
        super().__init__(kind, interval)
        require(workers >= 1, f"workers={workers} must be at least 1: questions under way at once.")
        self.workers = workers
        self.api = make_api(api, settings, "subgoal", self.usage, client)
        self._lock = threading.Lock()

    def predict_due(self, episodes: Sequence[Any]) -> list[Subgoal]:
        return side_by_side(self._ask, episodes, self.workers)

    def _ask(self, episode: Any) -> Subgoal:
        raise NotImplementedError


@SUBGOALS.register("gemini")
class Gemini(PromptedPredictor):
    """Asks at the first step and then at multiples of `interval`, showing all frames since the last
    question.

    Nothing that goes wrong on the way ends an episode: it keeps its last subgoal, the problem is
    counted, and the frames the model has not seen go with the next question.

    Args:
        interval: steps between two questions.
        wait: for tasks with a long first subgoal, no second question due before this step.
        workers: questions under way at once.
        client: an object with google-genai's `client.models.generate_content`; None makes one.
        settings: keys of `mme_vla.subgoal.models.connection.Settings`.
    """

    provider = "gemini"
    episode_type = GeminiEpisode

    def __init__(
        self,
        kind: str = "grounded",
        interval: int = 48,
        wait: int = 75,
        workers: int = 4,
        client: Any = None,
        **settings: Any,
    ) -> None:
        super().__init__(kind, interval, workers, self.provider, client, settings)
        require(wait >= 0, f"wait={wait} must be a number of steps, 0 or more.")
        self.wait = wait

    def due(self, episode: SubgoalEpisode) -> bool:
        """Whether to ask now; a question that failed is repeated at the next opportunity."""
        assert isinstance(episode, GeminiEpisode)
        if episode.again or episode.query_step is None:
            return True
        return super().due(episode) and not (
            episode.task in LATE and self.due_step(episode) < self.wait
        )

    def _ask(self, episode: GeminiEpisode) -> Subgoal:
        message = ("user", episode.next_message())
        try:
            reply = self.api.ask(
                gemini_system(episode.task, self.kind), [*episode.messages, message]
            )
        except ApiFailure as failure:
            episode.again = True
            with self._lock:
                return self.unchanged(episode, failure.problem, reason=str(failure))
        episode.again = False
        episode.messages += [message, ("model", [reply.text])]
        episode.unseen = []
        with self._lock:
            return self._read(episode, reply)

    def _read(self, episode: GeminiEpisode, reply: Reply) -> Subgoal:
        try:
            text = parse_gemini(reply.text).lower()
            if says_done(text):
                return Subgoal(
                    episode.subgoal.text, episode.subgoal.points, queried=True, reply=reply.text
                )
            return self.accepted(pixels_of_pairs(text), reply.text)
        except MalformedReply as error:
            return self.unchanged(episode, "malformed", reply.text, str(error))


@SUBGOALS.register("openai")
class OpenAI(Gemini):
    """The same questions to any endpoint with OpenAI's chat completions; videos are shown as
    images.

    client: an object with openai's `client.chat.completions.create`; None makes one.
    settings: keys of `mme_vla.subgoal.models.connection.OpenAISettings`.
    """

    provider = "openai"
