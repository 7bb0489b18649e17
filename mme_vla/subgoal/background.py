"""A predictor in the background: the policy acts with the last subgoal until the next one comes."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from typing import Any

import numpy as np

from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.threads import start

# Seconds that closing waits: a process should not end while a local model computes.
GRACE = 2.0


class BackgroundEpisode(SubgoalEpisode):
    """An episode as the policy sees it.

    inner: the episode of the predictor, which may be busy with it. Frames are passed on later.
    subgoal: the last answer; `queried` until `predict` has returned it.
    delayed: the frames that `inner` has not been given yet, as calls.
    answered: whether there was an answer yet.
    """

    def __init__(self, inner: SubgoalEpisode) -> None:
        super().__init__(inner.goal, inner.video, inner.task)
        self.inner = inner
        self.answered = False
        self.delayed: list[Callable[[], None]] = []

    def skip(self, count: int) -> None:
        super().skip(count)
        self.delayed.append(lambda: self.inner.skip(count))

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        super().observe(frames, info)
        self.delayed.append(lambda: self.inner.observe(frames, info))


class BackgroundPredictor(SubgoalPredictor):
    """Runs another predictor in a thread.

    Only the first subgoal of an episode is waited for. Later a question is sent as soon as the
    thread is free, for all waiting episodes together, and its answer is used from the next chunk
    on. A question that came due while the thread was busy is sent once it is free. The subgoals
    therefore depend on the speed of the model.

    Args:
        inner: the predictor. It is used by one thread at a time.
    """

    def __init__(self, inner: SubgoalPredictor) -> None:
        super().__init__(inner.kind, inner.interval)
        self.inner = inner
        self.usage = inner.usage
        self.settings = inner.settings
        self.sees_video = inner.sees_video
        self.sees_passing = inner.sees_passing
        self._prediction: Future[list[tuple[BackgroundEpisode, Subgoal]]] | None = None

    def start_episode(
        self, goal: str, video: np.ndarray | None = None, task: str = ""
    ) -> BackgroundEpisode:
        return BackgroundEpisode(self.inner.start_episode(goal, video, task))

    def predict(self, episodes: Sequence[Any]) -> list[Subgoal]:
        """Return the newest subgoals; start a prediction for due episodes if the thread is free.

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
            subgoals.append(episode.subgoal)
            episode.subgoal = Subgoal(episode.subgoal.text, episode.subgoal.points)
        return subgoals

    def close(self) -> None:
        """Drop the prediction that is under way and close the predictor."""
        if self._prediction is not None:
            wait([self._prediction], GRACE)
        self.inner.close()

    def _ask(self, episodes: Sequence[BackgroundEpisode]) -> None:
        """Start a prediction for the episodes that are due, unless one is under way."""
        if self._prediction is not None:
            return
        due = []
        for episode in episodes:
            has_news = episode.inner.n_observed_frames < episode.n_observed_frames
            if episode.answered and not has_news:
                continue  # answered just now, for the current frame
            # No model computes for this episode: its predictor catches up.
            for pass_on in episode.delayed:
                pass_on()
            episode.delayed.clear()
            if not episode.answered or self.inner.due(episode.inner):
                due.append(episode)
        if due:
            inner = [episode.inner for episode in due]
            self._prediction = start(lambda: list(zip(due, self.inner.predict(inner), strict=True)))

    def _collect(self, wait: bool = False) -> None:
        """Take the subgoals of the prediction under way, if it has ended."""
        prediction = self._prediction
        if prediction is None or not (wait or prediction.done()):
            return
        self._prediction = None  # an error is raised once: the next question may be answered
        for episode, subgoal in prediction.result():
            episode.subgoal = subgoal
            episode.query_step = episode.inner.query_step
            episode.answered = True
