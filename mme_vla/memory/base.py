"""`MemoryModule`: choose stored tokens, then encode them into at most `budget` memory tokens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import UserError, brief, check_choice, check_sizes, require
from mme_vla.memory.history import FrameScorer, History, StorageSpec
from mme_vla.types import HistoryTokens, Labels, MemoryTokens, send

POSITION_GRID = 16
"""Rows and columns of token positions are in sixteenths of a view's side, as released, whatever its
token grid.
"""


@dataclass(frozen=True)
class PastViewSpec:
    """Past views that a memory gives the backbone along with the current ones, of every camera.

    frames: how many, the current one included.
    stride: frames between two of them.
    every: see `PastViews`.
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
        capacity: most stored tokens it selects (`budget` unless the encoder reads more than it
            writes).
        storage: what is stored of each frame.

    Attributes with a default:
        pad_left: 0 pads a selection after its tokens, up to `capacity`. k pads it before them, up
            to a multiple of k tokens (recurrent memories).
        timed: each memory token belongs to one frame, whose age is in `MemoryTokens.ages`; required
            by `integration.memory_position=time`.
        lazy: encode a frame of an episode when it is first read, for memories that read few of
            their stored frames.
        uses_proprio: it reads states and actions (`History.motion_rows`) instead of, or beside,
            stored tokens.
        past_view_spec: past views that it gives the backbone beside the current ones
            (`Batch.past`); None for none.
        reporting: set from outside for updates that are logged; `forward` then fills
            `MemoryTokens.metrics`.

    A memory that chooses by scores of raw frames overrides `make_scorer`. One that carries a state
    through an episode overrides `start_stream`, `encode` and `prepare`. One whose
    `MemoryTokens.losses` need labels also inherits `ReadsLabels` (types.py).
    """

    budget: int
    capacity: int
    storage: StorageSpec
    pad_left: int = 0
    timed: bool = False
    lazy: bool = False
    uses_proprio: bool = False
    past_view_spec: PastViewSpec | None = None
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
        later than `step` (as TokenDrop does with `causal=False`, the released offline rule).

        Args:
            history: the episode so far (offline: possibly longer than `step`).
            step: index of the current frame, video included.
            rng: randomness for training-time jitter; None for a reproducible choice.

        Returns:
            int64 [n, 2] of (frame, patch) in time order, n ≤ `capacity`.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no select(self, history, step, rng=None): define it."
        )

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        """Encode the selection [b, n, d_vision] into memory tokens [b, budget, d].

        n is `capacity`, or less in a memory with `pad_left`.
        """
        raise NotImplementedError

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        """Frames that `select`, the scorer or the backbone may read at these steps.

        All other frames need not be rendered or encoded. By default all that are stored or scored;
        a memory with past views returns the frames of these, which then show every camera.

        Args:
            steps: current frames, video included.
            exec_start: as in `History`.

        Returns:
            int64 [n], ascending, each once.
        """
        length = int(max(steps, default=-1)) + 1
        stored = self.storage.stored_frames(length)
        scorer = self.make_scorer()
        if scorer is None:
            return stored
        return union_frames([stored, scorer.frames_scored(length)])

    def make_scorer(self) -> FrameScorer | None:
        """A new scorer of raw frames for one episode; None if it needs no scores."""
        return None

    def condition_on_prompt(
        self, history: HistoryTokens, with_prompt: Callable[[Tensor], Tensor]
    ) -> HistoryTokens:
        """A selection as the backbone reads it with a prompt: its vision tokens [b, n, d_vision]
        through `with_prompt` (`MMEModel.prompt_condition`).
        """
        if self.uses_proprio:  # its features are states and actions
            return history
        return replace(history, features=with_prompt(history.features))

    def gather_selection(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> HistoryTokens:
        """Select, gather and pad: the unbatched tokens of one step [n, …], ready to be stacked."""
        stored = history.spec
        if (stored.grid, stored.pooling) != (self.storage.grid, self.storage.pooling):
            raise UserError(
                f"{type(self).__name__} reads frames stored as {self.storage}, and the history has"
                f" {stored}: construct it with memory.storage."
            )
        if not 0 <= step < len(history):
            raise UserError(
                f"step={step} must be 0 or more and less than {len(history)}, the number of frames"
                " that the history has seen."
            )
        indices = np.asarray(self.select(history, step, rng))
        features = history.gather(indices)
        if len(indices) > self.capacity:
            raise UserError(
                f"{type(self).__name__}.select returned {len(indices)} tokens; at most"
                f" {self.capacity}, its capacity."
            )
        if (indices[:, 0] > step).any():
            raise UserError(
                f"{type(self).__name__}.select returned frame {indices[:, 0].max()} at step {step};"
                " expected none later than the step, which no episode has seen then."
            )
        device = features.device
        positions = torch.from_numpy(token_positions(history.timed(indices), self.storage.grid))
        # Made on the device: nothing waits for a copy.
        mask = torch.ones(len(indices), dtype=torch.bool, device=device)
        time = torch.full((), int(history.times(np.array(step))), device=device)
        selection = HistoryTokens(features, send(positions, device), mask, step=time)
        return pad_selection(selection, padded_length(self, len(indices)), bool(self.pad_left))

    def start_stream(self) -> Any:
        """A new state for one episode; None if it carries none."""
        return None

    def encode(self, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
        """Memory tokens [n, budget, d] of n running episodes at their latest frames, equal to
        `forward`'s.

        Args:
            histories: one per episode.
            streams: their states of `start_stream`, updated in place.
        """
        selections = [self.gather_selection(history, len(history) - 1) for history in histories]
        return encode_selection(self, stack_history(selections))

    def prepare(self, history: History, stream: Any) -> bool:
        """Do a part of the work of the next `encode` while the robot moves. It must not change any
        token, but for rounding.

        Args:
            history, stream: as in `encode`, after it.

        Returns:
            Whether work is left.
        """
        return False


Memory = MemoryModule
"""The public name, `mme_vla.Memory`."""


def take_options[T](kind: type[T], options: dict[str, Any]) -> T:
    """Build a dataclass of options from the keywords that are its fields. These are removed from
    `options`.

    A class that does so lists the dataclass in `option_types`, so that the registry can name its
    fields in messages.
    """
    values = {}
    for field in fields(kind):  # type: ignore[arg-type]
        if field.name in options:
            values[field.name] = options.pop(field.name)
    return kind(**values)


NEVER = 1_000_000
"""Frames between two whose tokens are stored, of memories that read none."""


def padded_length(memory: MemoryModule, count: int) -> int:
    """The length to which a selection of `count` tokens is padded."""
    if not memory.pad_left:
        return memory.capacity
    multiples = -(-count // memory.pad_left)
    return min(multiples * memory.pad_left, memory.capacity)


def pad_selection(selection: HistoryTokens, length: int, left: bool) -> HistoryTokens:
    """Pad an unbatched selection with zeros to `length` tokens, before them or after them."""
    missing = length - len(selection.mask)
    ends = (missing, 0) if left else (0, missing)
    return HistoryTokens(
        features=nn.functional.pad(selection.features, (0, 0, *ends)),
        positions=nn.functional.pad(selection.positions, (0, 0, *ends)),
        mask=nn.functional.pad(selection.mask, ends),
        step=selection.step,
    )


def full_history(
    memory: MemoryModule, d_vision: int, device: torch.device | str = "cpu"
) -> HistoryTokens:
    """A selection [1, capacity, d_vision] of zeros."""
    n = memory.capacity
    return HistoryTokens(
        torch.zeros(1, n, d_vision, device=device),
        torch.zeros(1, n, 3, device=device),
        torch.ones(1, n, dtype=torch.bool, device=device),
        torch.zeros(1, dtype=torch.int64, device=device),
    )


def union_frames(lists: Sequence[np.ndarray]) -> np.ndarray:
    """All frames of some lists, ascending, each once; int64 [n]."""
    if not lists:
        return np.zeros(0, np.int64)
    return np.unique(np.concatenate(lists))


def all_patches(frames: np.ndarray, grid: int) -> np.ndarray:
    """All patches of some frames as (frame, patch) [n·grid², 2], frame by frame."""
    frame, patch = np.meshgrid(frames, np.arange(grid**2), indexing="ij")
    return np.stack([frame, patch], axis=-1).reshape(-1, 2)


def token_positions(indices: np.ndarray, grid: int) -> np.ndarray:
    """(frame, patch) [n, 2] → (frame, row, column) [n, 3] float32, rows and columns at patch
    centres in sixteenths.

    An 8×8 patch y sits at 2y + 1, a 4×4 patch at 4y + 2.
    """
    frame, patch = indices[:, 0], indices[:, 1]
    cell = POSITION_GRID / grid
    row = (patch // grid + 0.5) * cell
    column = (patch % grid + 0.5) * cell
    return np.stack([frame, row, column], axis=1).astype(np.float32)


def stack_history(
    items: Sequence[HistoryTokens], device: torch.device | None = None
) -> HistoryTokens:
    """Stack unbatched selections into one batch [b, n, …]; shorter ones, of left-padded memories,
    are padded there.
    """
    length = max(len(item.mask) for item in items)

    def stack(rows: Sequence[Tensor]) -> Tensor:
        padded = []
        for row in rows:
            other_axes = [0, 0] * (row.ndim - 1)
            padded.append(nn.functional.pad(row, (*other_axes, length - len(row), 0)))
        return torch.stack(padded).to(device)

    labels = Labels()
    for name in items[0].labels:
        labels[name] = stack([item.labels[name] for item in items])
    step = None
    steps = [item.step for item in items if item.step is not None]
    if len(steps) == len(items):
        step = torch.stack(steps).to(device)
    return HistoryTokens(
        features=stack([item.features for item in items]),
        positions=stack([item.positions for item in items]),
        mask=stack([item.mask for item in items]),
        step=step,
        labels=labels,
    )


TEMPORAL_BASE = 10_000.0
SPATIAL_BASE = 1_000.0


def position_features(positions: Tensor, dim: int) -> Tensor:
    """M-RoPE features of (frame, row, column): sin and cos of each axis, side by side.

    [sin tω | cos tω | sin yω′ | cos yω′ | sin xω′ | cos xω′] with
    ω_i = 10000^(−i/(w−1)), ω′_i = 1000^(−i/(w−1)), w = dim/6.

    Args:
        positions: [..., 3] as `HistoryTokens.positions`.
        dim: a multiple of 6, at least 12.

    Returns:
        [..., dim] float32, computed where the positions are.
    """
    w = dim // 6
    require(
        dim % 6 == 0 and w >= 2,
        f"position_dim={dim} must be a multiple of 6 (three axes, sin and cos) from 12 on.",
    )
    ramp = torch.arange(w, device=positions.device, dtype=torch.float32) / (w - 1)
    temporal = TEMPORAL_BASE**-ramp
    spatial = SPATIAL_BASE**-ramp
    frequencies = torch.stack([temporal, spatial, spatial])  # 3 w
    angles = positions.float()[..., None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(-2)


POSITIONS = ("time_space", "space", "none")
"""Which of its frame, row and column a memory token encodes: all three, row and column, or none."""


class FeatureEncoder(nn.Module):
    """token = P [feature | SiLU(W φ(position))]: nothing before, between or after, as released.

    P is `project` and W is `position`, with biases.

    Positions are `position_dim` wide: by default 3/8 of the vision width in multiples of 6, 768 at
    full size. Padding (zero feature, zero φ) becomes the constant P [0 | SiLU(b)], with the bias b
    of W: only the mask tells it apart. With `positions="space"` the features of the frame, the
    first third, are zero. With `"none"` there is no W, and token = P feature, which is the released
    encoder with `use_pos_emb: false`.
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
        self.positions = "time_space" if positions is None else positions
        check_choice("memory.positions", self.positions, POSITIONS)
        if position_dim is None:
            position_dim = max(48, 6 * (d_vision // 16))
        if position_hidden is None:
            position_hidden = position_dim
        check_sizes("memory", position_dim=position_dim, position_hidden=position_hidden)
        self.position_dim = position_dim
        self.position: nn.Linear | None = None
        if self.positions == "none":
            self.project = nn.Linear(d_vision, width)
        else:
            self.position = nn.Linear(position_dim, position_hidden)
            self.project = nn.Linear(d_vision + position_hidden, width)
        for layer in self.children():
            assert isinstance(layer, nn.Linear)
            nn.init.normal_(layer.weight, std=0.02)
            nn.init.zeros_(layer.bias)

    def embed_positions(self, positions: Tensor) -> Tensor:
        """Position features [b, n, position_dim] of positions [b, n, 3], float32."""
        features = position_features(positions, self.position_dim)
        if self.positions == "space":
            features[..., : self.position_dim // 3] = 0
        return features

    def encode(self, features: Tensor, embedded: Tensor) -> Tensor:
        """Encode features [b, n, d_vision] whose positions are embedded [b, n, position_dim]."""
        if self.position is None:
            return self.project(features.to(self.project.weight.dtype))
        position = nn.functional.silu(self.position(embedded.to(self.position.weight.dtype)))
        return self.project(torch.cat([features.to(position.dtype), position], dim=-1))

    def forward(self, features: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Encode features at positions [b, n, 3]; padding gets zero position features, not those of
        (0, 0, 0).
        """
        return self.encode(features, self.embed_positions(positions) * mask[..., None])


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
            d_vision: width of a vision token.
            width: of a memory token, given by the integration.
            budget: most memory tokens.
            storage: what is kept of each frame.
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


class FrameMemory(MemoryModule):
    """Selects all tokens of the frames that a subclass names."""

    lazy = True  # most frames are never selected

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        """The frames that are read at `step` of an episode whose execution begins at `exec_start`;
        int64, ascending.
        """
        raise NotImplementedError

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return union_frames([self.selected_frames(int(step), exec_start) for step in steps])

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        return all_patches(self.selected_frames(step, history.exec_start), self.storage.grid)


def encode_selection(memory: "Memory", history: HistoryTokens) -> MemoryTokens:
    """What the memory's `forward` returns.

    Raises:
        UserError: it is no `MemoryTokens`.
    """
    tokens: MemoryTokens = memory(history)
    require(
        isinstance(tokens, MemoryTokens),
        f"{type(memory).__name__}.forward returned {type(tokens).__name__}; expected"
        " mme_vla.MemoryTokens(tokens, mask), [b, n, d] and bool [b, n] with n of at most"
        f" budget={memory.budget}.",
    )
    return tokens


def check_scorer(memory: "Memory") -> None:
    """Check that a cache stores scores under the key of the scorer that the memory makes.

    Raises:
        UserError: the keys differ, so that training and episodes would read different scores.
    """
    scorer = memory.make_scorer()
    key = "" if scorer is None else scorer.key
    require(
        memory.storage.scorer == key,
        f"{type(memory).__name__}: storage.scorer={brief(memory.storage.scorer)} is not the key of"
        f" the scorer that make_scorer() returns ({brief(key)}), so a cache would hold the scores"
        " of another rule. Pass StorageSpec(…, scorer=<that scorer>.key), with the same options.",
    )
