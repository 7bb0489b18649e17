"""Base of the recurrent memories: frames update a small state, and the state is read as memory
tokens.

Two forms of the same computation: `forward` runs a full window, for training; `init_state`,
`update` and `read` take it frame by frame, which `encode` uses while an episode's frame list grows.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from mme_vla.config.devices import float32_products
from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import (
    CompilableMemory,
    FeatureEncoder,
    MatmulPrecision,
    MemoryModule,
    StreamingMemory,
    all_patches,
    token_positions,
    union_frames,
)
from mme_vla.memory.history import History, StorageSpec
from mme_vla.types import HistoryTokens, MemoryTokens


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
        step: the current frame. exec_start: the first execution frame (0 without video). While the
            video still runs, all frames before the current one count as video, so a finished
            episode and a running one agree.
        every: above 1 all this counts the frames 0 and k·every − 1 alone, and `step` comes after
            the newest of them. Two steps then read the same past frames, which demonstrations and
            episodes render once.

    Returns:
        int64 [n].
    """
    frames = np.union1d([0], np.arange(every - 1, step + 1, every))
    last, apart = len(frames) - 1, stride // every
    start = min(int(np.searchsorted(frames, exec_start)), last)
    execution = np.arange(start + (last - start) % apart, last + 1, apart)
    past = frames[np.concatenate([video_frames(start, max_video, apart), execution])]
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
    video = past < exec_start
    low, high = np.where(video, 0, exec_start), np.where(video, min(exec_start, step) - 1, step - 1)
    return np.append(np.unique(np.clip(shifted, low, high)), step)


State = tuple[Tensor, ...]
"""What is carried from frame to frame; each tensor [b, …]."""

MAX_SNAPSHOTS = 4
"""States kept of an episode: replans every quarter, half, three quarters or whole of a stride all
continue one.
"""


@dataclass(eq=False)
class Taken:
    """A state (None before the first frame) and the frames [n] that it has taken, in order."""

    frames: np.ndarray
    state: State | None = None


@dataclass
class RecurrentStream:
    """How far one episode's recurrence has come.

    snapshots: the last used is the last one. updates: frames taken since the episode began,
    repeated ones included. last_step: that of the last decision. pace: frames from the decision
    before it to that one.
    """

    snapshots: list[Taken] = field(default_factory=list)
    updates: int = 0
    last_step: int | None = None
    pace: int | None = None

    def decides(self, step: int) -> None:
        """Note that a decision is made at `step`."""
        if self.last_step is not None and step > self.last_step:
            self.pace = step - self.last_step
        self.last_step = step

    def continued(self, frames: np.ndarray) -> Taken:
        """The state that has taken the longest beginning of these frames; a fresh one where none
        has.
        """
        fitting = [
            taken
            for taken in self.snapshots
            if np.array_equal(frames[: len(taken.frames)], taken.frames)
        ]
        best = max(fitting, key=lambda taken: len(taken.frames), default=Taken(frames[:0]))
        self.snapshots = [*(taken for taken in self.snapshots if taken is not best), best][
            -MAX_SNAPSHOTS:
        ]
        return best


def pieces(count: int, chunk: int) -> Iterator[int]:
    """How many frames enter together: chunks, and the newest alone.

    A state that was prepared before the newest frame was there has so been through the same steps,
    to the bit, as one that takes them all at once.
    """
    for start in range(0, count - 1, chunk):
        yield min(chunk, count - 1 - start)
    if count:
        yield 1


Statistics = dict[str, Tensor]
"""Numbers about each step, [b, t], detached."""


class RecurrentLayer(nn.Module):
    """How a frame changes the state, in float32 whatever surrounds it. Subclasses choose.

    window: most frames at the end of a list whose outputs `read` hands over; None where `following`
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
            x: encoded frames [b, t, p, d], p tokens each. valid: [b, t]; a padding frame leaves the
                state as it is.
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


class RecurrentMemory(MemoryModule, StreamingMemory, CompilableMemory, MatmulPrecision):
    """Encoder → recurrent layer → output projection. Subclasses supply the layer."""

    pad_left = True
    lazy = True

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
        max_steps: int = 64,
        max_video: int = 40,
        stride: int = 16,
        every: int = 1,
        jitter: int = 0,
        chunk: int = 8,
        recompute: bool = True,
        position_dim: int | None = None,
        position_hidden: int | None = None,
        positions: str | None = None,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            layer: the recurrence, at width `hidden`.
            budget: memory tokens handed over.
            grid, pooling: a remembered frame is grid×grid tokens.
            max_steps, max_video, stride, every: see `recurrent_frames`.
            jitter: in training, past frames move at random by up to this many frames, if the data
                hand over randomness (`data.jitter`).
            chunk: frames that are recomputed together in the backward pass; windows are padded to a
                multiple of it.
            recompute: False keeps what the backward pass needs: faster, and the memory of all
                chunks instead of one.
            position_dim, position_hidden: widths of the position features and their layer; None
                follows `d_vision`.
            positions: of `POSITIONS`; None: `time_space`.
        """
        super().__init__()
        check_sizes("memory", max_steps=max_steps, max_video=max_video, stride=stride, chunk=chunk)
        check_every(every, stride)
        require(
            0 <= 2 * jitter < stride,
            f"memory.jitter={jitter} must be less than half of memory.stride={stride}.",
        )
        require(
            every == 1 or not jitter,
            f"memory.jitter={jitter} moves frames away from those of memory.every={every}: set"
            " memory.jitter=0 or memory.every=1.",
        )
        self.budget, self.capacity = budget, max_steps * grid**2
        self.storage = StorageSpec(grid, pooling)
        self.max_steps, self.max_video, self.stride, self.every = (
            max_steps,
            max_video,
            stride,
            every,
        )
        self.jitter, self.chunk, self.recompute = jitter, chunk, recompute
        self.encoder = FeatureEncoder(d_vision, hidden, position_dim, position_hidden, positions)
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
        limits = (self.max_steps, self.max_video, self.stride, self.every)
        frames = recurrent_frames(step, history.exec_start, *limits)
        return (
            frames
            if rng is None or not self.jitter
            else jittered(frames, history.exec_start, self.jitter, rng)
        )

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        limits = (self.max_steps, self.max_video, self.stride, self.every)
        return union_frames([recurrent_frames(int(step), exec_start, *limits) for step in steps])

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        return all_patches(self.frames(history, step, rng), self.storage.grid)

    def padded_length(self, count: int) -> int:
        """Whole chunks: the steps of a short episode are few, and nothing changes but the time they
        take.
        """
        chunk = self.chunk * self.storage.grid**2
        return min(-(-count // chunk) * chunk, self.capacity)

    # The window

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        """Encode a window [b, n, d_vision] of whole frames; while `reporting`, statistics of the
        layer are metrics.
        """
        x = self.encoder(history.features, history.positions, history.mask)
        return self.run(self._by_frame(x), self._by_frame(history.mask).all(-1))

    def run(self, x: Tensor, valid: Tensor) -> MemoryTokens:
        """Run the recurrence over encoded frames [b, t, p, d], of which `valid` [b, t] are real.

        Gradients flow through every step. With `recompute` only the states between chunks are kept
        for them.
        """
        # Statistics are wanted of one update in many: not worth compiling for.
        compiled = None if self.reporting else self._compiled
        advance = self.layer.advance if compiled is None else partial(compiled, self.layer)
        # Within the step, which the backward pass computes again; a graph has no place for a switch
        # of the process.
        step = (
            advance
            if torch.compiler.is_compiling()
            else partial(_multiplying, self.float32_products, advance)
        )
        window = self.layer.window
        start = self.init_state(len(x))
        # All chunks are laid out alike, whatever the window's length: they share one code.
        state = tuple(tensor.contiguous() for tensor in start)
        # A CPU skips the windows that have no frame yet, unless `read` hands over this chunk. A GPU
        # would synchronise to know which.
        skips = x.device.type == "cpu" and not (
            self.reporting or compiled or torch.compiler.is_compiling()
        )
        statistics, following = [], x.shape[1]
        for part, real in zip(x.split(self.chunk, 1), valid.split(self.chunk, 1), strict=True):
            following -= part.shape[1]
            counted = following if window is None else min(following, window)
            rows = None
            if skips and window is not None and following >= window:
                rows = valid[:, : x.shape[1] - following].any(1).nonzero()[:, 0]
            entering = (
                (*state, part, real)
                if rows is None
                else tuple(t[rows] for t in (*state, part, real))
            )
            *before, part, real = (tensor.contiguous() for tensor in entering)
            inputs = (tuple(before), part, real, counted, self.reporting)
            if torch.is_grad_enabled() and self.recompute:
                after, numbers = checkpoint(
                    step, *inputs, use_reentrant=False, preserve_rng_state=False
                )
            else:
                after, numbers = step(*inputs)
            if rows is not None:
                after = tuple(
                    old.index_copy(0, rows, new) for old, new in zip(state, after, strict=True)
                )
            state = after
            statistics.append(numbers)
        tokens = self.read(state)
        if self.reporting:
            tokens.metrics = self._metrics(statistics, valid) | self.layer.summary(start, state)
        return tokens

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
            features: [b, n, d_vision], n a multiple of a frame's tokens. positions: [b, n, 3].
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

        While an episode's frame list extends one that its stream has taken, only the new frames
        enter. Where it does not (replans at an uneven pace, or a list that lost its first frames
        and was not prepared), a fresh state takes the whole list. A current frame that no later
        list has (`every`) enters a copy of the stream's state. Episodes with equally many new
        frames go through the layer together.
        """
        pending: dict[int, list[int]] = defaultdict(list)
        states, entering = [], []
        for i, (history, stream) in enumerate(zip(histories, streams, strict=True)):
            step = len(history) - 1
            stream.decides(step)
            frames = self.frames(history, step)
            states.append(stream.continued(frames))
            entering.append(frames[len(states[i].frames) :])
            pending[len(entering[i])].append(i)
            stream.updates += len(entering[i])
        for count, group in pending.items():
            at = 0
            for size in pieces(count, self.chunk):
                if at == count - 1:
                    for i in group:
                        states[i] = (
                            states[i] if len(histories[i]) % self.every == 0 else replace(states[i])
                        )
                self._enter([(histories[i], states[i], entering[i][at : at + size]) for i in group])
                at += size
        return self.read(_stack([taken.state or self.init_state(1) for taken in states]))

    def prepare(self, history: History, stream: Any) -> bool:
        """Let a chunk of frames enter that the next decision's list has before its newest one.

        The next decision is expected as long after the last one as that came after the one before.
        There is something to do where its list does not extend one that was taken: once a list is
        full its first frames go, and the released computation begins anew behind them at every
        decision.
        """
        if stream.last_step is None:
            return False
        expected = self.frames(history, stream.last_step + (stream.pace or self.stride))[:-1]
        expected = expected[expected < len(history)]
        if not len(expected):
            return False
        taken = stream.continued(expected)
        new = expected[len(taken.frames) :][: self.chunk]
        if len(new):
            self._enter([(history, taken, new)])
            stream.updates += len(new)
        return len(taken.frames) < len(expected)

    def _enter(self, group: Sequence[tuple[History, Taken, np.ndarray]]) -> None:
        """Let equally many new frames enter each of these states."""
        state = _stack([taken.state or self.init_state(1) for _, taken, _ in group])
        indices = [all_patches(new, self.storage.grid) for _, _, new in group]
        features = torch.stack(
            [history.gather(at) for (history, _, _), at in zip(group, indices, strict=True)]
        )
        pairs = zip(group, indices, strict=True)
        positions = np.stack(
            [token_positions(history.timed(at), self.storage.grid) for (history, _, _), at in pairs]
        )
        everywhere = torch.ones(features.shape[:2], dtype=torch.bool, device=features.device)
        state = self.update(
            state, features, torch.from_numpy(positions).to(features.device), everywhere
        )
        for i, (_, taken, new) in enumerate(group):
            taken.state = tuple(tensor[i : i + 1] for tensor in state)
            taken.frames = np.append(taken.frames, new)

    def _by_frame(self, x: Tensor) -> Tensor:
        return x.unflatten(1, (-1, self.storage.grid**2))

    @staticmethod
    def _metrics(statistics: Sequence[Statistics], valid: Tensor) -> dict[str, Tensor]:
        """Mean over the real frames of a batch."""
        count = valid.sum().clamp(min=1)
        names = statistics[0] if statistics else {}
        return {
            name: (torch.cat([s[name] for s in statistics], 1) * valid).sum() / count
            for name in names
        }


def _stack(states: Sequence[State]) -> State:
    return tuple(torch.cat(tensors) for tensors in zip(*states, strict=True))


def full_precision(x: Tensor) -> torch.autocast:
    """The context recurrent layers run in: no autocast, so that hundreds of small steps do not
    round.
    """
    return torch.autocast(x.device.type if x.device.type != "meta" else "cpu", enabled=False)


def linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a linear layer in float32, whatever its weights are stored in."""
    return nn.functional.linear(
        x, layer.weight.float(), None if layer.bias is None else layer.bias.float()
    )


def layer_norm(norm: nn.LayerNorm, x: Tensor) -> Tensor:
    """Apply a layer norm in float32."""
    return nn.functional.layer_norm(
        x, norm.normalized_shape, norm.weight.float(), norm.bias.float(), norm.eps
    )


def default_hidden(d_vision: int, hidden: int | None) -> int:
    """A quarter of the vision width, at least 64: 512 at full size, as released."""
    return hidden or max(64, d_vision // 4)


def _multiplying(how: str, advance: Callable[..., Any], *inputs: Any) -> tuple[State, Statistics]:
    with float32_products(how):
        return advance(*inputs)
