"""`memer`: a fine-tuned Qwen3-VL that chooses keyframes and reads them again (MemER, as the paper
runs it).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.answers import merge_keyframes, recent_frames
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode
from mme_vla.subgoal.clips import Clip
from mme_vla.subgoal.models.qwen3vl import Question
from mme_vla.subgoal.qwenvl import VLMPredictor
from mme_vla.subgoal.text import MEMER_SYSTEM, MalformedReply, memer_user, parse_memer


class MemerEpisode(SubgoalEpisode):
    """An episode, its keyframes, and as many frames back as the next question may show.

    keyframes: frame number (from the first execution frame) → image.
    """

    def __init__(self, goal: str, video: np.ndarray | None, task: str, reach: int) -> None:
        super().__init__(goal, video, task)
        self.keyframes: dict[int, np.ndarray] = {}
        self.queried = False
        self._recent: dict[int, np.ndarray] = {}
        self._reach = reach

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        first = self.n_observed_frames
        super().observe(frames, info)
        self._recent |= {first + i: frame for i, frame in enumerate(frames)}
        self._recent = {
            t: frame
            for t, frame in self._recent.items()
            if t >= self.n_observed_frames - self._reach
        }

    def recent(self, count: int, stride: int) -> dict[int, np.ndarray]:
        """The recent frames the next question shows, by number."""
        indices = recent_frames(self.step, self.queried, count, stride)
        return {t: self._recent[t] for t in indices}

    def add_keyframes(self, frames: Mapping[int, np.ndarray], distance: int) -> None:
        known = self.keyframes | dict(frames)
        self.keyframes = {t: known[t] for t in merge_keyframes(list(known), distance)}


@SUBGOALS.register("memer")
class Memer(VLMPredictor):
    """Shows the model its keyframes and the recent frames; the answer names the subgoal and new
    keyframes.

    After an answer that cannot be read the keyframes and the last subgoal stay (the released code
    fails there).

    Args:
        recent: frames shown besides the keyframes. stride: steps between two of them.
        merge_distance: keyframes at most so far apart are thinned out to their middle one.
    """

    def __init__(
        self,
        kind: str = "grounded",
        interval: int = 1,
        recent: int = 8,
        stride: int = 2,
        merge_distance: int = 8,
        **options: Any,
    ) -> None:
        super().__init__(kind, interval, **options)
        self.recent, self.stride, self.merge_distance = recent, stride, merge_distance

    def start_episode(
        self, goal: str, video: np.ndarray | None = None, task: str = ""
    ) -> MemerEpisode:
        return MemerEpisode(goal, video, task, (self.recent - 1) * self.stride + 1)

    def question(self, episode: MemerEpisode) -> Question:
        recent = episode.recent(self.recent, self.stride)
        video = len(episode.video) > 0
        user = memer_user(episode.goal, len(episode.keyframes), len(recent), video)
        images = [*episode.keyframes.values(), *recent.values()]
        return Question(MEMER_SYSTEM, user, images, [Clip.of(episode.video)] if video else [])

    def predict_due(self, episodes: Sequence[MemerEpisode]) -> list[Subgoal]:
        _ = [episode.frame for episode in episodes]  # every episode has seen something
        completions = self.ask([self.question(episode) for episode in episodes])
        return [
            self._read(e, completion.text)
            for e, completion in zip(episodes, completions, strict=True)
        ]

    def _read(self, episode: MemerEpisode, reply: str) -> Subgoal:
        recent = episode.recent(self.recent, self.stride)
        episode.queried = True
        try:
            parsed, positions = parse_memer(reply, len(recent))
        except MalformedReply as error:
            return self.unreadable(episode, reply, error)
        numbers = list(recent)
        episode.add_keyframes(
            {numbers[p - 1]: recent[numbers[p - 1]] for p in positions}, self.merge_distance
        )
        return self.accepted(parsed, reply)
