"""The settings of a rollout, checked before anything is loaded."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from mme_vla.config.sections import NonNegativeInt, Positive, PositiveInt, read_section
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import choose_episodes, named_tasks
from mme_vla.evaluation.rollout.events import Event, read_events
from mme_vla.policy.run_folders import check_on_machine, find_run


@dataclass(frozen=True)
class RolloutSettings:
    """The protocol, and how it is run. The defaults are the paper's.

    seed: of the policy's noise; it does not reach the environments.
    max_steps: actions until the outcome is `timeout`; None: as many as the task allows
        (`limit_of`).
    max_actions: actions, whatever frames they take, until the outcome is `timeout`; None: the
        policy's own limit.
    only_possible: by choices, offer no option whose every object is out of reach.
    execute: actions of a chunk that are executed before the policy acts again; None: the
        embodiment's number.
    env: name of the environment in the registry.
    workers: environments at a time; None: one a core, at most 16.
    max_batch: most episodes that act together; 1 makes results independent of timing to the last
        bit.
    encode_chunk: frames of a video encoded at a time, before other episodes may act.
    retries: how often an episode is tried again after an error, once all others have begun.
    timeout_s: seconds after which an environment that does not respond is replaced.
    draw: `needed`: images that the policy and its subgoals read; `all`: of every frame. Outcomes
        are the same.
    subgoal_log: whether every predicted subgoal is logged with its image.
    event: what happens in every episode, such as `pause:100@subtask:2`; None for nothing.
    """

    seed: NonNegativeInt = 42
    split: str = "test"
    env: str = "mme_vla"
    max_steps: PositiveInt | None = None
    max_actions: PositiveInt | None = None
    only_possible: bool = False
    execute: PositiveInt | None = None
    flow_steps: PositiveInt | None = None
    workers: PositiveInt | None = None
    max_batch: PositiveInt = 16
    encode_chunk: PositiveInt = 32
    retries: NonNegativeInt = 1
    timeout_s: Positive = 600.0
    render: bool = True
    draw: Literal["needed", "all"] = "needed"
    video: Literal["none", "all", "success", "failure"] = "none"
    subgoal_log: bool = True
    event: str | None = None

    def __post_init__(self) -> None:
        source = environment(self.env)
        source.check_split(self.split)
        if self.hold_steps:
            source.check_hold()

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read the keys of a configuration that are settings; others are ignored."""
        return read_section(cls, config, others=True)

    @property
    def events(self) -> tuple[Event, ...]:
        """What `event` names."""
        return read_events(self.event)

    @property
    def hold_steps(self) -> int:
        """Control steps for which the events of an episode hold the robot."""
        return sum(event.perturbation.hold for event in self.events)

    @property
    def step_limit(self) -> int:
        """Actions until the outcome is `timeout`, of the task that takes the most."""
        if self.max_steps is not None:
            return self.max_steps
        return environment(self.env).step_limit(self.split)

    def limit_of(self, task: str) -> int:
        """Actions until the outcome of a task is `timeout`: its own number unless another was
        set.
        """
        if self.max_steps is not None:
            return self.max_steps
        return environment(self.env).task_limit(task, self.split)


def check_config(config: Mapping[str, Any]) -> None:
    """Check rollouts, tasks, episodes and checkpoint of a command's configuration, without PyTorch.

    Args:
        config: plain and resolved, of a command that has the keys of configs/evaluate.yaml.
    """
    # Each event is a run of its own, which the command checks.
    settings = RolloutSettings.from_config({**config, "event": None})
    choose_episodes(named_tasks(config), config["episodes"], settings.split, settings.env)
    checkpoint = config["checkpoint"]
    if checkpoint is not None:
        check_on_machine(find_run(Path(str(checkpoint)).expanduser()))
