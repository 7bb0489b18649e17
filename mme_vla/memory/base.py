"""`Memory`: choose stored tokens, then encode them into at most `budget` memory tokens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import UserError
from mme_vla.memory.history import FrameScorer, History, LazyHistory, OnlineHistory, StorageSpec
from mme_vla.types import HistoryTokens, MemoryTokens

LINES = 16
"""Rows and columns of token positions count in so many parts of a view's side, as released, whatever its token grid."""


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
    def reach(self) -> int:
        """How many frames before the current one the oldest lies."""
        return (self.frames - 1) * self.stride


class Memory(nn.Module):
    """The interface of every neural memory.

    A subclass sets, before use:
        budget: most memory tokens it may hand over; 0 for a memory that speaks through past views alone.
        capacity: most stored tokens it may select (`budget` unless the encoder reads more than it writes); selections
            are padded to it unless `padded_length` says otherwise.
        storage: what has to be stored of each frame.
        lazy: True encodes a frame of an episode when it is first read, for memories that read few of those they keep.
        pad_left: True puts the padding before the tokens (recurrent memories), False after them.
        timed: whether each memory token speaks of one moment, which `MemoryTokens.ages` tells: what
            `integration.memory_position=time` reads.
        reads_motion: whether it reads what the robot felt and did (`History.moved`) instead of stored tokens.
        looks_back: past views that it gives the backbone along with the current ones; None gives none.

    `reporting` is set from outside: True asks `forward` for numbers about its inside, as `MemoryTokens.metrics`. The
    training loop sets it for the updates it logs; where it is False, what only these numbers need is not computed.

    `float32_products`, set from outside too, says how a GPU multiplies what a memory computes in float32: `ieee` or
    `tf32`.

    and implements `select` and `forward`.
    """

    budget: int
    capacity: int
    storage: StorageSpec
    pad_left: bool = False
    timed: bool = False
    reads_motion: bool = False
    past_view_spec: PastViewSpec | None = None
    lazy: bool = False
    reporting: bool = False
    float32_products: str = "ieee"

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Takes no arguments: a subclass calls `super().__init__()` and then sets the attributes above.

        Raises:
            TypeError: there are arguments.
        """
        if args or kwargs:
            raise TypeError(
                f"{type(self).__name__}: Memory.__init__() takes no arguments, got {len(args) + len(kwargs)}. Call "
                "super().__init__(), then set self.budget, self.capacity and self.storage. Only PerceptualMemory takes "
                "(d_vision, width, budget, storage)."
            )
        super().__init__()

    def check_grid(self, views: int) -> None:
        """Make sure that views of views×views tokens can be pooled to what this memory stores.

        Raises:
            UserError: they cannot.
        """
        if views % self.storage.grid:
            sides = ", ".join(str(side) for side in range(1, views + 1) if views % side == 0)
            raise UserError(
                f"memory.grid={self.storage.grid}: the backbone's {views}×{views} tokens a view pool to {sides} a side."
            )

    def select(self, history: History, step: int, rng: np.random.Generator | None = None) -> np.ndarray:
        """Say which stored tokens step `step` remembers.

        Cheap, on the CPU, and the same code offline and online. Nothing later than `step` may decide.

        Args:
            history: the episode so far (offline: possibly longer than `step`).
            step: index of the current frame, video included.
            rng: randomness for training-time jitter; None where the choice must be reproducible.

        Returns:
            int64 [n, 2] of (frame, patch) in time order, n ≤ `capacity`.
        """
        raise NotImplementedError

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        """Say which frames `select` may choose from, or the scorer or the backbone look at, at these steps.

        What is not among them need not be drawn in a simulation, nor encoded. By default all that is stored or scored;
        a memory that looks back names the frames it looks at, which then show every camera.

        Args:
            steps: current frames, video included. exec_start: as in `History`.

        Returns:
            int64 [n], ascending, each once.
        """
        length = int(max(steps, default=-1)) + 1
        return union_frames([self.storage.stored_frames(length), self.frames_scored(length)])

    def frames_scored(self, length: int) -> np.ndarray:
        """Say which of the first `length` frames the scorer has to be shown: by default all, where there is one."""
        return np.arange(0 if self.make_scorer() is None else length)

    def condition_on_prompt(self, history: HistoryTokens, mark: Callable[[Tensor], Tensor]) -> HistoryTokens:
        """A selection as the backbone reads it beside a prompt: `mark` [b, n, d_vision] on what are vision tokens."""
        return history if self.reads_motion else replace(history, features=mark(history.features))

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        """Encode the selection [b, n, d_vision] into memory tokens [b, budget, d].

        n is `capacity`, unless `padded_length` asks for less.
        """
        raise NotImplementedError

    def compile(self, **options: Any) -> None:
        """Compile in place what many small steps make slow; by default nothing is. `options` are `torch.compile`'s."""

    def set_matmul_precision(self, how: str) -> None:
        """Set `float32_products`, of members too."""
        for module in self.modules():
            if isinstance(module, Memory):
                module.float32_products = how

    def make_scorer(self) -> FrameScorer | None:
        """Return a fresh scorer for one episode, or None when frames need no scores."""
        return None

    def padded_length(self, count: int) -> int:
        """The length to which a selection of `count` tokens is padded; only left-padded memories may choose it."""
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

    def full_history(self, d_vision: int, device: torch.device | str = "cpu") -> HistoryTokens:
        """A selection [1, n, d_vision] without content that is as long as one can be."""
        n = self.padded_length(self.capacity)
        return HistoryTokens(
            torch.zeros(1, n, d_vision, device=device),
            torch.zeros(1, n, 3, device=device),
            torch.ones(1, n, dtype=torch.bool, device=device),
            torch.zeros(1, dtype=torch.int64, device=device),
        )

    def start_history(self, encode: Callable[[np.ndarray], Tensor]) -> OnlineHistory:
        """An episode's history, empty; `encode` takes frames [n, H, W, 3] uint8 to stored tokens."""
        if self.lazy:
            return LazyHistory(self.storage, encode, self.make_scorer())
        return OnlineHistory(self.storage, self.make_scorer())

    def start_stream(self) -> Any:
        """Return what this memory carries through one episode besides its history; None for nothing."""
        return None

    def encode(self, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
        """Memory tokens [n, budget, d] of n running episodes at their latest frames.

        Args:
            histories: one per episode. streams: what `start_stream` gave each of them; updated in place.
        """
        return self(stack_history([self.gather_selection(history, len(history) - 1) for history in histories]))

    def prepare(self, history: History, stream: Any) -> bool:
        """Do a piece of what the next `encode` of a running episode will need, while nobody waits for it.

        What comes of it may never be needed, and must change no token. By default there is nothing to prepare.

        Args:
            history, stream: as in `encode`, after it.

        Returns:
            Whether a piece is left.
        """
        return False


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
    cell = LINES / grid
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
