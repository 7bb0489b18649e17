"""What a training run may be told (`configs/train`), checked before anything starts."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from mme_vla.config.sections import read_section
from mme_vla.errors import UserError
from mme_vla.speed.recompute import ALL, SELECTIVE, Recompute
from mme_vla.training.parallel import ParallelSettings

SCHEDULES = ("constant", "cosine", "steps")
OPTIMIZERS = ("adamw", "lamb")


@dataclass(frozen=True)
class KeepRule:
    """Which checkpoints stay: the newest `last`, and every one whose step is a multiple of `every` (0: none)."""

    last: int = 2
    every: int = 0

    def __post_init__(self) -> None:
        if self.last < 1 or self.every < 0:
            raise UserError(f"train.keep: last={self.last} must be at least 1 and every={self.every} not negative.")


@dataclass(frozen=True)
class TrainSettings:
    """The keys of `configs/train/*.yaml`, where each is explained."""

    steps: int
    batch_size: int
    lr: float
    warmup: int = 0
    betas: tuple[float, float] = (0.9, 0.95)
    eps: float = 1e-8
    weight_decay: float = 1e-10
    clip_norm: float = 1.0
    ema: float = 0.999
    part_lr: Mapping[str, float] = field(default_factory=dict)
    optimizer: str = "adamw"
    warmup_from_zero: bool = False
    schedule: str = "constant"
    schedule_steps: int | None = None
    schedule_end: float = 0.0
    milestones: tuple[int, ...] = ()
    gamma: float = 0.1
    decay_min_dim: int = 0
    ema_warmup: bool = False
    accumulate: int = 1
    gradient_checkpointing: bool = False
    recompute: str = ALL
    compile: bool = False
    parallel: ParallelSettings = field(default_factory=ParallelSettings)
    device: str = "auto"
    workers: int = 1
    prefetch_gb: float = 8.0
    log_every: int = 100
    val_every: int = 1000
    val_samples: int = 64
    save_every: int = 1000
    keep: KeepRule = field(default_factory=KeepRule)
    open_loop_chunks: int = 32
    seed: int = 42

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], seed: int = 42) -> Self:
        """Read the section `train` of a composed configuration."""
        return read_section(cls, values, "train", seed=seed)

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "accumulate", "log_every", "val_every", "save_every"):
            _check(name, getattr(self, name), getattr(self, name) >= 1, "at least 1")
        _check("optimizer", self.optimizer, self.optimizer in OPTIMIZERS, " or ".join(OPTIMIZERS))
        _check("schedule_end", self.schedule_end, 0 <= self.schedule_end <= 1, "from 0 to 1")
        _check("schedule", self.schedule, self.schedule in SCHEDULES, " or ".join(SCHEDULES))
        if self.schedule_steps is not None:
            fits = self.schedule_steps >= max(self.warmup, 1)
            _check("schedule_steps", self.schedule_steps, fits, f"no fewer than train.warmup={self.warmup}, or null")
        valid = all(isinstance(step, int) and step >= 1 for step in self.milestones)
        _check("milestones", list(self.milestones), valid and list(self.milestones) == sorted(self.milestones),
               "updates in ascending order, such as [1000, 2000]")  # fmt: skip
        _check("gamma", self.gamma, 0 < self.gamma <= 1, "above 0 and at most 1")
        for name in ("warmup", "decay_min_dim", "workers", "val_samples", "open_loop_chunks", "weight_decay"):
            _check(name, getattr(self, name), getattr(self, name) >= 0, "not negative")
        for name in ("lr", "eps", "clip_norm", "prefetch_gb"):
            _check(name, getattr(self, name), getattr(self, name) > 0, "positive")
        factors = all(isinstance(x, int | float) and x > 0 for x in self.part_lr.values())
        _check("part_lr", dict(self.part_lr), factors, "positive factors of train.lr by component, such as {vlm: 0.1}")
        _check("ema", self.ema, 0 <= self.ema < 1, "at least 0 (no averaging) and below 1")
        betas = len(self.betas) == 2 and all(0 <= b < 1 for b in self.betas)
        _check("betas", self.betas, betas, "two numbers in [0, 1)")
        _check("recompute", self.recompute, self.recompute in (ALL, SELECTIVE), f"{ALL} or {SELECTIVE}")
        _check("device", self.device, self.device in ("auto", "cpu", "cuda"),
               "auto (a GPU where there is one), cuda or cpu; which GPU is said by CUDA_VISIBLE_DEVICES")  # fmt: skip
        _check(
            "batch_size",
            self.batch_size,
            self.batch_size % self.accumulate == 0,
            f"a multiple of train.accumulate={self.accumulate}",
        )

    @property
    def recomputation(self) -> Recompute:
        """What the backward pass computes again."""
        return self.gradient_checkpointing and (SELECTIVE if self.recompute == SELECTIVE else True)


def _check(name: str, value: Any, fits: bool, expected: str) -> None:
    if not fits:
        raise UserError(f"train.{name}={value!r} must be {expected}.")
