"""`MemoryModule`: choose stored tokens, then encode them into at most `budget` memory tokens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import UserError
from mme_vla.memory.history import FrameScorer, History, LazyHistory, OnlineHistory, StorageSpec
from mme_vla.types import HistoryTokens, MemoryTokens

POSITION_GRID = 16
"""Rows and columns of token positions are in sixteenths of a view's side, as released, whatever its token grid."""


@dataclass(frozen=True)
class PastViewSpec:
    """Past views that a memory gives the backbone along with the current ones, of every camera.

    frames: how many, the current one among them. stride: frames between two of them.
    every: see `PastViews`.
    """

    frames: int
    stride: int
    every: int

    def at(self, step: int) -> np.ndarray:
        """The past frames seen at a step, oldest first; negative ones lie before the episode. int64 [frames − 1]."""
        return step - self.stride * np.arange(self.frames - 1, 0, -1)

    @property
    def span(self) -> int:
        """How many frames before the current one the oldest lies."""
        return (self.frames - 1) * self.stride


class MemoryModule(nn.Module):
    """The interface of every neural memory: choose stored tokens, then encode them.

    A subclass implements `select` and `forward`, and sets:
        budget: most memory tokens it returns; 0 for a memory of past views alone.
        capacity: most stored tokens it may select (`budget` unless the encoder reads more than it writes); selections
            are padded to it unless `padded_length` says otherwise.
        storage: what is stored of each frame.
        lazy: encode a frame of an episode when it is first read, for memories that read few of their stored frames.
        pad_left: padding comes before the tokens (recurrent memories) instead of after them.
        timed: each memory token belongs to one frame, whose age is in `MemoryTokens.ages`; required by
            `integration.memory_position=time`.
        reporting: set from outside for updates that are logged; `forward` then fills `MemoryTokens.metrics`.

    Optional capabilities are classes to inherit from as well: `StreamingMemory`, `ScoringMemory`, `ProprioMemory`,
    `PastViewMemory`, `CompilableMemory`, `MatmulPrecision`.
    """

    budget: int
    capacity: int
    storage: StorageSpec
    pad_left: bool = False
    timed: bool = False
    lazy: bool = False
    reporting: bool = False

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Takes no arguments: a subclass calls `super().__init__()` and then sets the attributes above."""
        if args or kwargs:
            raise TypeError(
                f"{type(self).__name__}: MemoryModule.__init__() takes no arguments, got {len(args) + len(kwargs)}. "
                "Call super().__init__(), then set self.budget, self.capacity and self.storage. Only PerceptualMemory "
                "takes (d_vision, width, budget, storage)."
            )
        super().__init__()

    def select(self, history: History, step: int, rng: np.random.Generator | None = None) -> np.ndarray:
        """Choose the stored tokens for step `step`.

        Cheap, on the CPU, and the same code offline and online. It must not depend on anything later than `step`.

        Args:
            history: the episode so far (offline: possibly longer than `step`).
            step: index of the current frame, video included.
            rng: randomness for training-time jitter; None for a reproducible choice.

        Returns:
            int64 [n, 2] of (frame, patch) in time order, n ≤ `capacity`.
        """
        raise NotImplementedError

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        """Encode the selection [b, n, d_vision] into memory tokens [b, budget, d].

        n is `capacity`, unless `padded_length` returns less.
        """
        raise NotImplementedError

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        """Frames that `select`, the scorer or the backbone may read at these steps.

        All other frames need not be rendered or encoded. By default all that are stored or scored; a memory with past
        views returns the frames of these, which then show every camera.

        Args:
            steps: current frames, video included. exec_start: as in `History`.

        Returns:
            int64 [n], ascending, each once.
        """
        length = int(max(steps, default=-1)) + 1
        return union_frames([self.storage.stored_frames(length), frames_scored(self, length)])

    def condition_on_prompt(self, history: HistoryTokens, condition: Callable[[Tensor], Tensor]) -> HistoryTokens:
        """A selection as the backbone reads it with a prompt: `condition` [b, n, d_vision] of its vision tokens."""
        return history if uses_proprio(self) else replace(history, features=condition(history.features))

    def padded_length(self, count: int) -> int:
        """The length to which a selection of `count` tokens is padded; only left-padded memories may change it."""
        return self.capacity

    def gather_selection(self, history: History, step: int, rng: np.random.Generator | None = None) -> HistoryTokens:
        """Select, gather and pad: the unbatched tokens of one step ([padded_length, …]), ready to be stacked."""
        indices = self.select(history, step, rng)
        if len(indices) > self.capacity:
            raise ValueError(f"{type(self).__name__}.select returned {len(indices)} tokens; at most {self.capacity}.")
        features = history.gather(indices)
        positions = torch.from_numpy(token_positions(indices, self.storage.grid)).to(features.device)
        missing = self.padded_length(len(indices)) - len(indices)
        before, after = (missing, 0) if self.pad_left else (0, missing)
        mask = torch.ones(len(indices), dtype=torch.bool, device=features.device)
        return HistoryTokens(
            features=nn.functional.pad(features, (0, 0, before, after)),
            positions=nn.functional.pad(positions, (0, 0, before, after)),
            mask=nn.functional.pad(mask, (before, after)),
            step=torch.tensor(step, device=features.device),
        )


Memory = MemoryModule
"""The former name."""


class StreamingMemory:
    """Capability of a memory: it carries a state through an episode, so that a step costs its new frames alone."""

    def start_stream(self) -> Any:
        """A new state for one episode."""
        raise NotImplementedError

    def encode(self, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
        """Memory tokens [n, budget, d] of n running episodes at their latest frames, equal to `forward`'s.

        Args:
            histories: one per episode. streams: their states, updated in place.
        """
        raise NotImplementedError

    def prepare(self, history: History, stream: Any) -> bool:
        """Do a part of the work of the next `encode` while the robot moves. It must not change any token.

        Args:
            history, stream: as in `encode`, after it.

        Returns:
            Whether work is left.
        """
        return False


class ScoringMemory:
    """Capability of a memory: it chooses by scores of raw frames."""

    def make_scorer(self) -> FrameScorer | None:
        """A new scorer for one episode; None for none."""
        raise NotImplementedError

    def frames_scored(self, length: int) -> np.ndarray:
        """Which of the first `length` frames the scorer needs: by default all."""
        return np.arange(length)


class ProprioMemory:
    """Capability of a memory: it reads proprioception and motion (`History.motion`) instead of stored tokens."""

    uses_proprio: bool = True


class PastViewMemory:
    """Capability of a memory: it gives the backbone past views along with the current ones (`Batch.past`)."""

    past_view_spec: PastViewSpec | None = None


class CompilableMemory:
    """Capability of a memory: it has many small operations to compile in place."""

    def compile(self, **options: Any) -> None:
        """Compile them. `options` are `torch.compile`'s."""
        raise NotImplementedError


class MatmulPrecision:
    """Capability of a module that computes in float32: how a GPU multiplies there, `ieee` or `tf32`."""

    float32_products: str = "ieee"


def make_scorer(memory: MemoryModule) -> FrameScorer | None:
    """A new scorer for one episode; None if the memory needs no scores."""
    return memory.make_scorer() if isinstance(memory, ScoringMemory) else None


def frames_scored(memory: MemoryModule, length: int) -> np.ndarray:
    """Which of the first `length` frames the memory's scorer needs; int64, ascending."""
    return memory.frames_scored(length) if isinstance(memory, ScoringMemory) else np.arange(0)


def uses_proprio(memory: MemoryModule | None) -> bool:
    """Whether the memory reads proprioception and motion."""
    return isinstance(memory, ProprioMemory) and memory.uses_proprio


def past_view_spec(memory: MemoryModule | None) -> PastViewSpec | None:
    """The past views that the memory gives the backbone; None for none."""
    return memory.past_view_spec if isinstance(memory, PastViewMemory) else None


def start_stream(memory: MemoryModule | None) -> Any:
    """A new streaming state for one episode; None if the memory has none."""
    return memory.start_stream() if isinstance(memory, StreamingMemory) else None


def start_history(memory: MemoryModule, encode: Callable[[np.ndarray], Tensor]) -> OnlineHistory:
    """An empty history for one episode; `encode` maps frames [n, H, W, 3] uint8 to stored tokens."""
    scorer = make_scorer(memory)
    return LazyHistory(memory.storage, encode, scorer) if memory.lazy else OnlineHistory(memory.storage, scorer)


def encode_histories(memory: MemoryModule, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
    """Memory tokens [n, budget, d] of n running episodes at their latest frames.

    Args:
        histories: one per episode. streams: their states of `start_stream`, updated in place.
    """
    if isinstance(memory, StreamingMemory):
        return memory.encode(histories, streams)
    tokens: MemoryTokens = memory(stack_history([memory.gather_selection(h, len(h) - 1) for h in histories]))
    return tokens


def full_history(memory: MemoryModule, d_vision: int, device: torch.device | str = "cpu") -> HistoryTokens:
    """A selection [1, n, d_vision] of zeros at its greatest length."""
    n = memory.padded_length(memory.capacity)
    return HistoryTokens(
        torch.zeros(1, n, d_vision, device=device),
        torch.zeros(1, n, 3, device=device),
        torch.ones(1, n, dtype=torch.bool, device=device),
        torch.zeros(1, dtype=torch.int64, device=device),
    )


def check_grid(memory: MemoryModule, views: int) -> None:
    """Raise an error unless views of views×views tokens can be pooled to the grid that the memory stores."""
    if views % memory.storage.grid:
        sides = ", ".join(str(side) for side in range(1, views + 1) if views % side == 0)
        raise UserError(
            f"memory.grid={memory.storage.grid}: the backbone's {views}×{views} tokens a view pool to {sides} a side."
        )


def union_frames(lists: Sequence[np.ndarray]) -> np.ndarray:
    """All frames of some lists, ascending, each once; int64 [n]."""
    return np.unique(np.concatenate(lists)) if lists else np.zeros(0, np.int64)


def all_patches(frames: np.ndarray, grid: int) -> np.ndarray:
    """All patches of some frames as (frame, patch) [n·grid², 2], frame by frame."""
    return np.stack(np.meshgrid(frames, np.arange(grid**2), indexing="ij"), axis=-1).reshape(-1, 2)


def token_positions(indices: np.ndarray, grid: int) -> np.ndarray:
    """(frame, patch) [n, 2] → (frame, row, column) [n, 3] float32, rows and columns at patch centres in sixteenths.

    An 8×8 patch y sits at 2y + 1, a 4×4 patch at 4y + 2.
    """
    frame, patch = indices[:, 0], indices[:, 1]
    cell = POSITION_GRID / grid
    return np.stack([frame, (patch // grid + 0.5) * cell, (patch % grid + 0.5) * cell], axis=1).astype(np.float32)


def stack_history(items: Sequence[HistoryTokens], device: torch.device | None = None) -> HistoryTokens:
    """Stack unbatched selections into one batch [b, n, …]; shorter ones, of left-padded memories, are padded there."""
    length = max(len(item.mask) for item in items)

    def stack(name: str) -> Tensor:
        rows = [getattr(item, name) for item in items]
        around = [0, 0] * (rows[0].ndim - 1)
        return torch.stack([nn.functional.pad(row, (*around, length - len(row), 0)) for row in rows]).to(device)

    steps = [item.step for item in items if item.step is not None]
    step = torch.stack(steps).to(device) if len(steps) == len(items) else None
    return HistoryTokens(stack("features"), stack("positions"), stack("mask"), step)


def recurrent_frames(
    step: int, exec_start: int, max_steps: int = 64, max_video: int = 40, stride: int = 16
) -> np.ndarray:
    """Frames read at `step`, ascending and ending with `step`; at most `max_steps`, the earliest dropped first.

    Execution frames stand `stride` apart, counted back from `step`, so the offset comes from `step` alone. Video
    frames stand half a stride apart in a video of up to two strides, a stride apart while that gives no more than
    `max_video`, and are spread evenly, both ends included, beyond that.

    Args:
        step: the current frame. exec_start: the first execution frame (0 without video). While the video still runs,
            all frames before the current one count as video, so a finished episode and a running one agree.

    Returns:
        int64 [n].
    """
    start = min(exec_start, step)
    execution = np.arange(start + (step - start) % stride, step + 1, stride)
    return np.concatenate([video_frames(start, max_video, stride), execution])[-max_steps:]


def video_frames(length: int, max_video: int, stride: int) -> np.ndarray:
    """Frames read of a conditioning video of `length` frames."""
    if length <= 2 * stride:
        return np.arange(0, length, max(stride // 2, 1))
    if length <= max_video * stride:
        return np.arange(0, length, stride)
    return np.linspace(0, length - 1, max_video).astype(np.int64)


def jittered(frames: np.ndarray, exec_start: int, jitter: int, rng: np.random.Generator) -> np.ndarray:
    """Move every frame but the last by up to `jitter` frames, video and execution each within its own part."""
    past, step = frames[:-1], frames[-1]
    shifted = past + rng.integers(-jitter, jitter + 1, len(past))
    video = past < exec_start
    low, high = np.where(video, 0, exec_start), np.where(video, min(exec_start, step) - 1, step - 1)
    return np.append(np.unique(np.clip(shifted, low, high)), step)
