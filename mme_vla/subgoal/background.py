"""A predictor in the background: the policy acts on with the last subgoal until the next one is
there.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from typing import Any

import numpy as np

from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.models.api import start

GRACE = (
    2.0  # seconds that closing waits: better not to end the process while a local model computes
)


class BackgroundEpisode(SubgoalEpisode):
    """An episode as the policy sees it; the predictor's own (`inner`) waits while a model computes
    its subgoal.
    """

    def __init__(self, inner: SubgoalEpisode) -> None:
        super().__init__(inner.goal, inner.video, inner.task)
        self.inner = inner
        self.answered = False
        self.fresh = False
        self._news: list[Callable[[], None]] = []

    def skip(self, count: int) -> None:
        super().skip(count)
        self._news.append(lambda: self.inner.skip(count))

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        super().observe(frames, info)
        self._news.append(lambda: self.inner.observe(frames, info))

    def catch_up(self) -> SubgoalEpisode:
        """Pass on the frames since then; only while no model computes for this episode."""
        for tell in self._news:
            tell()
        self._news.clear()
        return self.inner


class BackgroundPredictor(SubgoalPredictor):
    """Runs another predictor in a thread.

    Only the first subgoal of an episode is waited for. Later a question goes out as soon as the
    thread is free, for all waiting episodes together, and its answer is used from the next chunk
    on; one that came due while the thread was busy goes out once it is free. The subgoals therefore
    depend on the speed of the model.

    Args:
        inner: the predictor. It is used by one thread at a time.
    """

    def __init__(self, inner: SubgoalPredictor) -> None:
        super().__init__(inner.kind, inner.interval)
        self.inner, self.usage, self.settings = inner, inner.usage, inner.settings
        self.sees_video, self.sees_passing = inner.sees_video, inner.sees_passing
        self._queried_episodes: list[BackgroundEpisode] = []
        self._prediction: Future[list[Subgoal]] | None = None

    def start_episode(
        self, goal: str, video: np.ndarray | None = None, task: str = ""
    ) -> BackgroundEpisode:
        return BackgroundEpisode(self.inner.start_episode(goal, video, task))

    def predict(self, episodes: Sequence[Any]) -> list[Subgoal]:
        """The newest subgoals there are; begins a prediction for the episodes that are due if the
        thread is free.

        Raises:
            Exception: what the predictor itself raised meanwhile.
        """
        self._collect()
        while not all(episode.answered for episode in episodes):
            self._ask(episodes)
            self._collect(wait=True)
        self._ask(episodes)
        subgoals = []
        for episode in episodes:
            last = episode.subgoal
            subgoals.append(last if episode.fresh else Subgoal(last.text, last.points))
            episode.fresh = False
        return subgoals

    def close(self) -> None:
        """Drop what is under way and free the predictor."""
        if self._prediction is not None:
            wait([self._prediction], GRACE)
        self.inner.close()

    def _ask(self, episodes: Sequence[BackgroundEpisode]) -> None:
        if self._prediction is not None:
            return
        # What was answered just now for the current frame need not be asked again.
        advanced = [
            e for e in episodes if not e.answered or e.inner.n_observed_frames < e.n_observed_frames
        ]
        due = [
            episode
            for episode in advanced
            if self.inner.due(episode.catch_up()) or not episode.answered
        ]
        if due:
            self._queried_episodes = due
            inner = [episode.inner for episode in due]
            self._prediction = start(lambda: self.inner.predict(inner))

    def _collect(self, wait: bool = False) -> None:
        if self._prediction is None or not (wait or self._prediction.done()):
            return
        subgoals, self._prediction = self._prediction.result(), None
        for episode, subgoal in zip(self._queried_episodes, subgoals, strict=True):
            episode.subgoal, episode.answered, episode.fresh = subgoal, True, True
            episode.query_step = episode.inner.query_step
        self._queried_episodes = []
