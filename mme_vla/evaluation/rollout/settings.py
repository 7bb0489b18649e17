"""The settings of a rollout, checked before anything is loaded."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from mme_vla.config.sections import read_section
from mme_vla.envs.make import ENVS
from mme_vla.envs.metadata import check_split, step_limit
from mme_vla.errors import UserError, did_you_mean
from mme_vla.evaluation.rollout.video import SAVE_ON

RENDER_MODES = ("needed", "all")


@dataclass(frozen=True)
class RolloutSettings:
    """The protocol, and how it is run. The defaults are the paper's.

    seed: of the policy's noise; it does not reach the environments.
    max_steps: actions until the outcome is `timeout`; 0: as many as the split allows.
    execute: actions of a chunk that are executed before the policy acts again; None: the embodiment's number.
    workers: environments at a time; None: one a core, at most 16.
    max_batch: most episodes that act together; 1 makes results independent of timing to the last bit.
    encode_chunk: frames encoded before other episodes may act.
    retries: how often an episode whose environment failed is tried again before the run continues without it.
    timeout_s: seconds after which an environment that does not respond is replaced.
    draw: `needed`: images that the policy and its subgoals read; `all`: of every frame. Outcomes are the same.
    subgoal_log: whether every predicted subgoal is logged with its image.
    """

    seed: int = 42
    split: str = "test"
    env: str = "mme_vla"
    max_steps: int = 0
    execute: int | None = None
    flow_steps: int | None = None
    workers: int | None = None
    max_batch: int = 16
    encode_chunk: int = 32
    retries: int = 1
    timeout_s: float = 600.0
    render: bool = True
    draw: str = "needed"
    video: str = "none"
    subgoal_log: bool = True

    def __post_init__(self) -> None:
        for name, value, known in (
            ("env", self.env, ENVS), ("video", self.video, SAVE_ON),
            ("draw", self.draw, RENDER_MODES),
        ):  # fmt: skip
            if value not in known:
                raise UserError(f"{name}={value!r}. {did_you_mean(str(value), known)}")
        if check_split(self.split) is not None and self.env == "official":
            raise UserError(f"split={self.split} varies this library's scenes: leave out env=official.")
        if self.max_steps == 0:
            object.__setattr__(self, "max_steps", step_limit(self.split))
        least = {"max_steps": 1, "max_batch": 1, "encode_chunk": 1, "retries": 0}
        for name, smallest in least.items():
            self._check_integer(name, getattr(self, name), smallest)
        self._check_integer("seed", self.seed, 0)
        for name in ("workers", "execute", "flow_steps"):
            if getattr(self, name) is not None:
                self._check_integer(name, getattr(self, name), 1)
        if not self.timeout_s > 0:
            raise UserError(f"timeout_s={self.timeout_s!r} must be a positive number of seconds.")
        if self.env == "official" and not self.render:
            raise UserError("env=official always renders: leave out render=false.")

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read the keys of a configuration that are settings; others are ignored."""
        unset = config.get("max_steps", 0) is None
        return read_section(cls, {**config, "max_steps": 0} if unset else config, others=True)

    def worker_count(self, episodes: int) -> int:
        """How many workers run that many episodes."""
        requested = min(len(os.sched_getaffinity(0)), 16) if self.workers is None else self.workers
        return max(1, min(requested, episodes))

    @staticmethod
    def _check_integer(name: str, value: Any, least: int) -> None:
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise UserError(f"{name}={value!r} must be a whole number, at least {least}.")
