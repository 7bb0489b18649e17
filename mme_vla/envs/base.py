"""`Environment`: tasks, their episodes by split, and how one is made. `env=NAME` selects one in
every command.

RoboMME is one entry of the registry (`mme_vla/envs/benchmark.py`). An environment of your own is a
class beside a `gymnasium.Env`, whose observations are a dict: a uint8 image [H, W, 3] for each
camera of the embodiment, and `state`, float32 [s]. An image may be a function that renders it now.
Its info dict may hold `goal` (text, needed on reset), `video` (on reset: earlier observations,
which become the conditioning video), `frozen` (on reset: steps in which no action has an effect),
`success` (bool) and `subgoal` (text).
"""

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import closing
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import count
from string import ascii_lowercase
from typing import Any, ClassVar, Literal

import numpy as np

from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.action_space import Option
from mme_vla.envs.facts import Candidates, Fact
from mme_vla.envs.metadata import DEFAULT_STEPS, EpisodeSpec, numbered
from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT, scene_digest
from mme_vla.errors import UserError, brief, check_known, listed, require
from mme_vla.registry import ENVS

Actions = Iterable[Any]
"""Actions that `step` takes in turn. A generator makes each when the one before is done."""
CHOICES = "multi_choice"
OPTIONS = "available_multi_choices"
_FIRST_SEED = {"train": 0, "test": 500_000, "val": 1_000_000}
_OTHER_SPLITS, _APART = 2_000_000, 1_000_000  # first seed of splits with other names, and between
_END = object()  # of a choice's actions, each of which can be any value
CLOSED = "The environment is closed; make a new one."
_MAX_IDLE = 4  # environments that a process keeps for further episodes


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
        groupings: further ways to group tasks: title → name → tasks, as `suites`; `results` makes
            a table of each.
        steps: steps after which an episode is a timeout; of every task, or task → steps.
        success: `end`: an episode is a success if its last step is one. `once`: the first step that
            is one ends it.
        cue: what becomes of the steps in which no action has an effect (`info["frozen"]`). `steps`:
            the policy acts in them as in others. `video`: the library performs them with `hold`,
            and their frames are the conditioning video.
        reuse: whether an environment that `make` returned serves the next episode of its task in
            the same process: `reset(seed=…)` alone makes the scene.
        embodiment: as in a file of `configs/embodiment`: the robot of models that are built with
            `env=NAME`. None where users select one.
    """

    tasks: ClassVar[Sequence[str]]
    splits: ClassVar[Mapping[str, int]] = {"train": 100, "val": 50, "test": 50}
    suites: ClassVar[Mapping[str, Sequence[str]]] = {}
    groupings: ClassVar[Mapping[str, Mapping[str, Sequence[str]]]] = {}
    steps: ClassVar[int | Mapping[str, int]] = DEFAULT_STEPS
    success: ClassVar[Literal["end", "once"]] = "end"
    cue: ClassVar[Literal["steps", "video"]] = "steps"
    reuse: ClassVar[bool] = False
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
        raise UserError(
            f"{type(self).__name__} has no demonstrator: implement demonstrate(env), a generator of"
            " actions."
        )

    def hold(self, env: Any) -> Any:
        """The action that keeps the robot where it is, for events in which it pauses, and choices
        that are carried out already.

        Raises:
            UserError: the environment has none.
        """
        raise UserError(
            f"{type(self).__name__} cannot pause, as an event or a choice without actions asks for:"
            " implement hold(env), the action that keeps the robot where it is."
        )

    def choices(self, env: Any) -> Mapping[str, Actions]:
        """What a policy by choices, or a player, can choose now: text → the actions that do it."""
        return {}

    def facts(self, env: Any) -> Sequence[Fact]:
        """What the episode of `env` has shown so far that is needed later, from the simulator's
        state: for the score of writing and the table beside a recording. By default nothing.
        """
        return ()

    def twin(self, spec: EpisodeSpec) -> Mapping[str, Any] | None:
        """The scene of `spec` with another value of one fact and everything else equal: what
        `make` finds as `spec.row`. By default there is none.
        """
        return None

    def candidates(self, env: Any) -> Candidates | None:
        """What the next motion of `env` can go to, where a decision depends on a fact; None where
        none does, and by default.
        """
        return None

    def tool(self, env: Any) -> Sequence[float]:
        """Where the robot's tool is [d], in the unit of the `candidates`.

        Raises:
            UserError: the environment does not say.
        """
        raise UserError(
            f"{type(self).__name__} has candidates and no place of the tool: implement tool(env)."
        )

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
        others = [name for name in self.splits if name not in _FIRST_SEED]
        first_seeds = _FIRST_SEED | dict(zip(others, count(_OTHER_SPLITS, _APART), strict=False))
        first = first_seeds[split]
        return [EpisodeSpec(task, split, i, first + i, "") for i in range(self.splits[split])]

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
        if self.embodiment is not None:
            robot.check_place(Embodiment.from_dict(self.embodiment))

    def episode(self, task: str, split: str, number: int) -> EpisodeSpec:
        """One episode of a split."""
        return numbered(self.episodes(task, split), task, split, number)

    def scene_digest(self, spec: EpisodeSpec) -> str:
        """Digest of the scene that an episode has on this machine: builds it. `NO_VALUES` without
        `scene_values`.
        """
        if type(self).scene_values is Environment.scene_values:
            return NO_VALUES
        with closing(self.open(spec.task, spec.split, spec.episode, render=False)) as env:
            env.reset()
            digest: str = env.scene_digest
        return digest

    def step_limit(self, split: str) -> int:
        """Steps after which an episode of a split is a timeout; of tasks that differ the most."""
        if isinstance(self.steps, int):
            return self.steps
        return max(self.steps.values())

    def task_limit(self, task: str, split: str) -> int:
        """Steps after which an episode of a task is a timeout.

        Raises:
            UserError: `steps` lacks the task.
        """
        if isinstance(self.steps, int):
            return self.step_limit(split)
        require(
            task in self.steps,
            f"{type(self).__name__}.steps lacks {task}: add its limit, or give one number for all"
            " tasks.",
        )
        return self.steps[task]

    def suite_of(self, task: str) -> str | None:
        """The suite of a task."""
        return _group_of(task, self.suites)

    def suites_of(self, tasks: Iterable[str]) -> dict[str, str]:
        """Task → suite, of the tasks that belong to one."""
        suites = {}
        for task in tasks:
            suite = self.suite_of(task)
            if suite is not None:
                suites[task] = suite
        return suites

    def groups_of(self, task: str) -> dict[str, str]:
        """The group of a task in each further grouping: title → name."""
        groups = {}
        for title, grouping in self.groupings.items():
            group = _group_of(task, grouping)
            if group is not None:
                groups[title] = group
        return groups

    def open(
        self,
        task: str,
        split: str,
        episode: int,
        *,
        action_space: str | None = None,
        max_steps: int | None = None,
        render: bool = True,
        row: Mapping[str, Any] | None = None,
    ) -> Any:
        """One episode with the interface of `make_env`: lists of frames, status, goal.

        row: builds the scene of these values (`twin`).
        """
        spec = self.episode(task, split, episode)
        if max_steps is None:
            max_steps = self.task_limit(task, split)
        if row is not None:
            spec = replace(spec, row=row)
        env = None
        if spec.row is None:
            env = _idle.pop((type(self), task, render), None)
        if env is None:
            env = self.make(spec, render)
        require(
            hasattr(env, "reset") and not isinstance(env, type),
            f"{type(self).__name__}.make returned {brief(env)}; expected a gymnasium.Env.",
        )
        return EpisodeEnv(self, env, spec, max_steps, action_space == CHOICES, render)


def _group_of(task: str, grouping: Mapping[str, Sequence[str]]) -> str | None:
    return next((name for name, tasks in grouping.items() if task in tasks), None)


_idle: OrderedDict[tuple[type[Environment], str, bool], Any] = OrderedDict()
"""Environments between two episodes, by environment, task and whether they render."""


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
    row: Mapping[str, Any] | None = None,
) -> Any:
    """One episode of the environment of this name; importable by worker processes."""
    return environment(env).open(
        task, split, episode, action_space=action_space, max_steps=max_steps, render=render, row=row
    )


class EpisodeEnv:
    """One episode of a `gymnasium.Env` as rollouts and `play` use it: the `RoboMMEEnv` interface.

    Args:
        environment: whose choices are offered.
        env: its gymnasium environment.
        spec: which episode.
        max_steps: steps until the status becomes `timeout`.
        by_choice: actions are `{"choice": letter}` among `environment.choices`, and all frames of
            one are returned.
        render: as `env` was made.

    Attributes:
        scene_digest: of the values of the scene, from the reset on.
        render_request: the images that are rendered of those that the environment gives as
            functions; None: all. The others are None.
    """

    def __init__(
        self,
        environment: Environment,
        env: Any,
        spec: EpisodeSpec,
        max_steps: int,
        by_choice: bool = False,
        render: bool = True,
    ) -> None:
        require(
            type(max_steps) is int and max_steps >= 1,
            f"max_steps is {max_steps!r}; expected a positive integer.",
        )
        self.environment = environment
        self.env = env
        self.spec = spec
        self.max_steps = max_steps
        self.render_request: RenderRequest | None = None
        self.goal = ""
        self._renders = render
        self._key = (type(environment), spec.task, render)
        self._is_reusable = True  # no call has failed
        self._by_choice = by_choice
        self._steps = 0
        self._limit = max_steps
        self._choices: dict[str, Actions] = {}
        self._frames = 0  # since the reset
        self._names: set[str] = set()  # of what the first of them holds
        self.scene_digest = NOT_BUILT

    def reset(self) -> tuple[dict[str, list[Any]], dict[str, Any]]:
        """The conditioning video, if there is one, and the current frame."""
        observation, info = self._begin()
        values = self.environment.scene_values(self.env)
        self.scene_digest = NO_VALUES if values is None else scene_digest(values)
        frames = list(self._first_frames(observation, info))
        return self._lists(frames), self._info(info, False, False)

    def step(self, action: Any) -> tuple[dict[str, list[Any]], float, bool, bool, dict[str, Any]]:
        """Perform one action, all actions of a choice, or a `Hold`."""
        parts: Actions = [action]
        if isinstance(action, Hold):
            parts = [self.hold_action] * action.steps
            self._limit += action.steps
        elif self._by_choice:
            letter = action.get("choice") if isinstance(action, Mapping) else action
            letter = str(letter).strip().lower()
            check_known("choice", letter, self._choices)
            parts = self._choices[letter]
        remaining = iter(parts)
        part = next(remaining, _END)
        if part is _END:  # what was chosen is done already: a step passes, or none ever would
            part = self.hold_action
        frames = []
        total = 0.0
        while part is not _END:
            observation, reward, terminated, truncated, info = self._perform(part)
            total += float(reward)
            self._steps += 1
            truncated = bool(truncated) or self._steps >= self._limit
            part = _END
            if not (terminated or truncated):
                part = next(remaining, _END)
            frames.append(self._read_frame(observation, newest=part is _END))
        report = self._info(info, bool(terminated), truncated)
        return self._lists(frames), total, bool(terminated), truncated, report

    def render_image(self, image: Callable[[], np.ndarray]) -> np.ndarray:
        """The image [H, W, 3] that a function of the environment renders."""
        return image()

    def oracle(self) -> Mapping[str, Any] | None:
        """The choice that a script takes next; None where the environment has no method `oracle()`,
        or this says so.
        """
        if not hasattr(self.env, "oracle"):
            return None
        choice: Mapping[str, Any] | None = self.env.oracle()
        return choice

    def close(self) -> None:
        """Free the environment, or keep it for the next episode of its task."""
        env = self.env
        self.env = None
        if env is None:
            return
        if not (self.environment.reuse and self._is_reusable) or self.spec.row is not None:
            env.close()
            return
        former = _idle.pop(self._key, None)
        _idle[self._key] = env
        if former is None and len(_idle) > _MAX_IDLE:
            _, former = _idle.popitem(last=False)
        if former is not None:
            former.close()

    @property
    def facts(self) -> Sequence[Fact]:
        """What the frames since the reset showed, the video's first."""
        return self.environment.facts(self.env)

    @property
    def candidates(self) -> Candidates | None:
        """What the next motion can go to."""
        return self.environment.candidates(self.env)

    @property
    def tool(self) -> Sequence[float]:
        """Where the robot's tool is."""
        return self.environment.tool(self.env)

    @property
    def hold_action(self) -> Any:
        """The action that keeps the robot where it is."""
        return self.environment.hold(self.env)

    def demonstration(self) -> Iterator[tuple[Mapping[str, Any], Any, bool]]:
        """Observation, action and whether the frame is of the conditioning video, until the
        demonstrator is done.
        """
        observation, info = self._begin()
        self.success = False
        *video, frame = self._first_frames(observation, info)
        actions = iter(self.environment.demonstrate(self.env))
        action: Any = next(actions, None)
        require(action is not None, f"{self.spec.task}: the demonstrator gives no action.")
        for earlier in video:
            yield earlier, np.zeros_like(action), True
        for _ in range(self.max_steps):
            yield frame, action, False
            observation, _, terminated, truncated, info = self._perform(action)
            frame = self._read_frame(observation)
            self.success = bool(info.get("success", False))
            if terminated or truncated:
                return
            action = next(actions, None)
            if action is None:
                return

    def _begin(self) -> tuple[Mapping[str, Any], dict[str, Any]]:
        """Reset the environment to the scene of the episode."""
        require(self.env is not None, CLOSED)
        self._is_reusable = False
        observation, info = self.env.reset(seed=self.spec.seed)
        self._is_reusable = True
        require(
            isinstance(info.get("goal"), str),
            f"{self.spec.task}: reset() must return the goal in info['goal'].",
        )
        self.goal = info["goal"]
        self._frames = 0
        self._names = set()
        self._steps = 0
        self._limit = self.max_steps
        return observation, info

    def _perform(self, action: Any) -> tuple[Mapping[str, Any], float, bool, bool, dict[str, Any]]:
        """Perform one action; with `success="once"` the first success ends the episode."""
        require(self.env is not None, CLOSED)
        self._is_reusable = False
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._is_reusable = True
        if self.environment.success == "once" and info.get("success", False):
            terminated = True
        return observation, reward, terminated, truncated, info

    def _first_frames(
        self, observation: Mapping[str, Any], info: Mapping[str, Any]
    ) -> Iterator[dict[str, Any]]:
        """The frames of the conditioning video, each read before the next, and the current one."""
        for earlier in info.get("video", ()):
            yield self._read_frame(earlier)
        if self.environment.cue == "video":
            for _ in range(int(info.get("frozen", 0))):
                yield self._read_frame(observation)
                observation, _, terminated, truncated, _ = self._perform(self.hold_action)
                require(
                    not (terminated or truncated),
                    f"{self.spec.task}: the episode ended within the {info['frozen']} steps of"
                    " info['frozen'], before a policy could act.",
                )
        yield self._read_frame(observation, newest=True)

    def _read_frame(self, observation: Mapping[str, Any], newest: bool = False) -> dict[str, Any]:
        """An observation with its images: those that are functions are rendered now, or left
        out where they were not requested.
        """
        require(
            isinstance(observation, Mapping),
            f"{self.spec.task}: an observation is a {type(observation).__name__}; expected a dict"
            " of an image for each camera, and 'state'.",
        )
        frame: dict[str, Any] = {}
        requested = self.render_request
        for name, value in observation.items():
            if not callable(value):
                frame[name] = value
            elif requested is None or name in requested.cameras(self._frames, newest):
                frame[name] = self.render_image(value)
            else:
                frame[name] = None
        frame = deepcopy(frame)  # an environment may write each observation over the one before
        # Every frame has the names of the first, or images would be of other frames than states.
        if self._frames == 0:
            require("state" in frame, f"{self.spec.task}: observations have no 'state'.")
            require(
                len(frame) > 1 or not self._renders,
                f"{self.spec.task}: observations have no image: give one for each camera (uint8"
                " [H, W, 3], or a function that renders it), or open it with render=False.",
            )
            self._names = set(frame)
        require(
            set(frame) == self._names,
            f"{self.spec.task}: frame {self._frames} of the episode has"
            f" {listed(sorted(frame))}, and frame 0 has {listed(sorted(self._names))}. Give the"
            " same cameras and the state in every observation.",
        )
        self._frames += 1
        return frame

    def _lists(self, frames: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
        """The values of frames by their names."""
        lists: dict[str, list[Any]] = {"state_list": []}
        for frame in frames:
            for name, value in frame.items():
                if name == "state":
                    lists["state_list"].append(np.asarray(value, np.float32))
                    continue
                image = None if value is None else np.asarray(value)
                lists.setdefault(f"{name}_rgb_list", []).append(image)
        if self._by_choice and len(lists) > 1:
            first_camera = next(images for name, images in lists.items() if name != "state_list")
            lists.setdefault("front_rgb_list", first_camera)  # what `play` shows
        return lists

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
            require(
                len(choices) <= len(ascii_lowercase),
                f"{name}.choices(env) has {len(choices)} entries, and there are 26 letters.",
            )
            self._choices = {}
            options = []
            for letter, (text, actions) in zip(ascii_lowercase, choices.items(), strict=False):
                require(
                    not isinstance(actions, Sized) or len(actions),
                    f"{name}.choices(env) has no actions for {text!r}: leave it out, or add one.",
                )
                self._choices[letter] = actions
                options.append(Option(letter, text).to_dict())
            report[OPTIONS] = options
        return report
