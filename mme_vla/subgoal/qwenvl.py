"""`qwenvl`: a fine-tuned Qwen3-VL that reads the current image, the video and its own past
subgoals.
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from mme_vla.errors import require
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.answers import SubgoalHistory, hold_until
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.clips import Clip
from mme_vla.subgoal.models.qwen3vl import VLM, Completion, Question
from mme_vla.subgoal.text import (
    MalformedReply,
    parse_subgoal,
    subgoal_system,
    subgoal_user,
    write_boxes,
)


class VLMPredictor(SubgoalPredictor):
    """What `qwenvl` and `memer` share: one model for a batch of all episodes.

    Args:
        model: a repository on the hub, a folder, or `tiny`. adapter: LoRA weights to add; None for
            none.
        max_new_tokens: longest answer. batch_size: questions answered at once.
        device, dtype: where and how the model runs. vlm: a model that is loaded already, instead of
            all these.
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

    def ask(self, questions: Sequence[Question]) -> list[Completion]:
        started = time.perf_counter()
        completions = self.vlm.generate(questions, self.max_new_tokens)
        self.usage.seconds += time.perf_counter() - started
        self.usage.calls += len(completions)
        self.usage.input_tokens += sum(completion.input_tokens for completion in completions)
        self.usage.output_tokens += sum(completion.output_tokens for completion in completions)
        return completions


class QwenEpisode(SubgoalEpisode):
    """An episode and the subgoals it has had."""

    def __init__(self, goal: str, video: np.ndarray | None, task: str) -> None:
        super().__init__(goal, video, task)
        self.history = SubgoalHistory()


@SUBGOALS.register("qwenvl")
class QwenVL(VLMPredictor):
    """Predicts the next subgoal, given all that were different from the one before.

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
        """Whether to ask now: see `SubgoalPredictor`; what came due while the last subgoal is held
        is left out.
        """
        last = episode.subgoal.text
        on_hold = (
            self.hold
            and last is not None
            and self.due_step(episode) <= hold_until(episode.task, last)
        )
        return super().due(episode) and not on_hold

    def question(self, episode: QwenEpisode) -> Question:
        video = len(episode.video) > 0
        user = subgoal_user(self.kind, episode.goal, episode.history.entries, video)
        return Question(
            subgoal_system(self.kind),
            write_boxes(user, episode.history.points),
            [episode.frame],
            [Clip.of(episode.video)] if video else [],
        )

    def predict_due(self, episodes: Sequence[QwenEpisode]) -> list[Subgoal]:
        completions = self.ask([self.question(episode) for episode in episodes])
        return [
            self._read(e, completion.text)
            for e, completion in zip(episodes, completions, strict=True)
        ]

    def _read(self, episode: QwenEpisode, reply: str) -> Subgoal:
        try:
            parsed = parse_subgoal(reply)
        except MalformedReply as error:
            return self.unreadable(episode, reply, error)
        episode.history.add(parsed.entry, parsed.points)
        return self.accepted(parsed, reply)
