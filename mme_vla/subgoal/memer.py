"""`memer`: a fine-tuned Qwen3-VL that chooses keyframes and reads them again.

This is MemER as the paper runs it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.answers import merge_keyframes, recent_frames
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode
from mme_vla.subgoal.clips import Clip
from mme_vla.subgoal.models.qwen3vl import Question
from mme_vla.subgoal.qwenvl import VLMPredictor
from mme_vla.subgoal.text import MEMER_SYSTEM, memer_user, parse_memer


class MemerEpisode(SubgoalEpisode):
    """An episode, its keyframes, and the frames that the next question may show.

    Frame numbers count from the first execution frame.

    Args:
        reach: how many frames back the next question may show.

    keyframes: frame number → image.
    """

    def __init__(self, goal: str, video: np.ndarray | None, task: str, reach: int) -> None:
        super().__init__(goal, video, task)
        self.keyframes: dict[int, np.ndarray] = {}
        self._recent: dict[int, np.ndarray] = {}
        self._reach = reach

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        number = self.n_observed_frames
        super().observe(frames, info)
        for frame in frames:
            self._recent[number] = frame
            number += 1
        for old in [t for t in self._recent if t < number - self._reach]:
            del self._recent[old]

    def recent(self, count: int, stride: int) -> dict[int, np.ndarray]:
        """Return the recent frames that the next question shows, by number."""
        numbers = recent_frames(self.step, self.query_step is not None, count, stride)
        return {t: self._recent[t] for t in numbers}


@SUBGOALS.register("memer")
class Memer(VLMPredictor):
    """Shows the model its keyframes and the recent frames; the answer names the subgoal and new
    keyframes.

    After an answer that cannot be read the keyframes and the last subgoal stay (the released code
    fails there).

    Args:
        recent: frames shown besides the keyframes.
        stride: steps between two of them.
        merge_distance: steps; keyframes at most so far apart are thinned out to their middle one.
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
        self.recent = recent
        self.stride = stride
        self.merge_distance = merge_distance

    def start_episode(
        self, goal: str, video: np.ndarray | None = None, task: str = ""
    ) -> MemerEpisode:
        reach = (self.recent - 1) * self.stride + 1
        return MemerEpisode(goal, video, task, reach)

    def question(self, episode: MemerEpisode) -> Question:
        _ = episode.frame  # raises an error where the episode has seen no frame yet
        recent = episode.recent(self.recent, self.stride)
        clips = [Clip.of(episode.video)] if len(episode.video) else []
        user = memer_user(episode.goal, len(episode.keyframes), len(recent), len(clips) > 0)
        images = [*episode.keyframes.values(), *recent.values()]
        return Question(MEMER_SYSTEM, user, images, clips)

    def read(self, episode: MemerEpisode, reply: str) -> Subgoal:
        recent = episode.recent(self.recent, self.stride)
        parsed, positions = parse_memer(reply, len(recent))
        numbers = list(recent)
        keyframes = dict(episode.keyframes)
        for position in positions:  # from 1
            number = numbers[position - 1]
            keyframes[number] = recent[number]
        merged = merge_keyframes(list(keyframes), self.merge_distance)
        episode.keyframes = {t: keyframes[t] for t in merged}
        return Subgoal(parsed.text, parsed.points, queried=True, reply=reply)
