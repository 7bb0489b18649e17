"""What a training run may be told (`configs/train`), checked before anything starts."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Self

from mme_vla.config.sections import (
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveInt,
    Range,
    read_section,
)
from mme_vla.errors import require
from mme_vla.speed import SELECTIVE, Recompute
from mme_vla.training.parallel import ParallelSettings


@dataclass(frozen=True)
class KeepRule:
    """Which checkpoints stay: the newest `last`, and every one whose step is a multiple of `every`
    (0: none).
    """

    last: PositiveInt = 2
    every: NonNegativeInt = 0


@dataclass(frozen=True)
class TrainSettings:
    """The keys of `configs/train/*.yaml`, where each is explained."""

    steps: PositiveInt
    batch_size: PositiveInt
    lr: Positive
    warmup: NonNegativeInt = 0
    betas: tuple[float, float] = (0.9, 0.95)
    eps: Positive = 1e-8
    weight_decay: NonNegative = 1e-10
    clip_norm: Positive = 1.0
    ema: float = 0.999
    part_lr: Mapping[str, Positive] = field(default_factory=dict)
    optimizer: Literal["adamw", "lamb"] = "adamw"
    warmup_from_zero: bool = False
    schedule: Literal["constant", "cosine", "steps"] = "constant"
    schedule_steps: int | None = None
    schedule_end: Annotated[float, Range(0, 1)] = 0.0
    milestones: tuple[PositiveInt, ...] = ()
    gamma: float = 0.1
    decay_min_dim: NonNegativeInt = 0
    ema_warmup: bool = False
    accumulate: PositiveInt = 1
    gradient_checkpointing: bool = False
    recompute: Literal["all", "selective"] = "all"
    compile: bool = False
    parallel: ParallelSettings = field(default_factory=ParallelSettings)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: NonNegativeInt = 1
    prefetch_gb: Positive = 8.0
    log_every: PositiveInt = 100
    val_every: PositiveInt = 1000
    val_samples: NonNegativeInt = 64
    save_every: PositiveInt = 1000
    keep: KeepRule = field(default_factory=KeepRule)
    open_loop_chunks: NonNegativeInt = 32
    losses: Mapping[str, Any] | None = None
    seed: int = 42

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], seed: int = 42) -> Self:
        """Read the section `train` of a composed configuration."""
        return read_section(cls, values, "train", seed=seed)

    def __post_init__(self) -> None:
        steps, milestones = self.schedule_steps, list(self.milestones)
        checks = {
            "schedule_steps": (
                steps is None or steps >= max(self.warmup, 1),
                f"no fewer than train.warmup={self.warmup}, or null",
            ),
            "milestones": (
                milestones == sorted(milestones),
                "updates in ascending order, such as [1000, 2000]",
            ),
            "gamma": (0 < self.gamma <= 1, "above 0 and at most 1"),
            "ema": (0 <= self.ema < 1, "at least 0 (no averaging) and below 1"),
            "betas": (all(0 <= beta < 1 for beta in self.betas), "two numbers in [0, 1)"),
            "batch_size": (
                not self.batch_size % self.accumulate,
                f"a multiple of train.accumulate={self.accumulate}",
            ),
        }
        for name, weight in (self.losses or {}).items():
            number = (
                isinstance(weight, int | float)
                and not isinstance(weight, bool)
                and 0 <= weight < float("inf")
            )
            require(
                number,
                f"train.losses.{name}={weight!r} must be a number of 0 or more, the weight of this"
                " loss.",
            )
        for name, (fits, expected) in checks.items():
            require(fits, f"train.{name}={getattr(self, name)!r} must be {expected}.")

    @property
    def recomputation(self) -> Recompute:
        """What the backward pass computes again."""
        return self.gradient_checkpointing and (SELECTIVE if self.recompute == SELECTIVE else True)
