"""`gemini`: a foundation model behind an API, prompted and not trained; one conversation an episode."""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mme_vla.errors import UserError
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.models.api import ApiFailure, Reply, make_api
from mme_vla.subgoal.models.connection import Shown
from mme_vla.subgoal.models.threads import side_by_side
from mme_vla.subgoal.words.gemini_prompts import LATE, first_query, gemini_system, next_query
from mme_vla.subgoal.words.parsing import MalformedAnswer, parse_gemini, pixels_of_pairs, says_done

CLIP = 4  # frames: fewer are not worth a video


class GeminiEpisode(SubgoalEpisode):
    """An episode, its conversation, and the frames the model has not seen.

    turns: what was asked and answered, each a role and parts; a part is a text, or a picture [H, W, 3] or video
    [t, H, W, 3], which is encoded once for all questions that show it.
    """

    def __init__(self, goal: str, video: np.ndarray | None, task: str) -> None:
        super().__init__(goal, video, task)
        self.turns: list[tuple[str, list[Any]]] = []
        self.unseen: list[np.ndarray] = []
        self.again = False

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        """Take frames, see `SubgoalEpisode`; they wait for the next question."""
        super().observe(frames, info)
        self.unseen += list(frames)

    def next_turn(self) -> list[Any]:
        """The parts of the next question."""
        if self.turns:
            return self._since(self.unseen)
        video = [Shown(self.video)] if len(self.video) else []
        picture = Shown(self.unseen[0] if self.unseen else self.frame)
        opening: list[Any] = [*video, picture, first_query(self.goal, bool(video))]
        return opening + (self._since(self.unseen[1:]) if len(self.unseen) > 1 else [])

    def _since(self, frames: list[np.ndarray]) -> list[Any]:
        clip = len(frames) >= CLIP
        return [Shown(np.stack(frames) if clip else self.frame), next_query(clip)]


@SUBGOALS.register("gemini")
class Gemini(SubgoalPredictor):
    """Asks at the first step and then at multiples of `interval`, showing all frames since the last question.

    Nothing that goes wrong on the way ends an episode: it keeps its last subgoal, the problem is counted, and the
    frames the model has not seen go with the next question.

    Args:
        interval: steps between two questions.
        wait: for tasks with a long first subgoal, no second question due before this step.
        workers: questions under way at once.
        client: an object with google-genai's `client.models.generate_content`; None makes one.
        settings: keys of `mme_vla.subgoal.models.connection.Settings`.
    """

    speaks = "gemini"

    def __init__(
        self,
        kind: str = "grounded",
        interval: int = 48,
        wait: int = 75,
        workers: int = 4,
        client: Any = None,
        **settings: Any,
    ) -> None:
        super().__init__(kind, interval)
        if workers < 1:
            raise UserError(f"workers={workers} must be at least 1: questions under way at once.")
        if wait < 0:
            raise UserError(f"wait={wait} must be a number of steps, 0 or more.")
        self.wait, self.workers = wait, workers
        self.api = make_api(self.speaks, settings, "subgoal", self.usage, client)
        self._lock = threading.Lock()

    def start_episode(self, goal: str, video: np.ndarray | None = None, task: str = "") -> GeminiEpisode:
        """Begin an episode, see `SubgoalPredictor`."""
        return GeminiEpisode(goal, video, task)

    def due(self, episode: SubgoalEpisode) -> bool:
        """Whether to ask now; a question that failed is repeated at the next opportunity."""
        assert isinstance(episode, GeminiEpisode)
        if episode.again or episode.asked_step is None:
            return True
        return super().due(episode) and not (episode.task in LATE and self.due_step(episode) < self.wait)

    def answer(self, episodes: Sequence[GeminiEpisode]) -> list[Subgoal]:
        """Ask for all of them, some at a time."""
        return side_by_side(self._ask, episodes, self.workers)

    def _ask(self, episode: GeminiEpisode) -> Subgoal:
        turn = ("user", episode.next_turn())
        try:
            reply = self.api.ask(gemini_system(episode.task, self.kind), [*episode.turns, turn])
        except ApiFailure as failure:
            episode.again = True
            with self._lock:
                return self.kept(episode, failure.problem, reason=str(failure))
        episode.again = False
        episode.turns += [turn, ("model", [reply.text])]
        episode.unseen = []
        with self._lock:
            return self._read(episode, reply)

    def _read(self, episode: GeminiEpisode, reply: Reply) -> Subgoal:
        try:
            text = parse_gemini(reply.text).lower()
            if says_done(text):
                return Subgoal(episode.subgoal.text, episode.subgoal.points, asked=True, answer=reply.text)
            return self.accepted(pixels_of_pairs(text), reply.text)
        except MalformedAnswer as error:
            return self.kept(episode, "malformed", reply.text, str(error))


@SUBGOALS.register("openai")
class OpenAI(Gemini):
    """The same questions to any endpoint that speaks OpenAI's chat completions; videos are shown as pictures.

    client: an object with openai's `client.chat.completions.create`; None makes one.
    settings: keys of `mme_vla.subgoal.models.openai_chat.OpenAISettings`.
    """

    speaks = "openai"
