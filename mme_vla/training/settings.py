"""What a training run may be told (`configs/train.yaml` and its groups), checked before anything
starts, and before PyTorch is imported.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from mme_vla.config.sections import (
    NonNegative,
    NonNegativeInt,
    PathText,
    Positive,
    PositiveInt,
    Range,
    read_section,
)
from mme_vla.errors import require
from mme_vla.memory.sizes import check_budget

if TYPE_CHECKING:
    import torch
    from torch.distributed.device_mesh import DeviceMesh

    from mme_vla.speed import Recompute


@dataclass(frozen=True)
class ParallelSettings:
    """The keys of `train.parallel`, where each is explained."""

    strategy: Literal["auto", "ddp", "fsdp"] = "auto"
    replicate: PositiveInt | None = None

    def shards(self, device: "torch.device") -> bool:
        """Whether this run shards its weights: where that is asked for, and of itself on several
        GPUs.
        """
        from torch import distributed

        started = distributed.is_available() and distributed.is_initialized()
        require(
            self.strategy != "fsdp" or started,
            "train.parallel.strategy=fsdp shares the weights among processes, and this one was"
            " started alone: start it with torchrun --nproc-per-node <GPUs> -m mme_vla.train …, or"
            " leave the strategy at auto.",
        )
        if self.strategy == "auto":
            return started and distributed.get_world_size() > 1 and device.type == "cuda"
        return self.strategy == "fsdp"

    def mesh(self, device_type: str) -> "DeviceMesh":
        """The processes: weights are shared along the last axis; with copies (HSDP) the first axis
        counts those.
        """
        from torch import distributed
        from torch.distributed.device_mesh import init_device_mesh

        world = distributed.get_world_size()
        nodes = max(world // int(os.environ.get("LOCAL_WORLD_SIZE", world)), 1)
        copies = nodes if self.replicate is None else self.replicate
        require(
            world % copies == 0,
            f"train.parallel.replicate={copies} must divide the number of processes, {world}.",
        )
        if copies == 1:
            return init_device_mesh(device_type, (world,), mesh_dim_names=("shard",))
        return init_device_mesh(
            device_type, (copies, world // copies), mesh_dim_names=("replicate", "shard")
        )


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
    part_lr: Mapping[str, Positive] | None = None
    optimizer: Literal["adamw", "lamb"] = "adamw"
    warmup_from_zero: bool = False
    schedule: Literal["constant", "cosine", "steps"] = "constant"
    schedule_steps: int | None = None
    schedule_end: Annotated[float, Range(0, 1)] = 0.0
    milestones: tuple[PositiveInt, ...] = ()
    gamma: Annotated[float, Range(above=0, most=1)] = 0.1
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
    self_check: bool = True
    losses: Mapping[str, NonNegative] | None = None
    seed: int = 42

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], seed: int = 42) -> Self:
        """Read the section `train` of a composed configuration."""
        return read_section(cls, values, "train", seed=seed)

    def __post_init__(self) -> None:
        """Check what several keys mean together, and numbers that must stay below a bound."""
        require(
            all(0 <= beta < 1 for beta in self.betas),
            f"train.betas={self.betas} must be two numbers in [0, 1).",
        )
        require(
            0 <= self.ema < 1,
            f"train.ema={self.ema!r} must be at least 0 (no averaging) and below 1.",
        )
        require(
            self.schedule_steps is None or self.schedule_steps >= max(self.warmup, 1),
            f"train.schedule_steps={self.schedule_steps} must be no fewer than"
            f" train.warmup={self.warmup}, or null.",
        )
        require(
            list(self.milestones) == sorted(self.milestones),
            f"train.milestones={self.milestones} must be updates in ascending order, such as"
            " [1000, 2000].",
        )
        require(
            (self.schedule == "steps") == bool(self.milestones),
            f"train.schedule={self.schedule} and train.milestones={list(self.milestones)} do not go"
            " together: milestones belong to schedule=steps, which needs at least one.",
        )
        require(
            self.batch_size % self.accumulate == 0,
            f"train.batch_size={self.batch_size} must be a multiple of"
            f" train.accumulate={self.accumulate}.",
        )

    @property
    def recomputation(self) -> "Recompute":
        """What the backward pass computes again."""
        from mme_vla.speed import SELECTIVE

        if not self.gradient_checkpointing:
            return False
        return SELECTIVE if self.recompute == SELECTIVE else True


@dataclass(frozen=True)
class CacheSettings:
    """Where vision caches are and how they are built: `data.cache`."""

    root: PathText | None = None
    local: bool = False
    batch_size: PositiveInt = 32
    max_build_frames: NonNegativeInt = 5000


@dataclass(frozen=True)
class DataSettings:
    """The keys of `configs/data/*.yaml`, where each is explained."""

    sources: Any
    name: str = "data"
    val_fraction: float = 0.0
    val_episodes: tuple[int | str, ...] | None = None
    action_offset: int = 0
    mask_padding: bool = False
    jitter: bool = False
    history_transforms: Any = None
    weights: PathText | None = None
    narrow_ranges: Literal["refuse", "widen", "warn"] | None = None
    cache: CacheSettings = field(default_factory=CacheSettings)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Read the section `data` of a composed configuration."""
        return read_section(cls, values, "data")


@dataclass(frozen=True)
class FinetuneSettings:
    """The keys of `configs/finetune/*.yaml`: the options of `apply_finetuning`."""

    mode: Literal["full", "expert_only", "lora"] = "full"
    freeze_vision: bool = True
    frozen_dtype: str | None = None
    rank: PositiveInt = 16
    alpha: float = 16.0
    dropout: float = 0.0
    init: str = "uniform"
    targets: tuple[str, ...] | None = None
    train: tuple[str, ...] | None = None


@dataclass(frozen=True)
class TrainRun:
    """A training as a command line describes it: `configs/train.yaml`, read once.

    config: all of it as plain values. The sections of the model are read where its parts are built.
        Checkpoints keep it whole.
    """

    name: PathText
    seed: Annotated[int, Range(0, 2**63 - 1)]
    output: PathText
    trainings: PositiveInt
    resume: PathText | None
    init_from: PathText | None
    train: TrainSettings
    data: DataSettings
    finetune: FinetuneSettings
    config: Mapping[str, Any]
    memory: Any = None
    logger: Mapping[str, Any] | None = None

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration.

        Args:
            config: plain and resolved.
        """
        settings = TrainSettings.from_dict(config["train"], config["seed"])
        run = read_section(cls, config, others=True, train=settings, config={})
        check_budget(run.memory)
        return replace(run, config=config)
