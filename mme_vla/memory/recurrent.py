"""Base of the recurrent memories: frames update a small state, and the state is read as memory
tokens.

There are two forms of the same computation. `forward` runs a full window, for training.
`init_state`, `update` and `read` run frame by frame: `encode` uses them while an episode's frame
list grows.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from mme_vla.config.devices import float32_products
from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import (
    FeatureEncoder,
    FrameMemory,
    all_patches,
    take_options,
    token_positions,
)
from mme_vla.memory.history import History, StorageSpec
from mme_vla.types import HistoryTokens, MemoryTokens, send


def recurrent_frames(
    step: int,
    exec_start: int,
    max_steps: int = 64,
    max_video: int = 40,
    stride: int = 16,
    every: int = 1,
) -> np.ndarray:
    """Frames read at `step`, ascending and ending with `step`; at most `max_steps`, the earliest
    dropped first.

    Execution frames stand `stride` apart, counted back from `step`, so the offset comes from `step`
    alone. Video frames stand half a stride apart in a video of up to two strides, a stride apart
    while that gives no more than `max_video`, and are spread evenly, both ends included, beyond
    that.

    Args:
        step: the current frame.
        exec_start: the first execution frame (0 without video). While the video still runs, all
            frames before the current one count as video, so a finished episode and a running one
            agree.
        every: above 1 all this counts the frames 0 and k·every − 1 alone, and `step` comes after
            the newest of them. Two steps then read the same past frames, which demonstrations and
            episodes render once.

    Returns:
        int64 [n].
    """
    frames = np.union1d([0], np.arange(every - 1, step + 1, every))
    spacing = stride // every
    last = len(frames) - 1
    start = min(int(np.searchsorted(frames, exec_start)), last)
    video = video_frames(start, max_video, spacing)
    execution = np.arange(start + (last - start) % spacing, last + 1, spacing)
    past = frames[np.concatenate([video, execution])]
    return np.union1d(past, [step])[-max_steps:]


def check_every(every: int, stride: int, name: str = "stride") -> None:
    """Raise `UserError` unless frames `stride` apart are among every so many; name: the key of
    `stride`.
    """
    check_sizes("memory", every=every)
    require(
        stride % every == 0,
        f"memory.{name}={stride} must be a multiple of memory.every={every}, such as"
        f" {-(-stride // every) * every}.",
    )


def video_frames(length: int, max_video: int, stride: int) -> np.ndarray:
    """Frames read of a conditioning video of `length` frames."""
    if length <= 2 * stride:
        return np.arange(0, length, max(stride // 2, 1))
    if length <= max_video * stride:
        return np.arange(0, length, stride)
    return np.linspace(0, length - 1, max_video).astype(np.int64)


def jittered(
    frames: np.ndarray, exec_start: int, jitter: int, rng: np.random.Generator
) -> np.ndarray:
    """Move every frame but the last by up to `jitter` frames, video and execution each within its
    own part.
    """
    past, step = frames[:-1], frames[-1]
    shifted = past + rng.integers(-jitter, jitter + 1, len(past))
    is_video = past < exec_start
    lowest = np.where(is_video, 0, exec_start)
    highest = np.where(is_video, min(exec_start, step) - 1, step - 1)
    return np.append(np.unique(np.clip(shifted, lowest, highest)), step)


@dataclass(frozen=True)
class FrameSchedule:
    """Which frames a recurrent memory reads: its options.

    max_steps, max_video, stride, every: see `recurrent_frames`.
    jitter: in training, past frames move at random by up to this many frames, if the data hand over
        randomness (`data.jitter`).
    """

    max_steps: int = 64
    max_video: int = 40
    stride: int = 16
    every: int = 1
    jitter: int = 0

    def __post_init__(self) -> None:
        check_sizes(
            "memory", max_steps=self.max_steps, max_video=self.max_video, stride=self.stride
        )
        check_every(self.every, self.stride)
        require(
            0 <= 2 * self.jitter < self.stride,
            f"memory.jitter={self.jitter} must be less than half of memory.stride={self.stride}.",
        )
        require(
            self.every == 1 or not self.jitter,
            f"memory.jitter={self.jitter} moves frames away from those of memory.every="
            f"{self.every}: set memory.jitter=0 or memory.every=1.",
        )

    def frames(self, step: int, exec_start: int) -> np.ndarray:
        """Frames read at `step`, ascending and ending with `step`; int64 [n]."""
        return recurrent_frames(
            step, exec_start, self.max_steps, self.max_video, self.stride, self.every
        )


class ScheduledMemory(FrameMemory):
    """Reads the frames that its `schedule` names."""

    schedule: FrameSchedule

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        return self.schedule.frames(step, exec_start)


State = tuple[Tensor, ...]
"""What is carried from frame to frame; each tensor [b, …]."""

MAX_SNAPSHOTS = 4
"""States kept of an episode: replans every quarter, half, three quarters or whole of a stride all
continue one.
"""


@dataclass(eq=False)
class Snapshot:
    """A state (None before the first frame) and the frames [n] that it was updated with, in
    order.
    """

    frames: np.ndarray
    state: State | None = None


@dataclass
class RecurrentStream:
    """How far one episode's recurrence has come.

    snapshots: the last used is the last one.
    updates: frames taken since the episode began, repeated ones included.
    last_step: that of the last decision.
    pace: frames from the decision before it to that one.
    """

    snapshots: list[Snapshot] = field(default_factory=list)
    updates: int = 0
    last_step: int | None = None
    pace: int | None = None

    def longest_start(self, frames: np.ndarray) -> Snapshot:
        """The snapshot that was updated with the longest beginning of these frames; a fresh one
        where there is none. It becomes the last used.
        """
        matching = [
            snapshot
            for snapshot in self.snapshots
            if np.array_equal(frames[: len(snapshot.frames)], snapshot.frames)
        ]
        fresh = Snapshot(frames[:0])
        best = max(matching, key=lambda snapshot: len(snapshot.frames), default=fresh)
        others = [snapshot for snapshot in self.snapshots if snapshot is not best]
        self.snapshots = [*others, best][-MAX_SNAPSHOTS:]
        return best


def pieces(count: int, chunk: int) -> Iterator[int]:
    """How many frames enter together: chunks, and the newest alone.

    A state that was prepared before the newest frame arrived has so been through the same steps, to
    the bit, as one that takes them all at once.
    """
    for start in range(0, count - 1, chunk):
        yield min(chunk, count - 1 - start)
    if count:
        yield 1


Statistics = dict[str, Tensor]
"""Numbers about each step, [b, t], detached."""


class RecurrentLayer(nn.Module):
    """How a frame changes the state, in float32 whatever surrounds it. Subclasses choose.

    window: most frames at the end of a list whose outputs `read` returns; None where `following`
        may count further.
    """

    window: int | None = None

    def initial(self, batch: int) -> State:
        """The learned state before the first frame, for a batch of `batch`."""
        raise NotImplementedError

    def advance(
        self, state: State, x: Tensor, valid: Tensor, following: int = 0, statistics: bool = False
    ) -> tuple[State, Statistics]:
        """Take t frames.

        Args:
            state: as `initial` or an earlier call gave it.
            x: encoded frames [b, t, p, d], p tokens each.
            valid: [b, t]; a padding frame leaves the state as it is.
            following: frames that come after these before anything is read.
            statistics: also compute the numbers about each step, which cost time.
        """
        raise NotImplementedError

    def read(self, state: State) -> tuple[Tensor, Tensor]:
        """Tokens [b, budget, d] and their mask [b, budget]."""
        raise NotImplementedError

    def summary(self, start: State, end: State) -> dict[str, Tensor]:
        """Numbers about a whole window, from the states around it."""
        return {}


class RecurrentMemory(ScheduledMemory):
    """Encoder → recurrent layer → output projection. Subclasses supply the layer.

    Besides its own arguments it takes those of `FrameSchedule` and `FeatureEncoder`.

    float32_products: how a GPU multiplies in the layer, which computes in float32: `ieee` or
        `tf32`. Set from outside (`policy.float32_products`).
    """

    option_types: ClassVar[tuple[type, ...]] = (FrameSchedule, FeatureEncoder)
    float32_products: str = "ieee"

    def __init__(
        self,
        d_vision: int,
        width: int,
        layer: RecurrentLayer,
        hidden: int,
        budget: int,
        grid: int = 8,
        pooling: str = "mean",
        *,
        chunk: int = 8,
        recompute: bool = True,
        **options: Any,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token.
            width: of a memory token, given by the integration.
            layer: the recurrence, at width `hidden`.
            budget: memory tokens handed over.
            grid, pooling: a remembered frame is grid×grid tokens.
            chunk: frames that are recomputed together in the backward pass; windows are padded to a
                multiple of it, since the steps of a short episode are few.
            recompute: False keeps what the backward pass needs: faster, and the memory of all
                chunks instead of one.
            options: fields of `FrameSchedule`; and `position_dim`, `position_hidden` and
                `positions` of the `FeatureEncoder`.
        """
        super().__init__()
        self.schedule = take_options(FrameSchedule, options)
        check_sizes("memory", chunk=chunk)
        self.budget = budget
        self.capacity = self.schedule.max_steps * grid**2
        self.pad_left = chunk * grid**2
        self.storage = StorageSpec(grid, pooling)
        self.chunk = chunk
        self.recompute = recompute
        self.encoder = FeatureEncoder(d_vision, hidden, **options)
        self.layer = layer
        self._compiled: Callable[..., tuple[State, Statistics]] | None = None
        self.output = nn.Linear(hidden, width)
        nn.init.normal_(self.output.weight, std=0.02)
        nn.init.zeros_(self.output.bias)

    # Which frames

    def frames(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """Frames read at `step`, ascending; the last is `step`."""
        frames = self.selected_frames(step, history.exec_start)
        if rng is None or not self.schedule.jitter:
            return frames
        return jittered(frames, history.exec_start, self.schedule.jitter, rng)

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        return all_patches(self.frames(history, step, rng), self.storage.grid)

    # The window

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        """Encode a window [b, n, d_vision] of whole frames; while `reporting`, statistics of the
        layer are metrics.
        """
        x = self.encoder(history.features, history.positions, history.mask)
        return self.run(self._by_frame(x), self._by_frame(history.mask).all(-1))

    def run(self, x: Tensor, valid: Tensor) -> MemoryTokens:
        """Run the recurrence over encoded frames [b, t, p, d], of which `valid` [b, t] are real.

        The state begins as `initial`, every chunk of frames takes it through `advance`, and `read`
        makes tokens of the last one. Gradients flow through every step.
        """
        # A CPU skips the windows that have no frame yet, unless `read` returns outputs of this
        # chunk. A GPU would synchronise to know which.
        skips_empty = x.device.type == "cpu" and not (
            self.reporting or self._compiled or torch.compiler.is_compiling()
        )
        window = self.layer.window
        start = state = self.init_state(len(x))
        statistics = []
        entered = 0
        for frames, real in zip(x.split(self.chunk, 1), valid.split(self.chunk, 1), strict=True):
            entered += frames.shape[1]
            remaining = x.shape[1] - entered
            following = remaining if window is None else min(remaining, window)
            if skips_empty and following == window:
                rows = valid[:, :entered].any(1).nonzero()[:, 0]
                of_rows = [tensor[rows] for tensor in state]
                updated, numbers = self._advance(of_rows, frames[rows], real[rows], following)
                pairs = zip(state, updated, strict=True)
                state = tuple(old.index_copy(0, rows, new) for old, new in pairs)
            else:
                state, numbers = self._advance(state, frames, real, following)
            statistics.append(numbers)
        tokens = self.read(state)
        if self.reporting:
            # Means over the real frames of a batch.
            count = valid.sum().clamp(min=1)
            means = {}
            for name in statistics[0]:
                values = torch.cat([chunk[name] for chunk in statistics], 1)  # b t
                means[name] = (values * valid).sum() / count
            tokens.metrics = means | self.layer.summary(start, state)
        return tokens

    def _advance(
        self, state: Sequence[Tensor], frames: Tensor, valid: Tensor, following: int
    ) -> tuple[State, Statistics]:
        """`RecurrentLayer.advance` over one chunk, compiled after `compile`. With `recompute` only
        what enters it is kept for the backward pass.
        """
        advance = self.layer.advance
        if self._compiled is not None and not self.reporting:
            # Statistics are needed of one update in many: not worth compiling for.
            advance = partial(self._compiled, self.layer)
        if not torch.compiler.is_compiling():
            # Within the step, which the backward pass computes again; a graph has no place for a
            # switch of the process.
            advance = partial(_advance_with, self.float32_products, advance)
        # All chunks are laid out alike, whatever the window's length: they share one code.
        *entering, frames, valid = (tensor.contiguous() for tensor in (*state, frames, valid))
        arguments = (tuple(entering), frames, valid, following, self.reporting)
        if torch.is_grad_enabled() and self.recompute:
            return checkpoint(advance, *arguments, use_reentrant=False, preserve_rng_state=False)
        return advance(*arguments)

    def compile(self, **options: Any) -> None:
        """Compile the steps of a chunk, whose number does not depend on how long a window is."""
        self._compiled = torch.compile(
            type(self.layer).advance, **{**options, "fullgraph": True, "dynamic": False}
        )

    # Frame by frame

    def init_state(self, batch: int) -> State:
        """The state before the first frame."""
        return self.layer.initial(batch)

    def update(self, state: State, features: Tensor, positions: Tensor, mask: Tensor) -> State:
        """Let the next frame, or several whole frames, enter.

        Args:
            features: [b, n, d_vision], n a multiple of a frame's tokens.
            positions: [b, n, 3].
            mask: [b, n].
        """
        x = self.encoder(features, positions, mask)
        with float32_products(self.float32_products):
            return self.layer.advance(state, self._by_frame(x), self._by_frame(mask).all(-1))[0]

    def read(self, state: State) -> MemoryTokens:
        """The memory tokens of a state."""
        tokens, mask = self.layer.read(state)
        return MemoryTokens(self.output(tokens.to(self.output.weight.dtype)), mask)

    # Episodes

    def start_stream(self) -> RecurrentStream:
        return RecurrentStream()

    def encode(self, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
        """Memory tokens of running episodes.

        While an episode's frame list extends one that its stream was updated with, only the new
        frames enter. Where it does not (replans at an uneven pace, or a list that lost its first
        frames and was not prepared), a fresh state takes the full list. A current frame that no
        later list has (`every`) enters a copy of the stream's state. Episodes with equally many new
        frames go through the layer together.
        """
        snapshots: list[Snapshot] = []
        entering: list[np.ndarray] = []
        groups: dict[int, list[int]] = defaultdict(list)  # number of new frames → episodes
        for i, (history, stream) in enumerate(zip(histories, streams, strict=True)):
            step = len(history) - 1
            if stream.last_step is not None and step > stream.last_step:
                stream.pace = step - stream.last_step
            stream.last_step = step
            frames = self.frames(history, step)
            snapshot = stream.longest_start(frames)
            new = frames[len(snapshot.frames) :]
            stream.updates += len(new)
            snapshots.append(snapshot)
            entering.append(new)
            groups[len(new)].append(i)
        for count, group in groups.items():
            start = 0
            for size in pieces(count, self.chunk):
                stop = start + size
                for i in group:
                    if stop == count and len(histories[i]) % self.schedule.every != 0:
                        snapshots[i] = replace(snapshots[i])
                self._enter([(histories[i], snapshots[i], entering[i][start:stop]) for i in group])
                start = stop
        return self.read(_stack([self._state_of(snapshot) for snapshot in snapshots]))

    def prepare(self, history: History, stream: Any) -> bool:
        """Let a chunk of frames enter that the next decision's list has before its newest one.

        The next decision is expected as long after the last one as that came after the one before.
        Work is left where its list does not extend an earlier one: once a list is full its first
        frames are dropped, and the released computation begins anew behind them at every decision.
        """
        if stream.last_step is None:
            return False
        next_step = stream.last_step + (stream.pace or self.schedule.stride)
        expected = self.frames(history, next_step)[:-1]
        expected = expected[expected < len(history)]
        if not len(expected):
            return False
        snapshot = stream.longest_start(expected)
        new = expected[len(snapshot.frames) :][: self.chunk]
        if len(new):
            self._enter([(history, snapshot, new)])
            stream.updates += len(new)
        return len(snapshot.frames) < len(expected)

    def _enter(self, group: Sequence[tuple[History, Snapshot, np.ndarray]]) -> None:
        """Update each of these snapshots with equally many new frames."""
        grid = self.storage.grid
        states, features, positions = [], [], []
        for history, snapshot, frames in group:
            indices = all_patches(frames, grid)
            states.append(self._state_of(snapshot))
            features.append(history.gather(indices))
            positions.append(token_positions(history.timed(indices), grid))
        x = torch.stack(features)
        mask = torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)
        state = self.update(
            _stack(states), x, send(torch.from_numpy(np.stack(positions)), x.device), mask
        )
        for i, (_, snapshot, frames) in enumerate(group):
            snapshot.state = tuple(tensor[i : i + 1] for tensor in state)
            snapshot.frames = np.append(snapshot.frames, frames)

    def _state_of(self, snapshot: Snapshot) -> State:
        return self.init_state(1) if snapshot.state is None else snapshot.state

    def _by_frame(self, x: Tensor) -> Tensor:
        return x.unflatten(1, (-1, self.storage.grid**2))


def _stack(states: Sequence[State]) -> State:
    return tuple(torch.cat(tensors) for tensors in zip(*states, strict=True))


def full_precision(x: Tensor) -> torch.autocast:
    """The context recurrent layers run in: no autocast, so that hundreds of small steps do not
    round.
    """
    device_type = "cpu" if x.device.type == "meta" else x.device.type
    return torch.autocast(device_type, enabled=False)


def linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a linear layer in float32, whatever its weights are stored in."""
    bias = None if layer.bias is None else layer.bias.float()
    return nn.functional.linear(x, layer.weight.float(), bias)


def layer_norm(norm: nn.LayerNorm, x: Tensor) -> Tensor:
    """Apply a layer norm in float32."""
    return nn.functional.layer_norm(
        x, norm.normalized_shape, norm.weight.float(), norm.bias.float(), norm.eps
    )


def default_hidden(d_vision: int, hidden: int | None) -> int:
    """A quarter of the vision width, at least 64: 512 at full size, as released."""
    hidden = hidden or max(64, d_vision // 4)
    check_sizes("memory", hidden=hidden)
    return hidden


def _advance_with(
    products: str, advance: Callable[..., Any], *inputs: Any
) -> tuple[State, Statistics]:
    with float32_products(products):
        return advance(*inputs)
