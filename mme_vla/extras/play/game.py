"""One episode as a sequence of choices: what has been shown, what can be chosen, what was chosen,
how it ended.

Execution videos are revealed one after the other, the next high-level action is chosen from a fixed
set, with a pixel where it needs one, and an oracle planner carries it out (paper, "Oracle Planner
and Human Study"). People, models and scripts play through the same object.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from mme_vla.embodiment.action_space import Option
from mme_vla.embodiment.robomme import SIDE
from mme_vla.envs.grounding import project
from mme_vla.envs.metadata import DEFAULT_STEPS, EpisodeSpec
from mme_vla.envs.scene_hash import NO_VALUES
from mme_vla.errors import UserError, did_you_mean, require
from mme_vla.evaluation.records import OUTCOMES, EpisodeRecord, Seconds
from mme_vla.evaluation.rollout.environment import is_out_of_reach

ONGOING = "ongoing"
UNSEEN = np.zeros((SIDE, SIDE, 3), np.uint8)  # Frame of an environment that does not render
MAX_CHOICES = 60  # the longest episode of the benchmark needs fewer than 30


@dataclass(frozen=True)
class Reveal:
    """Frames that are shown together.

    title: what they show.
    frames: [256, 256, 3] uint8 each, maybe none.
    start: place of the first in the episode.
    """

    title: str
    frames: Sequence[np.ndarray]
    start: int


@dataclass(frozen=True)
class Decision:
    """One choice and what came of it.

    choice: letter.
    action: its text.
    point: pixel [y, x] of the front image, None where it needs none.
    frames: [first, stop) of what it revealed, in frames of the episode.
    status: after it.
    seconds: from the arrival of the frames to the choice.
    note: the player's addition.
    """

    choice: str
    action: str
    point: tuple[float, float] | None
    frames: tuple[int, int]
    status: str
    seconds: float
    note: Mapping[str, Any] = field(default_factory=dict)


class ChoiceSession:
    """Plays one episode in the action space `multi_choice`.

    Args:
        env: with `reset` and `step` of `mme_vla.envs` (or the official package's), in that action
            space.
        episode: which one it is.
        images: whether the player reads them; without, the environment need not render, and frames
            are black.
        max_choices: choices after which the episode counts as timed out; None: any number.
        clock: seconds that only grow.
        max_steps: control steps after which it does, where a choice that moves nothing takes one,
            as in an evaluation; None: the environment's own limit.

    Example:
        >>> session = ChoiceSession(env, episode)  # doctest: +SKIP
        >>> session.start()  # doctest: +SKIP
        >>> while not session.over:  # doctest: +SKIP
        ...     session.choose({"choice": "a", "point": [113, 158]})
        >>> session.record("human")  # doctest: +SKIP
    """

    def __init__(
        self,
        env: Any,
        episode: EpisodeSpec,
        max_choices: int | None = MAX_CHOICES,
        images: bool = True,
        clock: Callable[[], float] = time.perf_counter,
        max_steps: int | None = None,
    ) -> None:
        self.env = env
        self.episode = episode
        self.max_choices = max_choices
        self.images = images
        self._max_steps = max_steps
        self._motionless = 0  # choices that moved nothing
        self.goal = ""
        self.status = "not started"
        self.error = ""
        self.ended_by = ""
        """What ended the episode where it was not the environment: `max_choices`, `max_steps`, or a
        player's reason.
        """
        self.options: tuple[Option, ...] = ()
        self.observation: Mapping[str, Any] = {}
        self.info: Mapping[str, Any] = {}
        """What the environment returned last, for players that read more than images."""
        self.reveals: list[Reveal] = []
        self.decisions: list[Decision] = []
        self._clock = clock
        self._displayed_at = 0.0
        self._begun = clock()
        self._simulated = self._policy_seconds = 0.0

    # Playing --------------------------------------------------------------------------------------

    def start(self) -> Reveal:
        """Reset the environment, which shows the conditioning video, if any, and then the present
        frame.
        """
        require(not self.reveals, "This session has begun; make a new one for another episode.")
        started = self._clock()
        observation, info = self.env.reset()
        self._simulated += self._clock() - started
        frames = self._frames(observation)
        if not frames:
            raise UserError("The environment shows no images: make it with render=True.")
        if "available_multi_choices" not in info:
            raise UserError(
                'The environment offers no options: make it with action_space="multi_choice".'
            )
        title = "Conditioning video" if len(frames) > 1 else "The scene"
        self._take(frames, info, title)
        return self.reveals[0]

    def choose(self, action: Mapping[str, Any], note: Mapping[str, Any] | None = None) -> Reveal:
        """Carry out an option.

        action: {"choice": letter, "point": [y, x]}; the point is read only where the option needs
            one.
        note: what to keep with the decision.

        Returns:
            The frames of the motion; none where nothing moved, or the environment could not do it.
        """
        option, point = self.check(action)
        self._policy_seconds += (seconds := self._clock() - self._displayed_at)
        started = self._clock()
        env_action = {"choice": option.label, "point": [] if point is None else list(point)}
        observation, _, _, _, info = self.env.step(env_action)
        self._simulated += self._clock() - started
        frames = self._frames(observation or {})
        first = self.n_displayed_frames
        self._motionless += not frames
        self.error = str(info.get("error_message", ""))
        if info["status"] == "error" and is_out_of_reach(observation, info):
            info = {**info, "status": "fail"}
        self._take(frames, info, option.action)
        span = (first, first + len(frames))
        self.decisions.append(
            Decision(
                option.label,
                option.action,
                point,
                span,
                self.status,
                round(seconds, 3),
                dict(note or {}),
            )
        )
        if self.over:
            return self.reveals[-1]
        if self.max_choices is not None and len(self.decisions) >= self.max_choices:
            self.give_up("timeout", "max_choices")
        elif self._max_steps is not None and self.steps + self._motionless > self._max_steps:
            self.give_up("timeout", "max_steps")
        return self.reveals[-1]

    def check(self, action: Mapping[str, Any]) -> tuple[Option, tuple[float, float] | None]:
        """The option and point that an action means."""
        if not self.reveals:
            raise UserError("No choice can be made before start().")
        if self.status != ONGOING:
            raise UserError(f"No choice can be made: the episode is over ({self.status}).")
        choice = action.get("choice") if isinstance(action, Mapping) else None
        if not isinstance(choice, str):
            raise UserError(
                f'{action!r} is no choice; expected {{"choice": "a", "point": [y, x]}}.'
            )
        label = choice.strip().lower()
        options = {option.label: option for option in self.options}
        if label not in options:
            raise UserError(f"There is no option {choice!r}. {did_you_mean(label, options)}")
        option = options[label]
        if not option.needs_point:
            return option, None

        # The point is a pixel (row, column) of the front image.
        point = action.get("point")
        try:
            values = np.asarray([] if point is None else point, np.float64)
        except (TypeError, ValueError):
            values = np.empty(1)
        problem = ""
        if not values.size:
            problem = "needs a point: the pixel [row, column] of the object meant"
        elif values.shape != (2,) or not np.isfinite(values).all():
            problem = f"needs two numbers as its point, a pixel's row and column; got {point!r}"
        elif not ((values >= 0) & (values < SIDE)).all():
            problem = (
                f"needs a point of the image, and {point} lies outside of the image: 0 to"
                f" {SIDE - 1}"
            )
        require(not problem, f"Option {option.label!r} ({option.action}) {problem}.")
        return option, (float(values[0]), float(values[1]))

    def give_up(self, outcome: str, reason: str) -> None:
        """End the episode without the environment. outcome: what it counts as. reason: why, kept in
        the record.
        """
        if outcome not in OUTCOMES or self.over:
            raise ValueError(f"An episode that is {self.status} cannot end with {outcome!r}.")
        self.status, self.ended_by = outcome, reason
        if outcome == "error":
            self.error = reason

    # What there is to see -------------------------------------------------------------------------

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return self.status in OUTCOMES

    @property
    def n_displayed_frames(self) -> int:
        """Frames revealed so far."""
        return sum(len(reveal.frames) for reveal in self.reveals)

    @property
    def frame(self) -> np.ndarray:
        """The present front image [256, 256, 3]: points are pixels of it."""
        return next(reveal.frames[-1] for reveal in reversed(self.reveals) if len(reveal.frames))

    @property
    def steps(self) -> int:
        """Control steps executed: one for each frame after those of the reset."""
        return sum(len(reveal.frames) for reveal in self.reveals[1:])

    def record(
        self,
        model: str,
        checkpoint: int | str = 0,
        model_seed: int = 0,
        max_steps: int = DEFAULT_STEPS,
        **extra: Any,
    ) -> EpisodeRecord:
        """The episode as evaluation keeps it, its decisions in `extra`."""
        require(
            self.over, f"The episode is not over ({self.status}); there is nothing to record yet."
        )
        which = self.episode
        ended = {"ended_by": self.ended_by} if self.ended_by else {}
        reason = self.error or None
        failed = self.status == "error"
        return EpisodeRecord(
            model=model,
            checkpoint=checkpoint,
            model_seed=model_seed,
            max_steps=max_steps,
            action_space="multi_choice",
            task=which.task,
            episode=which.episode,
            seed=which.seed,
            difficulty=which.difficulty,
            split=which.split,
            scene=getattr(self.env, "scene_digest", NO_VALUES),
            outcome=self.status,
            steps=self.steps,
            error=reason if failed else None,
            refused=None if failed else reason,
            seconds=Seconds(
                round(self._simulated, 3),
                round(self._policy_seconds, 3),
                round(self._clock() - self._begun, 3),
            ),
            extra={
                "decisions": [asdict(decision) for decision in self.decisions],
                **ended,
                **extra,
            },
        )

    def objects(self) -> dict[str, list[tuple[float, float]]]:
        """Letter of an option → pixel [y, x] of each object among which its point chooses now.
        Empty where the environment is no task of this library.
        """
        task: Any = getattr(self.env, "task", None)
        pixels: dict[str, list[tuple[float, float]]] = {}
        if not hasattr(task, "choices"):
            return pixels
        for choice in task.choices():
            if choice.candidates is not None:
                pixels[choice.label] = []
                for thing in choice.candidates:
                    pixels[choice.label].append(tuple(project(thing.position).tolist()))
        return pixels

    def close(self) -> None:
        """Free the environment."""
        self.env.close()

    def _frames(self, observation: Mapping[str, Any]) -> list[np.ndarray]:
        self.observation = observation
        if self.images:
            return list(observation.get("front_rgb_list", ()))
        return [UNSEEN] * max((len(values) for values in observation.values()), default=0)

    def _take(self, frames: list[np.ndarray], info: Mapping[str, Any], title: str) -> None:
        self.reveals.append(Reveal(title, frames, self.n_displayed_frames))
        self.info = info
        self.status = str(info["status"])
        if info.get("task_goal"):
            goal = info["task_goal"]
            self.goal = goal if isinstance(goal, str) else str(goal[0])
        if "available_multi_choices" in info:
            options = []
            for option in info["available_multi_choices"]:
                if option.get("possible", True):
                    label = str(option["label"]).lower()
                    needs_point = bool(option["need_parameter"])
                    options.append(Option(label, str(option["action"]), needs_point))
            self.options = tuple(options)
        self._displayed_at = self._clock()
