"""`Environment`: tasks, their episodes by split, and how one is made. `env=NAME` selects one in
every command.

RoboMME is one entry of the registry (`mme_vla/envs/benchmark.py`). An environment of your own is a
class beside a `gymnasium.Env`, whose observations are a dict: a uint8 image [H, W, 3] for each
camera of the embodiment, and `state`, float32 [s]. Its info dict may hold `goal` (text, needed on
reset), `video` (on reset: earlier observations, which become the conditioning video), `success`
(bool) and `subgoal` (text).
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.action_space import Option
from mme_vla.envs.facts import Fact
from mme_vla.envs.metadata import DEFAULT_STEPS, EpisodeSpec
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT, scene_digest
from mme_vla.errors import check_known, listed, require
from mme_vla.registry import ENVS

Actions = Sequence[Any]
"""Actions that `step` takes, one after the other."""
CHOICES = "multi_choice"
_FIRST_SEED = {"train": 0, "test": 500_000, "val": 1_000_000}
_OTHER_SPLITS = 2_000_000  # first seed of splits with other names
_LETTERS = "abcdefghijklmnopqrstuvwxyz"


@dataclass(frozen=True)
class Hold:
    """An action of every action space: the robot stays where it is for so many control steps, and
    the limit grows.
    """

    steps: int


class Environment(ABC):
    """The interface of every environment. A subclass names `tasks` and implements `make`.

    Attributes:
        tasks: names, in the order of tables.
        splits: name → episodes of each task.
        suites: name → tasks; `results` makes a figure of each. A task belongs to at most one.
        embodiment: as in a file of `configs/embodiment`: the robot of models that are built with
            `env=NAME`. None where users select one.
    """

    tasks: ClassVar[Sequence[str]]
    splits: ClassVar[Mapping[str, int]] = {"train": 100, "val": 50, "test": 50}
    suites: ClassVar[Mapping[str, Sequence[str]]] = {}
    embodiment: ClassVar[Mapping[str, Any] | None] = None

    @abstractmethod
    def make(self, spec: EpisodeSpec, render: bool = True) -> Any:
        """A `gymnasium.Env` for an episode; the library calls `reset(seed=spec.seed)`."""

    def demonstrate(self, env: Any) -> Iterator[Any]:
        """Actions that solve the episode of `env`, one for each `step` that the caller performs in
        between.

        Raises:
            UserError: the environment has no demonstrator.
        """
        require(
            False,
            f"{type(self).__name__} has no demonstrator: implement demonstrate(env), a generator of"
            " actions.",
        )
        yield from ()

    def hold(self, env: Any) -> Any:
        """The action that keeps the robot where it is, for events in which it pauses.

        Raises:
            UserError: the environment has none.
        """
        require(
            False,
            f"{type(self).__name__} cannot pause: implement hold(env), the action that keeps the"
            " robot.",
        )

    def choices(self, env: Any) -> Mapping[str, Actions]:
        """What can be chosen in `play` now: text → the actions that carry it out.
        Empty: nothing.
        """
        return {}

    def facts(self, env: Any) -> Sequence[Fact]:
        """What the episode of `env` has shown so far that is needed later, from the simulator's
        state: for the score of writing and the table beside a recording. By default nothing.
        """
        return ()

    def scene_values(self, env: Any) -> Mapping[str, Any] | None:
        """What makes the scene of `env`, right after its reset: plain values, the same on every
        machine.

        Records name a scene by their digest, and results compare equal scenes alone. By default
        there are none to give.
        """
        return None

    def episodes(self, task: str, split: str) -> list[EpisodeSpec]:
        """The episodes of a task in a split, in order; by default consecutive seeds, other ones in
        every split.
        """
        self.check_task(task)
        self.check_split(split)
        first = _FIRST_SEED.get(split, _OTHER_SPLITS)
        return [
            EpisodeSpec(task, split, number, first + number, "")
            for number in range(self.splits[split])
        ]

    # What commands call ---------------------------------------------------------------------------

    def check_task(self, task: str) -> None:
        """Make sure that a task exists."""
        check_known("task", task, self.tasks)

    def check_split(self, split: str) -> None:
        """Make sure that a split exists."""
        check_known("split", split, self.splits)

    def check_installed(self) -> None:  # noqa: B027
        """Make sure that packages which the environment needs are installed."""

    def check_hold(self) -> None:
        """Make sure that the robot can hold its pose."""
        if type(self).hold is Environment.hold:
            self.hold(None)

    def check_embodiment(self, robot: Embodiment) -> None:
        """Make sure that a policy with this robot can be evaluated here."""
        if self.embodiment is None:
            return
        local = Embodiment.from_dict(self.embodiment)
        misfits = []
        if set(robot.camera_names) - set(local.camera_names):
            misfits.append("cameras")
        if robot.state.width != local.state.width:
            misfits.append("numbers of the state")
        if robot.action.width != local.action.width:
            misfits.append("numbers of an action")
        require(
            not misfits,
            f"The robot {robot.name!r} of this policy does not fit the environment's"
            f" {local.name!r}, which has the cameras {', '.join(local.camera_names)},"
            f" {local.state.width} numbers of state and {local.action.width} of an action"
            f" ({', '.join(misfits)}). Train with env=<this environment>.",
        )

    def episode(self, task: str, split: str, number: int) -> EpisodeSpec:
        """One episode of a split."""
        known = self.episodes(task, split)
        exists = type(number) is int and 0 <= number < len(known)
        require(
            exists,
            f"Unknown episode {number!r} of {task}, split {split!r}; expected 0 to"
            f" {len(known) - 1}.",
        )
        return known[number]

    def scene_digest(self, spec: EpisodeSpec) -> str:
        """Digest of the scene that an episode has on this machine: builds it. `NO_VALUES` without
        `scene_values`.
        """
        if type(self).scene_values is Environment.scene_values:
            return NO_VALUES
        env = self.open(spec.task, spec.split, spec.episode, render=False)
        try:
            env.reset()
            digest: str = env.scene_digest
        finally:
            env.close()
        return digest

    def step_limit(self, split: str) -> int:
        """Steps after which an episode of a split is a timeout."""
        return DEFAULT_STEPS

    def suite_of(self, task: str) -> str | None:
        """The suite of a task."""
        for suite, tasks in self.suites.items():
            if task in tasks:
                return suite
        return None

    def open(
        self,
        task: str,
        split: str,
        episode: int,
        *,
        action_space: str | None = None,
        max_steps: int | None = None,
        render: bool = True,
    ) -> Any:
        """One episode with the interface of `make_env`: lists of frames, status, goal."""
        spec = self.episode(task, split, episode)
        limit = max_steps or self.step_limit(split)
        return EpisodeEnv(self, self.make(spec, render), spec, limit, action_space == CHOICES)


def environment(name: str) -> Environment:
    """The environment of this name."""
    made: Environment = ENVS[name]()
    return made


def open_episode(
    env: str,
    task: str,
    split: str,
    episode: int,
    *,
    action_space: str | None = None,
    max_steps: int | None = None,
    render: bool = True,
) -> Any:
    """One episode of the environment of this name; importable by worker processes."""
    return environment(env).open(
        task, split, episode, action_space=action_space, max_steps=max_steps, render=render
    )


class EpisodeEnv:
    """One episode of a `gymnasium.Env` with the interface of `RoboMMEEnv`: what rollouts and `play`
    use.

    Args:
        environment: whose choices are offered. env: its gymnasium environment. spec: which episode.
        max_steps: steps until the status becomes `timeout`.
        by_choice: actions are `{"choice": letter}` among `environment.choices`, and all frames of
            one are returned.

    Attributes:
        scene_digest: of the values of the scene, from the reset on.
    """

    def __init__(
        self,
        environment: Environment,
        env: Any,
        spec: EpisodeSpec,
        max_steps: int,
        by_choice: bool = False,
    ) -> None:
        self.environment = environment
        self.env = env
        self.spec = spec
        self.max_steps = max_steps
        self.goal = ""
        self._by_choice = by_choice
        self._steps = 0
        self._limit = max_steps
        self._choices: dict[str, Actions] = {}
        self._frames = 0  # since the reset
        self._names: set[str] = set()  # of what the first of them holds
        self.scene_digest = NOT_BUILT

    def reset(self) -> tuple[dict[str, list[Any]], dict[str, Any]]:
        """The conditioning video, if there is one, and the current frame."""
        observation, info = self.env.reset(seed=self.spec.seed)
        require(
            isinstance(info.get("goal"), str),
            f"{self.spec.task}: reset() must return the goal in info['goal'].",
        )
        self.goal = info["goal"]
        self._frames = 0
        self._steps = 0
        self._limit = self.max_steps
        values = self.environment.scene_values(self.env)
        self.scene_digest = NO_VALUES if values is None else scene_digest(values)
        return self._lists([*info.get("video", ()), observation]), self._info(info, False, False)

    def step(self, action: Any) -> tuple[dict[str, list[Any]], float, bool, bool, dict[str, Any]]:
        """Perform one action, all actions of a choice, or a `Hold`."""
        parts: Actions = [action]
        if isinstance(action, Hold):
            parts = [self.hold_action] * action.steps
            self._limit += action.steps
        elif self._by_choice:
            parts = self._choices[action["choice"].lower()]
        frames = []
        total = 0.0
        for part in parts:
            observation, reward, terminated, truncated, info = self.env.step(part)
            frames.append(observation)
            total += float(reward)
            self._steps += 1
            truncated = bool(truncated) or self._steps >= self._limit
            if terminated or truncated:
                break
        report = self._info(info, bool(terminated), truncated)
        return self._lists(frames), total, bool(terminated), truncated, report

    def render(self) -> Any:
        """What the environment renders."""
        return self.env.render()

    def oracle(self) -> Mapping[str, Any] | None:
        """The choice that a script takes next; None where the environment has no method `oracle()`,
        or this says so.
        """
        if not hasattr(self.env, "oracle"):
            return None
        choice: Mapping[str, Any] | None = self.env.oracle()
        return choice

    def close(self) -> None:
        """Free the environment."""
        self.env.close()

    @property
    def facts(self) -> Sequence[Fact]:
        """What the frames since the reset showed, the video's first."""
        return self.environment.facts(self.env)

    @property
    def hold_action(self) -> Any:
        """The action that keeps the robot where it is."""
        return self.environment.hold(self.env)

    def demonstration(self) -> Iterator[tuple[Mapping[str, Any], Any, bool]]:
        """Observation, action and whether the frame is of the conditioning video, until the
        demonstrator is done.
        """
        observation, info = self.env.reset(seed=self.spec.seed)
        self.goal = str(info["goal"])
        self.success = False
        actions = self.environment.demonstrate(self.env)
        first = next(actions, None)
        require(first is not None, f"{self.spec.task}: the demonstrator gives no action.")
        for visible in info.get("video", ()):
            yield visible, np.zeros_like(first), True
        action: Any = first
        for _ in range(self.max_steps):
            yield observation, action, False
            observation, _, terminated, truncated, info = self.env.step(action)
            self.success = bool(info.get("success", False))
            if terminated or truncated:
                return
            action = next(actions, None)
            if action is None:
                return

    def _lists(self, frames: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
        """The values of frames by their names; every frame of an episode must have all of them, or
        images would be of other frames than states.
        """
        lists: dict[str, list[Any]] = {"state_list": []}
        for frame in frames:
            self._check_frame(frame)
            for name, value in frame.items():
                if name == "state":
                    lists["state_list"].append(np.asarray(value, np.float32))
                else:
                    lists.setdefault(f"{name}_rgb_list", []).append(np.asarray(value))
        if self._by_choice and len(lists) > 1:
            first_camera = next(images for name, images in lists.items() if name != "state_list")
            lists.setdefault("front_rgb_list", first_camera)  # what `play` shows
        return lists

    def _check_frame(self, frame: Mapping[str, Any]) -> None:
        if self._frames == 0:
            require("state" in frame, f"{self.spec.task}: observations have no 'state'.")
            self._names = set(frame)
        place = f"{self.spec.task}: frame {self._frames} of the episode"
        remedy = "Give the same cameras and the state in every observation."
        missing = sorted(self._names - set(frame))
        require(not missing, f"{place} lacks {listed(missing)}, which frame 0 has. {remedy}")
        added = sorted(set(frame) - self._names)
        require(not added, f"{place} has {listed(added)}, which frame 0 lacks. {remedy}")
        self._frames += 1

    def _info(self, info: Mapping[str, Any], terminated: bool, truncated: bool) -> dict[str, Any]:
        report: dict[str, Any] = {
            "task_goal": [self.goal],
            "status": "ongoing",
            "simple_subgoal_online": str(info.get("subgoal", "")),
        }
        if terminated or truncated:
            if info.get("error_message"):
                report["status"] = "error"
                report["error_message"] = str(info["error_message"])
            elif info.get("success", False):
                report["status"] = "success"
            else:
                report["status"] = "fail" if terminated else "timeout"
        elif self._by_choice:
            choices = dict(self.environment.choices(self.env))
            name = type(self.environment).__name__
            require(choices, f"{name} offers no choices to play: implement choices(env).")
            empty = [text for text, actions in choices.items() if not len(actions)]
            require(
                not empty,
                f"{name}.choices(env) has no actions for {empty[:1]}: leave it out, or add one.",
            )
            self._choices = {}
            options = []
            for letter, (text, actions) in zip(_LETTERS, choices.items(), strict=False):
                self._choices[letter] = actions
                options.append(Option(letter, text).to_dict())
            report["available_multi_choices"] = options
        return report
