"""`check_memory`: the properties of a memory that training, streaming and the
integrations rely on.
"""

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from mme_vla.memory.base import Memory, check_scorer, stack_history
from mme_vla.memory.history import CachedHistory, History, OnlineHistory, score_frames
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
        name: the key in `MEMORIES`.
        frames: length of the episode, at least 40.
        options: the memory's own, as its YAML would give them.
    """
    memory: Memory = MEMORIES.build({"name": name, **options}, d_vision=D_VISION, width=WIDTH)
    memory.eval()
    for attribute in ("budget", "capacity", "storage"):
        assert hasattr(memory, attribute), (
            f"{type(memory).__name__} has no {attribute}: set self.{attribute} in its constructor."
        )
    check_scorer(memory)
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
    """One synthetic episode, as read from a cache and as observed frame by frame, with equal tokens
    in both.
    """

    exec_start = 20

    def __init__(self, memory: Memory, frames: int, seed: int = 0) -> None:
        self.memory = memory
        self.length = frames
        self.images = moving_frames(frames, seed=seed)
        generator = torch.Generator().manual_seed(seed)
        self.tokens = torch.randn(frames, memory.storage.grid**2, D_VISION, generator=generator)
        self.motion = torch.randn(frames, MOTION, generator=generator)

    def cached(self, length: int | None = None) -> CachedHistory:
        """The full episode, or its first `length` frames, as read from a cache."""
        if length is None:
            length = self.length
        spec = self.memory.storage
        stored = spec.stored_frames(length)
        images = dict(enumerate(self.images[:length]))
        scores = score_frames(self.memory.make_scorer(), images, spec.grid**2)
        history = CachedHistory(
            spec, self.tokens[stored].numpy(), stored, length, scores, self.exec_start
        )
        return self._with_motion(history)

    def _with_motion(self, history: _Kind) -> _Kind:
        """The history with proprioception and actions, where its memory reads them."""
        history.state_width = STATE
        if self.memory.uses_proprio:
            history.motion = self.motion.__getitem__
        return history

    def _empty(self) -> OnlineHistory:
        scorer = self.memory.make_scorer()
        return self._with_motion(OnlineHistory(self.memory.storage, scorer, self.exec_start))

    def online(self, piece: int, until: int | None = None) -> OnlineHistory:
        """The first `until` frames as an environment delivers them, `piece` at a time."""
        history = self._empty()
        self.extend(history, piece, self.length if until is None else until)
        return history

    def sparse(self, rendered: np.ndarray, until: int) -> OnlineHistory:
        """The first `until` frames, of which only some have an image."""
        history = self._empty()
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
    episode = Episode(memory, frames)
    patches = memory.storage.grid**2
    full = episode.cached()
    for step in (0, 1, 15, 16, 17, 39, frames - 1):
        selection = memory.select(full, step)
        assert isinstance(selection, np.ndarray), (
            "select must return a NumPy array of whole numbers [n, 2] of (frame, patch); at step"
            f" {step} it gave {type(selection).__name__}."
        )
        is_pairs = selection.ndim == 2 and selection.shape[1] == 2
        assert is_pairs and np.issubdtype(selection.dtype, np.integer), (
            f"select must return whole numbers [n, 2] of (frame, patch); at step {step} it gave"
            f" {selection.dtype} {selection.shape}."
        )
        assert len(selection) > 0, (
            f"select chose nothing at step {step}: the current frame at least is always there."
        )
        assert selection[:, 0].max() <= step, (
            f"at step {step} select chose frame {selection[:, 0].max()}, which is later."
        )
        assert selection.min() >= 0 and selection[:, 1].max() < patches, (
            f"patches must lie in 0 to {patches - 1}; at step {step} select chose"
            f" {selection[:, 1].min()} to {selection[:, 1].max()}, of frames from"
            f" {selection[:, 0].min()} on."
        )
        assert (np.diff(selection[:, 0]) >= 0).all(), (
            f"at step {step} the selection is not in time order."
        )
        assert len(np.unique(selection, axis=0)) == len(selection), (
            f"at step {step} select chose a patch twice."
        )
        stored = set(memory.storage.stored_frames(step + 1).tolist())
        # A memory that reads states may select frames that have no tokens.
        selected_frames = set() if memory.uses_proprio else set(selection[:, 0].tolist())
        assert selected_frames <= stored, (
            f"at step {step} select chose frames {sorted(selected_frames - stored)}, which the"
            f" StorageSpec does not keep (keep_every={memory.storage.keep_every}). Those that it"
            " keeps are history.stored_frames."
        )
        check_length(memory, full, step)
        again = memory.select(full, step)
        assert np.array_equal(selection, again), (
            "without rng, select must make the same choice every time."
        )
        short = memory.select(episode.cached(step + 1), step)
        assert np.array_equal(selection, short), (
            f"frames after step {step} changed what select chose there."
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
    check_length(memory, full, frames - 1, np.random.default_rng(0))


def check_length(
    memory: Memory, history: History, step: int, rng: np.random.Generator | None = None
) -> None:
    """A selection has at most `capacity` tokens."""
    try:
        length = len(memory.gather_selection(history, step, rng).mask)
    except ValueError as error:
        raise AssertionError(str(error)) from error
    assert length <= memory.capacity, (
        f"gather_selection returned {length} tokens; capacity is {memory.capacity}."
    )


@torch.no_grad()
def _encoded(memory: Memory, history: HistoryTokens) -> MemoryTokens:
    return memory(history)


def _valid(tokens: MemoryTokens) -> Tensor:
    return tokens.tokens * tokens.mask[..., None]


def check_encoding(memory: Memory, frames: int) -> None:
    """`forward`: within budget, finite, blind to padding and to its batch, with gradients to all it
    learns.
    """
    full = Episode(memory, frames).cached()
    selections = [memory.gather_selection(full, step) for step in (2, frames - 1)]
    history = stack_history(selections)  # the first with padding, if it is shorter
    before = {name: getattr(history, name).clone() for name in ("features", "positions", "mask")}
    encoded = _encoded(memory, history)
    assert isinstance(encoded, MemoryTokens), (
        f"forward must return MemoryTokens(tokens, mask); got {type(encoded).__name__}."
    )
    for name, values in before.items():
        assert torch.equal(getattr(history, name), values), (
            f"forward changed history.{name} in place: change a copy."
        )
    shape = (2, memory.budget, WIDTH)
    assert encoded.tokens.shape == shape, (
        f"forward must return tokens {shape}; got {tuple(encoded.tokens.shape)}."
    )
    assert encoded.mask.shape == shape[:2] and encoded.mask.dtype == torch.bool, (
        f"the mask must be bool {shape[:2]}; got {encoded.mask.dtype} {tuple(encoded.mask.shape)}."
    )
    assert encoded.ages is None or encoded.ages.shape == shape[:2], (
        f"the ages must be {shape[:2]}; got {tuple(encoded.ages.shape)}."
    )
    for name, loss in encoded.losses.items():
        assert loss.shape == shape[:1], (
            f"losses must have one number a sample, {shape[:1]}; {name} has {tuple(loss.shape)}."
        )
    assert encoded.mask.any(1).all(), "a row has no valid memory token."
    assert torch.isfinite(_valid(encoded)).all(), "a valid memory token is not finite."

    error = float((_valid(_encoded(memory, history)) - _valid(encoded)).abs().max())
    assert error <= TOLERANCE, (
        f"the same selection gave other tokens the second time (by {error:.2g}). A state belongs"
        " to `start_stream` and `encode`, not to `self`."
    )

    padded = replace(
        history, features=history.features.clone(), positions=history.positions.clone()
    )
    padded.features[~history.mask] = 1e3
    padded.positions[~history.mask] = 77.0
    error = float((_valid(_encoded(memory, padded)) - _valid(encoded)).abs().max())
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

    trainable = {name: parameter.requires_grad for name, parameter in memory.named_parameters()}
    memory.requires_grad_(True)
    _valid(memory(history)).square().sum().backward()
    unused = [name for name, parameter in memory.named_parameters() if parameter.grad is None]
    memory.zero_grad(set_to_none=True)
    for name, parameter in memory.named_parameters():
        parameter.requires_grad_(trainable[name])
    assert not unused, (
        f"no gradient reaches {', '.join(unused)}: remove these parameters, or use them."
    )


@torch.no_grad()
def check_streaming(memory: Memory, frames: int) -> None:
    """`encode`: an episode that grows gives the tokens of the complete one."""
    first, second = Episode(memory, frames, seed=1), Episode(memory, frames, seed=2)
    histories = [first.online(16, 16), second.online(16, 16)]
    streams = [memory.start_stream() for _ in histories]
    for until in (16, 32, 37, frames):
        for episode, history in zip((first, second), histories, strict=True):
            episode.extend(history, 16, until)
        streamed = memory.encode(histories, streams)
        selections = [memory.gather_selection(history, len(history) - 1) for history in histories]
        fresh = _encoded(memory, stack_history(selections))
        error = float((_valid(streamed) - _valid(fresh)).abs().max())
        assert error <= TOLERANCE, (
            f"after {until} frames the stream's tokens differ from `forward`'s by {error:.2g}."
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
    history = stack_history([memory.gather_selection(Episode(memory, 40).cached(), 39)])
    again, first = _encoded(copy.eval(), history), _encoded(memory, history)
    error = float((_valid(again) - _valid(first)).abs().max())
    assert error <= TOLERANCE, (
        f"with the same weights a second one gives other tokens (by {error:.2g})."
    )
