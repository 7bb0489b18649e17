"""`SubgoalPredictor`: language subgoals for many running episodes at once.

As with the policy, what belongs to one episode lives in an object of its own (`start_episode`), and
`predict` returns for many episodes in one batch.
"""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from mme_vla.errors import UserError, did_you_mean, require
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.text import KINDS, Point

log = logging.getLogger(__name__)
PROBLEMS = ("malformed", "empty", "refused", "failed")
_CONFIG_TYPES = (str, int, float, bool, list, dict, type(None))  # the values of a configuration


@dataclass(frozen=True)
class Subgoal:
    """A subgoal for the policy, and its origin.

    text: the subgoal, points as `<row, column>` in pixels of the front image. It is None while
        there has been none; the policy's prompt is then the plain one.
    points: those points in order, (row, column).
    queried: whether a model was asked for this one; False for one that is kept.
    reply: of the model, unchanged; empty if none was asked.
    problem: why the answer could not be used (one of `PROBLEMS`), empty if it could. The last
        subgoal is then kept.
    """

    text: str | None
    points: tuple[Point, ...] = ()
    queried: bool = False
    reply: str = ""
    problem: str = ""


@dataclass
class Usage:
    """What a predictor has done so far, over all episodes.

    calls: questions that a model answered.
    cached: answers from the cache.
    input_tokens, output_tokens: as the model counts them.
    seconds: waited for answers.
    problems: unusable replies by kind.
    """

    calls: int = 0
    cached: int = 0
    input_tokens: int = 0
    output_tokens: int = 0
    seconds: float = 0.0
    problems: Counter[str] = field(default_factory=Counter)

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "problems": dict(self.problems)}


class SubgoalEpisode:
    """The state of a predictor in one episode.

    goal: the task in words, lower-case as in training.
    task: its name, empty if unknown.
    video: [t, H, W, 3] uint8, the conditioning video without the current frame; empty without one.
    frame: the current front image [H, W, 3] uint8.
    step: actions executed so far.
    info: what the environment reports beside the image.
    subgoal: the last prediction.
    query_step: the step of the last question; None while there was none.
    """

    def __init__(self, goal: str, video: np.ndarray | None = None, task: str = "") -> None:
        self.goal = goal.strip().lower()
        self.task = task
        if video is None:
            video = np.zeros((0, 1, 1, 3), np.uint8)
        self.video = _checked(video, "video")
        self.n_observed_frames = 0
        self.info: Mapping[str, Any] = {}
        self.subgoal = Subgoal(None)
        self.query_step: int | None = None
        self._frame: np.ndarray | None = None

    def skip(self, count: int) -> None:
        """Count execution frames that were not rendered, before the next `observe`.

        Only for predictors that do not read them (`SubgoalPredictor.sees_passing`).
        """
        self.n_observed_frames += count

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        """Add execution frames [n, H, W, 3] uint8 in order, each once, the current one last.

        Args:
            frames: of the front camera. The first call brings the first frame that is no video.
            info: the environment's report on the last of them (the oracle reads its subgoal there).
        """
        frames = _checked(frames, "frames")
        if len(frames):
            self._frame = frames[-1]
        self.n_observed_frames += len(frames)
        self.info = info or {}

    @property
    def step(self) -> int:
        """Actions executed so far: one frame each after the first."""
        return max(self.n_observed_frames - 1, 0)

    @property
    def frame(self) -> np.ndarray:
        if self._frame is None:
            raise UserError(
                "The episode has seen no frame yet: call observe() with the current one before"
                " predict()."
            )
        return self._frame


class SubgoalPredictor:
    """The interface of every predictor. A subclass implements `predict_due`.

    Args:
        kind: `simple` (words alone) or `grounded` (with points).
        interval: steps. A question is due at every multiple of it, and is sent with the first
            prediction from there on. A prediction is requested with every chunk, so 1 asks for
            each chunk.

    settings: the options that `build_predictor` built it from, as plain values; empty for one built
        otherwise.
    """

    sees_video = True
    """Whether `start_episode` needs the images of a conditioning video."""
    sees_passing = True
    """Whether it reads frames besides those at which `predict` is called."""
    episode_type: type[SubgoalEpisode] = SubgoalEpisode

    def __init__(self, kind: str = "grounded", interval: int = 1) -> None:
        require(kind in KINDS, f"subgoal.kind={kind!r}. {did_you_mean(str(kind), KINDS)}")
        require(interval >= 1, f"subgoal.interval={interval} must be a positive number of steps.")
        self.kind = kind
        self.interval = interval
        self.usage = Usage()
        self.settings: dict[str, Any] = {}

    def start_episode(
        self, goal: str, video: np.ndarray | None = None, task: str = ""
    ) -> SubgoalEpisode:
        """Begin an episode.

        Args:
            goal: the task in words.
            video: [t, H, W, 3] uint8, all frames before the first execution frame.
            task: its name (`ButtonUnmask`), for rules that hold for some tasks.
        """
        return self.episode_type(goal, video, task)

    def predict(self, episodes: Sequence[SubgoalEpisode]) -> list[Subgoal]:
        """Return the subgoals of these episodes at their current frames.

        Those that are due are asked in one batch. An answer that cannot be used is counted in
        `usage.problems`, and the episode keeps its last subgoal.
        """
        due = [episode for episode in episodes if self.due(episode)]
        for episode in episodes:
            episode.subgoal = Subgoal(episode.subgoal.text, episode.subgoal.points)
        if due:
            for episode, subgoal in zip(due, self.predict_due(due), strict=True):
                episode.subgoal = subgoal
                episode.query_step = episode.step
        return [episode.subgoal for episode in episodes]

    def due(self, episode: SubgoalEpisode) -> bool:
        """Return whether to ask now: for the first time, or a multiple of `interval` was passed."""
        return episode.query_step is None or self.due_step(episode) > episode.query_step

    def due_step(self, episode: SubgoalEpisode) -> int:
        """Return the step at which the newest question was due, however late it is sent."""
        return episode.step - episode.step % self.interval

    def predict_due(self, episodes: Sequence[Any]) -> list[Subgoal]:
        """Ask for these episodes, all at once where that is possible."""
        raise NotImplementedError

    def unchanged(self, episode: SubgoalEpisode, problem: str, reply: str, reason: str) -> Subgoal:
        """Return the episode's last subgoal, after an answer that cannot be used.

        The problem, one of `PROBLEMS`, is counted and logged.
        """
        self.usage.problems[problem] += 1
        log.warning(
            "Subgoal answer unusable (%s) at step %d, the last one is kept: %s",
            problem,
            episode.step,
            reason,
        )
        last = episode.subgoal
        return Subgoal(last.text, last.points, queried=True, reply=reply, problem=problem)

    def close(self) -> None:
        """Free what the predictor holds."""


def build_predictor(config: Mapping[str, Any] | None) -> SubgoalPredictor | None:
    """Build from the section `subgoal` of a configuration, or return None where there is none."""
    if not config or config.get("name") in (None, "none"):
        return None
    predictor: SubgoalPredictor = SUBGOALS.build(config)
    for key, value in config.items():
        # Objects such as a client or a loaded model are no settings.
        if key != "name" and isinstance(value, _CONFIG_TYPES):
            predictor.settings[key] = value
    return predictor


def _checked(frames: np.ndarray, what: str) -> np.ndarray:
    frames = np.asarray(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
        raise UserError(
            f"{what} must be uint8 [n, height, width, 3]; got {frames.dtype} {frames.shape}."
        )
    return frames
