"""`qwenvl`: a fine-tuned Qwen3-VL that reads the image, the video and its past subgoals."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from mme_vla.errors import require
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.answers import SubgoalHistory, hold_until
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.clips import Clip
from mme_vla.subgoal.models.qwen3vl import VLM, Question
from mme_vla.subgoal.text import (
    MalformedReply,
    parse_subgoal,
    subgoal_system,
    subgoal_user,
    write_boxes,
)


class VLMPredictor(SubgoalPredictor):
    """The base of `qwenvl` and `memer`: one model asks for all episodes in batches.

    A subclass implements `question` and `read`.

    Args:
        model: a repository on the hub, a folder, or `tiny`.
        adapter: LoRA weights to add; None for none.
        max_new_tokens: longest answer.
        batch_size: questions answered at once.
        device, dtype: where and how the model runs.
        vlm: a model that is loaded already, instead of all these.
    """

    def __init__(
        self,
        kind: str = "grounded",
        interval: int = 1,
        model: str = "Qwen/Qwen3-VL-4B-Instruct",
        adapter: str | None = None,
        max_new_tokens: int = 128,
        batch_size: int = 8,
        device: str = "auto",
        dtype: str = "bfloat16",
        vlm: VLM | None = None,
    ) -> None:
        super().__init__(kind, interval)
        require(max_new_tokens >= 1, f"max_new_tokens={max_new_tokens} must be at least 1.")
        self.max_new_tokens = max_new_tokens
        self.vlm = vlm or VLM.load(
            model, adapter, device=device, dtype=dtype, batch_size=batch_size
        )

    def question(self, episode: Any) -> Question:
        """Return the next question of an episode."""
        raise NotImplementedError

    def read(self, episode: Any, reply: str) -> Subgoal:
        """Return the subgoal of a reply, and update the episode.

        Raises:
            MalformedReply: the reply cannot be used. The episode is as it was.
        """
        raise NotImplementedError

    def predict_due(self, episodes: Sequence[Any]) -> list[Subgoal]:
        questions = [self.question(episode) for episode in episodes]
        started = time.perf_counter()
        completions = self.vlm.generate(questions, self.max_new_tokens)
        self.usage.seconds += time.perf_counter() - started
        subgoals = []
        for episode, completion in zip(episodes, completions, strict=True):
            self.usage.calls += 1
            self.usage.input_tokens += completion.input_tokens
            self.usage.output_tokens += completion.output_tokens
            try:
                subgoal = self.read(episode, completion.text)
            except MalformedReply as error:
                problem = "malformed" if completion.text.strip() else "empty"
                subgoal = self.unchanged(episode, problem, completion.text, str(error))
            subgoals.append(subgoal)
        return subgoals


class QwenEpisode(SubgoalEpisode):
    """An episode and its past subgoals."""

    def __init__(self, goal: str, video: np.ndarray | None, task: str) -> None:
        super().__init__(goal, video, task)
        self.history = SubgoalHistory()


@SUBGOALS.register("qwenvl")
class QwenVL(VLMPredictor):
    """Predicts the next subgoal from the image, the video and the past subgoals.

    Args:
        hold: keep the first subgoals of three tasks for a fixed time, as released.
    """

    sees_passing = False
    episode_type = QwenEpisode

    def __init__(
        self, kind: str = "grounded", interval: int = 1, hold: bool = True, **options: Any
    ) -> None:
        super().__init__(kind, interval, **options)
        self.hold = hold

    def due(self, episode: SubgoalEpisode) -> bool:
        """As `SubgoalPredictor.due`, without the questions of the time that a subgoal is kept."""
        last = episode.subgoal.text
        if not self.hold or last is None:
            return super().due(episode)
        return self.due_step(episode) > hold_until(episode.task, last) and super().due(episode)

    def question(self, episode: QwenEpisode) -> Question:
        history = episode.history
        clips = [Clip.of(episode.video)] if len(episode.video) else []
        user = subgoal_user(self.kind, episode.goal, history.entries, len(clips) > 0)
        user = write_boxes(user, history.points)
        return Question(subgoal_system(self.kind), user, [episode.frame], clips)

    def read(self, episode: QwenEpisode, reply: str) -> Subgoal:
        parsed = parse_subgoal(reply)
        episode.history.add(parsed.entry, parsed.points)
        return Subgoal(parsed.text, parsed.points, queried=True, reply=reply)
