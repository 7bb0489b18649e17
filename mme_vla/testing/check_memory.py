"""`check_memory`: the properties of a memory that training, streaming and the
integrations rely on.
"""

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from mme_vla.memory.base import (
    Memory,
    encode_histories,
    make_scorer,
    stack_history,
    start_stream,
    uses_proprio,
)
from mme_vla.memory.history import CachedHistory, FrameScores, History, OnlineHistory
from mme_vla.registry import MEMORIES
from mme_vla.testing.small import moving_frames
from mme_vla.types import HistoryTokens, MemoryTokens

D_VISION, WIDTH, MOTION, STATE = 32, 48, 17, 8
TOLERANCE = 1e-4
_Kind = TypeVar("_Kind", bound=History)


def check_memory(name: str, frames: int = 48, **options: Any) -> None:
    """Run every check on the memory that is registered under `name`, and print a line for each that
    passed.

    The episode is synthetic: `frames` images in which a square moves, the first 20 of them a
    conditioning video.

    Args:
        name: the key in `MEMORIES`. frames: length of the episode, at least 40.
        options: the memory's own, as its YAML would give them.
    """
    memory: Memory = MEMORIES.build({"name": name, **options}, d_vision=D_VISION, width=WIDTH)
    memory.eval()
    check_selection(memory, frames)
    print(
        f"{name}: select stays in bounds, ignores later frames, repeats, and agrees offline and"
        " online"
    )
    check_encoding(memory, frames)
    print(
        f"{name}: forward hands over at most {memory.budget} finite tokens, ignores padding, and"
        " trains"
    )
    check_streaming(memory, frames)
    print(f"{name}: streaming gives the same tokens as the full history")
    check_rebuilding(name, options, memory)
    print(f"{name}: saved weights give the same tokens when they are loaded")


class Episode:
    """One synthetic episode, as a cache holds it and as it comes frame by frame; equal tokens in
    both.
    """

    exec_start = 20

    def __init__(self, memory: Memory, frames: int, seed: int = 0) -> None:
        self.memory, self.length = memory, frames
        self.images = moving_frames(frames, seed=seed)
        generator = torch.Generator().manual_seed(seed)
        self.tokens = torch.randn(frames, memory.storage.grid**2, D_VISION, generator=generator)
        self.motion = torch.randn(frames, MOTION, generator=generator)

    def cached(self, length: int | None = None) -> CachedHistory:
        """The whole episode, or its first `length` frames, as read from a cache."""
        length = self.length if length is None else length
        spec, scorer = self.memory.storage, make_scorer(self.memory)
        stored = spec.stored_frames(length)
        rows = [] if scorer is None else [(t, scorer(t, self.images[t])) for t in range(length)]
        scored = [(t, values) for t, values in rows if values is not None]
        scores = (
            FrameScores(np.array([t for t, _ in scored]), np.stack([v for _, v in scored]))
            if scored
            else None
        )
        history = CachedHistory(
            spec, self.tokens[stored].numpy(), stored, length, scores, self.exec_start
        )
        return self._moving(history)

    def _moving(self, history: _Kind) -> _Kind:
        """The history with what the robot felt and did, where its memory reads that."""
        history.motion, history.state_width = (
            self.motion.__getitem__ if uses_proprio(self.memory) else None,
            STATE,
        )
        return history

    def online(self, piece: int, until: int | None = None) -> OnlineHistory:
        """The first `until` frames as an environment delivers them, `piece` at a time."""
        history = self._moving(
            OnlineHistory(self.memory.storage, make_scorer(self.memory), self.exec_start)
        )
        self.extend(history, piece, self.length if until is None else until)
        return history

    def sparse(self, rendered: np.ndarray, until: int) -> OnlineHistory:
        """The first `until` frames, of which only some have an image."""
        history = self._moving(
            OnlineHistory(self.memory.storage, make_scorer(self.memory), self.exec_start)
        )
        tokens = self.tokens[history.to_encode(until, rendered)]
        history.append(self.images[rendered], tokens, rendered, until)
        return history

    def extend(self, history: OnlineHistory, piece: int, until: int) -> None:
        """Deliver the frames that a history lacks, up to `until`."""
        for start in range(len(history), until, piece):
            stop = min(start + piece, until)
            required = history.to_encode(stop - start)
            history.append(self.images[start:stop], self.tokens[start:stop][required])


def check_selection(memory: Memory, frames: int) -> None:
    """`select`: in bounds, in time order, blind to the future, repeatable, the same offline and
    online.
    """
    episode, patches = Episode(memory, frames), memory.storage.grid**2
    full = episode.cached()
    for step in (0, 1, 15, 16, 17, 39, frames - 1):
        selection = memory.select(full, step)
        assert (
            selection.ndim == 2
            and selection.shape[1] == 2
            and np.issubdtype(selection.dtype, np.integer)
        ), (
            f"select must return whole numbers [n, 2] of (frame, patch); at step {step} it gave"
            f" {selection.dtype} {selection.shape}."
        )
        assert len(selection) <= memory.capacity, (
            f"select chose {len(selection)} tokens; capacity is {memory.capacity}."
        )
        assert len(selection) > 0, (
            f"select chose nothing at step {step}: the current frame at least is always there."
        )
        assert selection[:, 0].max() <= step, (
            f"at step {step} select chose frame {selection[:, 0].max()}, which is later."
        )
        assert selection.min() >= 0 and selection[:, 1].max() < patches, (
            f"patches must lie in 0 to {patches - 1}."
        )
        assert (np.diff(selection[:, 0]) >= 0).all(), (
            f"at step {step} the selection is not in time order."
        )
        stored = set(memory.storage.stored_frames(step + 1).tolist())
        selected_frames = set() if uses_proprio(memory) else set(selection[:, 0].tolist())
        assert selected_frames <= stored, "select chose frames that the StorageSpec does not keep."
        again = memory.select(full, step)
        assert np.array_equal(selection, again), (
            "without rng, select must make the same choice every time."
        )
        short = memory.select(episode.cached(step + 1), step)
        assert np.array_equal(selection, short), (
            f"what comes after step {step} changed what select chose there."
        )
        read = memory.frames_read([step], episode.exec_start)
        assert selected_frames <= set(read.tolist()), (
            f"at step {step} select chose what frames_read lacks."
        )
        sparse = memory.select(episode.sparse(read, step + 1), step)
        assert np.array_equal(selection, sparse), (
            f"at step {step} select differs where only frames_read was rendered."
        )
    for piece in (1, 16, 23):
        history = episode.online(piece)
        offline = memory.select(full, frames - 1)
        assert np.array_equal(memory.select(history, frames - 1), offline), (
            f"with frames arriving {piece} at a time select chose otherwise than offline."
        )
    rng = np.random.default_rng(0)
    assert len(memory.select(full, frames - 1, rng)) <= memory.capacity, (
        "with rng, select chose too many tokens."
    )


@torch.no_grad()
def _encoded(memory: Memory, history: HistoryTokens) -> MemoryTokens:
    return memory(history)


def _recalled(memory: Memory, history: History, *steps: int) -> HistoryTokens:
    return stack_history([memory.gather_selection(history, step) for step in steps])


def _valid(tokens: MemoryTokens) -> Tensor:
    return tokens.tokens * tokens.mask[..., None]


def check_encoding(memory: Memory, frames: int) -> None:
    """`forward`: within budget, finite, blind to padding and to its batch, with gradients to all it
    learns.
    """
    full = Episode(memory, frames).cached()
    history = _recalled(memory, full, 2, frames - 1)  # the first with padding, if it is shorter
    encoded = _encoded(memory, history)
    shape = (2, memory.budget, WIDTH)
    assert encoded.tokens.shape == shape, (
        f"forward must return tokens {shape}; got {tuple(encoded.tokens.shape)}."
    )
    assert encoded.mask.shape == shape[:2] and encoded.mask.dtype == torch.bool, (
        "the mask must be bool [b, budget]."
    )
    assert encoded.mask.any(1).all(), "a row has no valid memory token."
    assert torch.isfinite(_valid(encoded)).all(), "a valid memory token is not finite."

    hidden = replace(
        history, features=history.features.clone(), positions=history.positions.clone()
    )
    hidden.features[~history.mask], hidden.positions[~history.mask] = 1e3, 77.0
    error = float((_valid(_encoded(memory, hidden)) - _valid(encoded)).abs().max())
    assert error <= TOLERANCE, f"what is in padding changed the memory tokens by {error:.2g}."

    alone = _encoded(memory, history.rows(slice(1, None)))
    error = float((_valid(alone)[0] - _valid(encoded)[1]).abs().max())
    assert error <= TOLERANCE, (
        f"beside another sample the same selection gives other tokens (by {error:.2g})."
    )

    changed = replace(history, features=-history.features)
    assert not torch.equal(_valid(_encoded(memory, changed)), _valid(encoded)), (
        "forward does not read the features."
    )

    was = {name: parameter.requires_grad for name, parameter in memory.named_parameters()}
    memory.requires_grad_(True)
    live = memory(history)
    (live.tokens * live.mask[..., None]).square().sum().backward()
    idle = [name for name, parameter in memory.named_parameters() if parameter.grad is None]
    memory.zero_grad(set_to_none=True)
    for name, parameter in memory.named_parameters():
        parameter.requires_grad_(was[name])
    assert not idle, f"no gradient reaches {', '.join(idle)}: remove these parameters, or use them."


@torch.no_grad()
def check_streaming(memory: Memory, frames: int) -> None:
    """`encode_histories`: an episode that grows gives the tokens of the complete one."""
    first, second = Episode(memory, frames, seed=1), Episode(memory, frames, seed=2)
    histories = [first.online(16, 16), second.online(16, 16)]
    streams = [start_stream(memory) for _ in histories]
    for until in (16, 32, 37, frames):
        for episode, history in zip((first, second), histories, strict=True):
            episode.extend(history, 16, until)
        streamed = encode_histories(memory, histories, streams)
        fresh = _encoded(
            memory,
            stack_history(
                [memory.gather_selection(history, len(history) - 1) for history in histories]
            ),
        )
        error = float((_valid(streamed) - _valid(fresh)).abs().max())
        assert error <= TOLERANCE, (
            f"after {until} frames the stream's tokens differ from a fresh look by {error:.2g}."
        )


@torch.no_grad()
def check_rebuilding(name: str, options: dict[str, Any], memory: Memory) -> None:
    """Weights saved and loaded give the same tokens, also where the memory was made on the meta
    device.
    """
    with torch.device("meta"):
        bare: Memory = MEMORIES.build({"name": name, **options}, d_vision=D_VISION, width=WIDTH)
    names, expected = set(bare.state_dict()), set(memory.state_dict())
    assert names == expected, f"made on meta it has other tensors: {sorted(names ^ expected)}."
    copy: Memory = MEMORIES.build({"name": name, **options}, d_vision=D_VISION, width=WIDTH)
    copy.load_state_dict(memory.state_dict())
    history = _recalled(memory, Episode(memory, 40).cached(), 39)
    error = float(
        (_valid(_encoded(copy.eval(), history)) - _valid(_encoded(memory, history))).abs().max()
    )
    assert error <= TOLERANCE, (
        f"with the same weights a second one gives other tokens (by {error:.2g})."
    )
