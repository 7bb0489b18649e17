"""Messages between a rollout and its environments, one of each for a chunk of actions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.scene_hash import NOT_BUILT


@dataclass(frozen=True)
class Command:
    """What an environment executes next: actions, or a time for which the robot stays where it is.

    actions: [n, w], executed one after the other; None with `hold`. hold: control steps for which
    the robot stays where it is. subgoal: text in the video meanwhile. draw: the images that are
    requested, by default all. Frames are counted from the reset on, and the newest is the last.
    """

    actions: np.ndarray | None = None
    hold: int = 0
    subgoal: str | None = None
    draw: RenderRequest | None = None


@dataclass(frozen=True)
class Report:
    """What an environment says of a reset or of a command, beside its frames.

    status: `ongoing`, `success`, `fail`, `timeout` or `error`; None of an environment that gives
    none. goal: the instruction; None if the environment named none yet. error: why the episode
    failed, where the environment says so. info: what the environment itself reports, for subgoal
    predictors. options: of a robot that chooses, what there is to choose. scene: digest of the
    scene.
    executed: actions. steps: frames. held: the action [w] that keeps the robot where it is after a
    command to hold it; None before the first action. subtask: number of the execution's current
    sub-task from 1; 0 where the environment tells none. began: frames at which sub-tasks began.
    process: where the chain of sub-tasks broke, for the record. oracle: the action [w] that the
    task's script takes next, if it was asked for. video: name of the finished video's file.
    simulated_s, rendered_s: seconds since the last report.
    """

    status: str | None = None
    goal: str | None = None
    error: str | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    options: Sequence[Mapping[str, Any]] | None = None
    scene: str = NOT_BUILT
    executed: int = 0
    steps: int = 0
    held: np.ndarray | None = None
    subtask: int = 0
    began: Sequence[int] = ()
    process: dict[str, Any] | None = None
    oracle: np.ndarray | None = None
    video: str | None = None
    simulated_s: float = 0.0
    rendered_s: float = 0.0
