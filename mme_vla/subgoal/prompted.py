"""`openai` and `gemini`: a foundation model behind an endpoint, prompted and not trained.

Each episode is one conversation.
"""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mme_vla.errors import require
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.models.api import ApiFailure, MediaPart, Message, make_api
from mme_vla.subgoal.text import MalformedReply, parse_gemini, pixels_of_pairs, says_done
from mme_vla.subgoal.threads import side_by_side
from mme_vla.subgoal.vocabulary import LATE, describe_subgoals, example_of

CLIP = 4  # frames: fewer are shown as one image


def system_prompt(task: str, kind: str) -> str:
    """Return the system prompt.

    Args:
        task: its name; for an unknown one the subgoals of all tasks are listed.
        kind: `simple` or `grounded`.
    """
    example = example_of(task, kind)
    parts = [
        (
            "You watch a robot arm at a table through a camera in front of it, and tell it what to"
            " do next. You are given the task in words, then images or short videos of what"
            " happened. Break the task down into subgoals and name the one the robot has to work on"
            " now."
        ),
        *describe_subgoals(task, kind),
        (
            "Answer with JSON alone. To the first question: "
            f'{{"subgoal_sequence": ["{example}", …], "subgoal": "{example}"}}, the whole plan and'
            " the first subgoal. To every later one: "
            f'{{"description": "what happened since", "subgoal": "{example}"}}. Repeat the last'
            " subgoal while it is not finished yet."
        ),
    ]
    return "\n\n".join(parts)


class ConversationEpisode(SubgoalEpisode):
    """An episode, its conversation, and the frames the model has not seen.

    messages: questions and answers, each a role and parts.
    unseen: frames [H, W, 3] since the last question that was answered.
    again: the last question failed; it is repeated at the next opportunity.
    """

    def __init__(self, goal: str, video: np.ndarray | None, task: str) -> None:
        super().__init__(goal, video, task)
        self.messages: list[Message] = []
        self.unseen: list[np.ndarray] = []
        self.again = False

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        super().observe(frames, info)
        self.unseen += list(frames)

    def next_message(self) -> Message:
        """Return the next question, behind all frames that were not shown yet: the demonstration
        video first, a short stretch as one image.
        """
        parts: list[str | MediaPart] = []
        frames = self.unseen
        if not self.messages:
            if len(self.video):
                parts.append(MediaPart(self.video))
            first_frame = frames[0] if frames else self.frame
            parts.append(MediaPart(first_frame))
            context = "The image shows the scene at the start."
            if len(self.video):
                context = (
                    "The video shows what happened before the robot's turn, the image shows the"
                    " scene now."
                )
            parts.append(
                f"The task: {self.goal}\n{context} Plan the subgoals, and name the first one."
            )
            frames = frames[1:]
        # A first question that failed is followed by the frames since.
        if self.messages or frames:
            pixels = self.frame
            context = "This image shows the scene now."
            if len(frames) >= CLIP:
                pixels = np.stack(frames)
                context = "This video shows what the robot did since."
            question = f"{context} Describe what happened, and name the current subgoal."
            parts += [MediaPart(pixels), question]
        return "user", parts


class PromptedPredictor(SubgoalPredictor):
    """The base of predictors with a model behind an endpoint; a subclass implements `_predict_one`.

    No failure ends an episode: it keeps its last subgoal, and the problem is counted.

    Args:
        interval: steps between two questions.
        workers: questions under way at once.
        api: a key of `mme_vla.subgoal.models.api.PROVIDERS`, whose defaults hold.
        client: an object with openai's `chat.completions.create`; None makes one.
        settings: keys of `mme_vla.subgoal.models.api.Settings`.
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
        """Return the episode's subgoal, in a thread of its own."""
        replies: list[str] = []
        try:
            return self._predict_one(episode, replies)
        except ApiFailure as failure:
            problem, reason = failure.problem, str(failure)
        except MalformedReply as error:
            problem, reason = "malformed", str(error)
        with self._lock:
            return self.unchanged(episode, problem, "\n".join(replies), reason)

    def _predict_one(self, episode: Any, replies: list[str]) -> Subgoal:
        """Return the subgoal that the model names; each of its answers is added to `replies`."""
        raise NotImplementedError

    def _named(self, episode: SubgoalEpisode, replies: list[str]) -> Subgoal:
        """Return the subgoal that the last of these names, the episode's own if it is complete."""
        text = parse_gemini(replies[-1]).lower()
        together = "\n".join(replies)
        if says_done(text):
            last = episode.subgoal
            return Subgoal(last.text, last.points, queried=True, reply=together)
        parsed = pixels_of_pairs(text)
        return Subgoal(parsed.text, parsed.points, queried=True, reply=together)


@SUBGOALS.register("openai")
class OpenAI(PromptedPredictor):
    """Asks at the first step and at multiples of `interval`, showing all frames since.

    After a failure the frames the model has not seen go with the next question. Videos are shown
    as images.

    Args:
        interval: steps between two questions.
        wait: for tasks with a long first subgoal, no second question is due before this step.
        workers: questions under way at once.
        client: an object with openai's `chat.completions.create`; None makes one.
        settings: keys of `mme_vla.subgoal.models.api.Settings`.
    """

    provider = "openai"
    episode_type = ConversationEpisode

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

    def due(self, episode: Any) -> bool:
        """Return whether to ask now; a failed question is repeated at the next opportunity."""
        if episode.again or episode.query_step is None:
            return True
        if episode.task in LATE and self.due_step(episode) < self.wait:
            return False
        return super().due(episode)

    def _predict_one(self, episode: ConversationEpisode, replies: list[str]) -> Subgoal:
        message = episode.next_message()
        system = system_prompt(episode.task, self.kind)
        episode.again = True
        reply = self.api.ask(system, [*episode.messages, message]).text
        episode.again = False
        replies.append(reply)
        episode.messages += [message, ("model", [reply])]
        episode.unseen = []
        return self._named(episode, replies)


@SUBGOALS.register("gemini")
class Gemini(OpenAI):
    """As `OpenAI`, with the defaults of Google's endpoint."""

    provider = "gemini"
