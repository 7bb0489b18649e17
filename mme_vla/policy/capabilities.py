"""Capabilities that some policies have beside `Policy`; check for them with `isinstance`.

A policy has a capability as soon as it defines the members: no base class is needed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.types import Noise

if TYPE_CHECKING:
    from mme_vla.memory.base import MemoryModule
    from mme_vla.policy.episode import Episode


@runtime_checkable
class HasVisionMemory(Protocol):
    """Stores vision tokens of past frames for its memory."""

    history_dtype: torch.dtype
    """Of stored vision tokens."""

    def require_memory(self) -> "MemoryModule":
        """Return the memory, or raise a `UserError`."""
        ...

    def encode_frames(self, frames: np.ndarray) -> Tensor:
        """Encode memory-view frames [n, H, W, 3] uint8 into stored tokens [n, grid², d_vision]."""
        ...

    def vision_fingerprint(self) -> str:
        """Hash what the tokens of `encode_frames`, and a cache of them, depend on."""
        ...


def with_vision_memory(policy: object) -> HasVisionMemory:
    """The policy, if it stores vision tokens."""
    if not isinstance(policy, HasVisionMemory):
        raise UserError(
            f"{type(policy).__name__} stores no vision tokens of past frames: it lacks"
            " encode_frames()."
        )
    return policy


@runtime_checkable
class SelectsFrames(Protocol):
    """Knows which past frames it reads, so that a simulation renders no others."""

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """Frames of the memory camera, beside the current ones, that acting at these steps reads.

        Args:
            steps: [n] current frames, video included. exec_start: the first execution frame.

        Returns:
            int64 [n], ascending and unique; None if any frame of any camera may be read.
        """
        ...


def frames_read(policy: object, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
    """`SelectsFrames.frames_read`, or None for a policy without it."""
    return policy.frames_read(steps, exec_start) if isinstance(policy, SelectsFrames) else None


@runtime_checkable
class PreparesChunks(Protocol):
    """Can compute parts of an episode's next chunk while the robot moves; no action
    changes by it.
    """

    def prepare(self, episode: "Episode") -> bool:
        """Do one part; return whether more remain. A recurrent memory reads its next list of frames
        so.
        """
        ...


@runtime_checkable
class AugmentsImages(Protocol):
    """Augments the images of training samples."""

    def augmentation_params(self, count: int, generator: torch.Generator) -> Noise:
        """Random numbers [count, …] on the CPU for the images of `count` samples, beside
        `training_noise`'s.
        """
        ...


@runtime_checkable
class WeighsLosses(Protocol):
    """Learns from auxiliary losses, labels and weighted samples (`Batch.weight`,
    `Batch.labels`).
    """

    loss_weights: Mapping[str, float]
    """Weights of auxiliary losses by name; training sets it from `train.losses`."""


@runtime_checkable
class CompilesSampling(Protocol):
    """Has a sampler that can be compiled."""

    @property
    def compiles_sampling(self) -> bool:
        """Whether `sampling=auto` compiles it."""
        ...

    def compile_sampling(self, layers: bool = False) -> None:
        """Compile the sampler of a policy whose weights are final; see
        `MMEPolicy.compile_sampling`.
        """
        ...


@runtime_checkable
class ComparesSizes(Protocol):
    """Compares the sizes of its processor with those of its network."""

    def processor_sizes(self) -> Mapping[str, tuple[object, object]]:
        """Size → its value in the processor and in the network; a checkpoint in which they differ
        is damaged.
        """
        ...


@runtime_checkable
class SamplesInSteps(Protocol):
    """Samples iteratively."""

    sample_steps: int
    """Default steps of its sampler."""


@runtime_checkable
class SupportsRTC(Protocol):
    """Can sample chunks that continue an action prefix (real-time chunking)."""

    supports_rtc: bool


@runtime_checkable
class LimitsActions(Protocol):
    """Ends its rollouts after a number of actions, beside their limit of frames."""

    @property
    def max_actions(self) -> int | None: ...


@runtime_checkable
class TrainsOnKeyframes(Protocol):
    """Trains on sequences of keyframes."""

    keyframes: int
    """Keyframes of a training sample."""


@runtime_checkable
class ShowsDistractors(Protocol):
    """Is shown unrelated episodes before each of its own, as a stress split requires."""

    n_distractor_episodes: int


@runtime_checkable
class CountsCost(Protocol):
    """Can be run without content, to count FLOPs and memory."""

    def full_batch(self, device: torch.device | str = "cpu") -> Any:
        """A batch of one at its fullest: every view, the longest prompt, a full memory, actions to
        learn from.
        """
        ...

    def warm_up_vision(self) -> None:
        """Run the vision tower on one black memory frame."""
        ...


@dataclass(frozen=True)
class MemoryEntries:
    """One store of a writable memory.

    entries: (time, content) in the order they are read. now: the current time, in the unit of these
    times.
    """

    name: str
    entries: tuple[tuple[int, Tensor], ...]
    now: int


@runtime_checkable
class WritableMemory(Protocol):
    """An episode whose memory entries can be read and replaced, as probes do."""

    @property
    def memory_clock(self) -> str | None:
        """Unit of the entries' times (`frames`); None if entries only have an order."""
        ...

    def writable_memory(self) -> tuple[MemoryEntries, ...]:
        """All stores."""
        ...

    def with_entries(self, stores: Sequence[Sequence[tuple[int, Tensor]]]) -> Self:
        """Copy this episode with other entries in its stores, for one chunk."""
        ...

    def resume_from(self, twin: "Episode") -> None:
        """Continue after a chunk that was sampled for a copy by `with_entries`, with this episode's
        own entries.
        """
        ...
