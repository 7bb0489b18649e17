"""`MemoryModule`: choose stored tokens, then encode them into at most `budget` memory tokens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import check_choice, require
from mme_vla.memory.history import FrameScorer, History, LazyHistory, OnlineHistory, StorageSpec
from mme_vla.types import HistoryTokens, Labels, MemoryTokens

POSITION_GRID = 16
"""Rows and columns of token positions are in sixteenths of a view's side, as released, whatever its
token grid.
"""


@dataclass(frozen=True)
class PastViewSpec:
    """Past views that a memory gives the backbone along with the current ones, of every camera.

    frames: how many, the current one included. stride: frames between two of them. every: see
    `PastViews`.
    """

    frames: int
    stride: int
    every: int

    def at(self, step: int) -> np.ndarray:
        """The past frames seen at a step, oldest first; negative ones lie before the episode. int64
        [frames − 1].
        """
        return step - self.stride * np.arange(self.frames - 1, 0, -1)

    @property
    def span(self) -> int:
        """How many frames before the current one the oldest lies."""
        return (self.frames - 1) * self.stride


class MemoryModule(nn.Module):
    """The interface of every neural memory: choose stored tokens, then encode them.

    A subclass implements `select` and `forward`, and sets:
        budget: most memory tokens it returns; 0 for a memory of past views alone.
        capacity: most stored tokens it may select (`budget` unless the encoder reads more than it
            writes); selections are padded to it unless `padded_length` says otherwise.
        storage: what is stored of each frame.
        lazy: encode a frame of an episode when it is first read, for memories that read few of
            their stored frames.
        pad_left: padding comes before the tokens (recurrent memories) instead of after them.
        timed: each memory token belongs to one frame, whose age is in `MemoryTokens.ages`; required
            by `integration.memory_position=time`.
        reporting: set from outside for updates that are logged; `forward` then fills
            `MemoryTokens.metrics`.

    Optional capabilities are classes to inherit from as well: `StreamingMemory`, `ScoringMemory`,
    `ProprioMemory`, `PastViewMemory`, `CompilableMemory`, `MatmulPrecision`, and `ReadsLabels`
    (types.py) of a memory whose `MemoryTokens.losses` need labels.
    """

    budget: int
    capacity: int
    storage: StorageSpec
    pad_left: bool = False
    timed: bool = False
    lazy: bool = False
    reporting: bool = False

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Takes no arguments: a subclass calls `super().__init__()` and then sets the attributes
        above.
        """
        if args or kwargs:
            raise TypeError(
                f"{type(self).__name__}: MemoryModule.__init__() takes no arguments, got"
                f" {len(args) + len(kwargs)}. Call super().__init__(), then set self.budget,"
                " self.capacity and self.storage. Only PerceptualMemory takes (d_vision, width,"
                " budget, storage)."
            )
        super().__init__()

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """Choose the stored tokens for step `step`.

        Cheap, on the CPU, and the same code offline and online. It must not depend on anything
        later than `step`.

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

        All other frames need not be rendered or encoded. By default all that are stored or scored;
        a memory with past views returns the frames of these, which then show every camera.

        Args:
            steps: current frames, video included. exec_start: as in `History`.

        Returns:
            int64 [n], ascending, each once.
        """
        length = int(max(steps, default=-1)) + 1
        return union_frames([self.storage.stored_frames(length), frames_scored(self, length)])

    def condition_on_prompt(
        self, history: HistoryTokens, condition: Callable[[Tensor], Tensor]
    ) -> HistoryTokens:
        """A selection as the backbone reads it with a prompt: `condition` [b, n, d_vision] of its
        vision tokens.
        """
        return (
            history
            if uses_proprio(self)
            else replace(history, features=condition(history.features))
        )

    def padded_length(self, count: int) -> int:
        """The length to which a selection of `count` tokens is padded; only left-padded memories
        may change it.
        """
        return self.capacity

    def gather_selection(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> HistoryTokens:
        """Select, gather and pad: the unbatched tokens of one step ([padded_length, …]), ready to
        be stacked.
        """
        indices = self.select(history, step, rng)
        if len(indices) > self.capacity:
            raise ValueError(
                f"{type(self).__name__}.select returned {len(indices)} tokens; at most"
                f" {self.capacity}."
            )
        features = history.gather(indices)
        positions = torch.from_numpy(token_positions(history.timed(indices), self.storage.grid)).to(
            features.device
        )
        missing = self.padded_length(len(indices)) - len(indices)
        before, after = (missing, 0) if self.pad_left else (0, missing)
        mask = torch.ones(len(indices), dtype=torch.bool, device=features.device)
        return HistoryTokens(
            features=nn.functional.pad(features, (0, 0, before, after)),
            positions=nn.functional.pad(positions, (0, 0, before, after)),
            mask=nn.functional.pad(mask, (before, after)),
            step=torch.tensor(int(history.times(np.array(step))), device=features.device),
        )


Memory = MemoryModule
"""The former name."""

CacheEntry = tuple[int, Tensor]
"""The frame of a chunk's observation, and keys and values [layers, 2, n, K, h] of tokens of its
prefix.
"""

NEVER = 1_000_000
"""Frames between two whose tokens are stored, of memories that read none."""


class CacheMemory(MemoryModule):
    """A memory of keys and values that the backbone made of earlier prefixes
    (`MemoryTokens.cache`).

    A subclass implements `write`. It has no tokens and reads no stored frames unless it overrides
    the other methods.
    """

    def __init__(self) -> None:
        super().__init__()
        self.budget = self.capacity = 0
        self.storage = StorageSpec(1, "mean", NEVER)

    def write(self, entries: Sequence[CacheEntry], new: CacheEntry) -> Sequence[CacheEntry]:
        """What is stored after a chunk. It must change nothing in place: a chunk that fails is
        sampled again.

        Args:
            entries: what was stored before, oldest first. new: the frame of the chunk's
                observation, and the keys and values of its prefix.
        """
        raise NotImplementedError

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return np.zeros(0, np.int64)

    def gather_selection(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> HistoryTokens:
        return HistoryTokens(
            torch.zeros(0, 1),
            torch.zeros(0, 3),
            torch.zeros(0, dtype=torch.bool),
            torch.tensor(step),
        )

    def condition_on_prompt(
        self, history: HistoryTokens, condition: Callable[[Tensor], Tensor]
    ) -> HistoryTokens:
        return history

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        return MemoryTokens(history.features, history.mask)


class StreamingMemory:
    """Capability of a memory: it carries a state through an episode, so that a step costs its new
    frames alone.
    """

    def start_stream(self) -> Any:
        """A new state for one episode."""
        raise NotImplementedError

    def encode(self, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
        """Memory tokens [n, budget, d] of n running episodes at their latest frames, equal to
        `forward`'s.

        Args:
            histories: one per episode. streams: their states, updated in place.
        """
        raise NotImplementedError

    def prepare(self, history: History, stream: Any) -> bool:
        """Do a part of the work of the next `encode` while the robot moves. It must not change any
        token.

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
    """Capability of a memory: it reads proprioception and motion (`History.motion`), with stored
    tokens or without.
    """

    uses_proprio: bool = True


class PastViewMemory:
    """Capability of a memory: it gives the backbone past views along with the current ones
    (`Batch.past`).
    """

    past_view_spec: PastViewSpec | None = None


class CompilableMemory:
    """Capability of a memory: it has many small operations to compile in place."""

    def compile(self, **options: Any) -> None:
        """Compile them. `options` are `torch.compile`'s."""
        raise NotImplementedError


class MatmulPrecision:
    """Capability of a module that computes in float32: how a GPU multiplies there, `ieee` or
    `tf32`.
    """

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
    """An empty history for one episode; `encode` maps frames [n, H, W, 3] uint8 to
    stored tokens.
    """
    scorer = make_scorer(memory)
    return (
        LazyHistory(memory.storage, encode, scorer)
        if memory.lazy
        else OnlineHistory(memory.storage, scorer)
    )


def encode_histories(
    memory: MemoryModule, histories: Sequence[History], streams: Sequence[Any]
) -> MemoryTokens:
    """Memory tokens [n, budget, d] of n running episodes at their latest frames.

    Args:
        histories: one per episode. streams: their states of `start_stream`, updated in place.
    """
    if isinstance(memory, StreamingMemory):
        return memory.encode(histories, streams)
    tokens: MemoryTokens = memory(
        stack_history([memory.gather_selection(h, len(h) - 1) for h in histories])
    )
    return tokens


def full_history(
    memory: MemoryModule, d_vision: int, device: torch.device | str = "cpu"
) -> HistoryTokens:
    """A selection [1, n, d_vision] of zeros at its greatest length."""
    n = memory.padded_length(memory.capacity)
    return HistoryTokens(
        torch.zeros(1, n, d_vision, device=device),
        torch.zeros(1, n, 3, device=device),
        torch.ones(1, n, dtype=torch.bool, device=device),
        torch.zeros(1, dtype=torch.int64, device=device),
    )


def union_frames(lists: Sequence[np.ndarray]) -> np.ndarray:
    """All frames of some lists, ascending, each once; int64 [n]."""
    return np.unique(np.concatenate(lists)) if lists else np.zeros(0, np.int64)


def all_patches(frames: np.ndarray, grid: int) -> np.ndarray:
    """All patches of some frames as (frame, patch) [n·grid², 2], frame by frame."""
    return np.stack(np.meshgrid(frames, np.arange(grid**2), indexing="ij"), axis=-1).reshape(-1, 2)


def token_positions(indices: np.ndarray, grid: int) -> np.ndarray:
    """(frame, patch) [n, 2] → (frame, row, column) [n, 3] float32, rows and columns at patch
    centres in sixteenths.

    An 8×8 patch y sits at 2y + 1, a 4×4 patch at 4y + 2.
    """
    frame, patch = indices[:, 0], indices[:, 1]
    cell = POSITION_GRID / grid
    return np.stack(
        [frame, (patch // grid + 0.5) * cell, (patch % grid + 0.5) * cell], axis=1
    ).astype(np.float32)


def stack_history(
    items: Sequence[HistoryTokens], device: torch.device | None = None
) -> HistoryTokens:
    """Stack unbatched selections into one batch [b, n, …]; shorter ones, of left-padded memories,
    are padded there.
    """
    length = max(len(item.mask) for item in items)

    def stack(rows: Sequence[Tensor]) -> Tensor:
        around = [0, 0] * (rows[0].ndim - 1)
        return torch.stack(
            [nn.functional.pad(row, (*around, length - len(row), 0)) for row in rows]
        ).to(device)

    steps = [item.step for item in items if item.step is not None]
    step = torch.stack(steps).to(device) if len(steps) == len(items) else None
    labels = Labels(
        {name: stack([item.labels[name] for item in items]) for name in items[0].labels}
    )
    features, positions, mask = (
        stack([getattr(item, name) for item in items]) for name in ("features", "positions", "mask")
    )
    return HistoryTokens(features, positions, mask, step, labels)


TEMPORAL_BASE, SPATIAL_BASE = 10_000.0, 1_000.0


def position_features(positions: Tensor, dim: int) -> Tensor:
    """M-RoPE features of (frame, row, column): sin and cos of each axis, side by side.

    [sin tω | cos tω | sin yω′ | cos yω′ | sin xω′ | cos xω′] with
    ω_i = 10000^(−i/(w−1)), ω′_i = 1000^(−i/(w−1)), w = dim/6.

    Args:
        positions: [..., 3] as `HistoryTokens.positions`. dim: a multiple of 6, at least 12.

    Returns:
        [..., dim] float32, computed where the positions are.
    """
    w = dim // 6
    require(
        dim % 6 == 0 and w >= 2,
        f"position_dim={dim} must be a multiple of 6 (three axes, sin and cos) from 12 on.",
    )
    ramp = torch.arange(w, device=positions.device, dtype=torch.float32) / (w - 1)
    # 3 w
    frequencies = torch.stack([TEMPORAL_BASE**-ramp, SPATIAL_BASE**-ramp, SPATIAL_BASE**-ramp])
    angles = positions.float()[..., None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(-2)


POSITIONS = ("time_space", "space", "none")
"""What a memory's tokens say of their frame, row and column: all three, row and
column, or nothing.
"""


class FeatureEncoder(nn.Module):
    """token = W₂ [feature | SiLU(W₁ position)]: nothing before, between or after, as released.

    Positions are `position_dim` wide: by default 3/8 of the vision width in multiples of 6, 768 at
    full size. Padding (zero feature, zero position) becomes the constant W₂ [0 | SiLU(b₁)]: only
    the mask tells it apart. With `positions="space"` the features of the frame, the first third,
    are zero. With `"none"` there is no W₁, and token = W₂ feature, which is the released encoder
    with `use_pos_emb: false`.
    """

    def __init__(
        self,
        d_vision: int,
        width: int,
        position_dim: int | None = None,
        position_hidden: int | None = None,
        positions: str | None = None,
    ):
        super().__init__()
        self.positions = POSITIONS[0] if positions is None else positions
        check_choice("memory.positions", self.positions, POSITIONS)
        for name, size in (("position_dim", position_dim), ("position_hidden", position_hidden)):
            require(
                size is None or size >= 1,
                f"memory.{name}={size}: must be at least 1, or null for its default.",
            )
        self.position_dim = max(48, 6 * (d_vision // 16)) if position_dim is None else position_dim
        hidden = self.position_dim if position_hidden is None else position_hidden
        none = self.positions == "none"
        self.position = None if none else nn.Linear(self.position_dim, hidden)
        self.project = nn.Linear(d_vision + hidden * (not none), width)
        for layer in (self.position, self.project):
            if layer is not None:
                nn.init.normal_(layer.weight, std=0.02)
                nn.init.zeros_(layer.bias)

    def places(self, positions: Tensor) -> Tensor:
        """Position features [b, n, position_dim] of positions [b, n, 3], float32."""
        places = position_features(positions, self.position_dim)
        if self.positions == "space":
            places = torch.cat([torch.zeros_like(places[..., : self.position_dim // 3]),
                                places[..., self.position_dim // 3 :]], -1)  # fmt: skip
        return places

    def encode(self, features: Tensor, places: Tensor) -> Tensor:
        """Encode features [b, n, d_vision] with ready-made position features [b, n,
        position_dim].
        """
        if self.position is None:
            return self.project(features.to(self.project.weight.dtype))
        place = nn.functional.silu(self.position(places.to(self.position.weight.dtype)))
        return self.project(torch.cat([features.to(place.dtype), place], dim=-1))

    def forward(self, features: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Encode features at positions [b, n, 3]; padding gets zero position features, not those of
        (0, 0, 0).
        """
        return self.encode(features, self.places(positions) * mask[..., None])


class PerceptualMemory(MemoryModule):
    """Selected tokens, right-padded to the budget and encoded one by one; subclasses choose."""

    timed = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int,
        storage: StorageSpec,
        position_dim: int | None = None,
        position_hidden: int | None = None,
        positions: str | None = None,
    ) -> None:
        """Build the encoder.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            budget: most memory tokens. storage: what is kept of each frame.
            position_dim, position_hidden: widths of the position features and their layer; None
                follows `d_vision`.
            positions: of `POSITIONS`; None: `time_space`.
        """
        super().__init__()
        self.budget = self.capacity = budget
        self.storage = storage
        self.encoder = FeatureEncoder(d_vision, width, position_dim, position_hidden, positions)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        tokens = self.encoder(history.features, history.positions, history.mask)
        return MemoryTokens(tokens, history.mask, ages=history.ages)
