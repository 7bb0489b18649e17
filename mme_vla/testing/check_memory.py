"""`check_memory`: the properties of a memory that training, streaming and the
integrations rely on.
"""

from copy import deepcopy
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from mme_vla.memory.base import Memory, check_scorer, stack_history
from mme_vla.memory.history import CachedHistory, History, OnlineHistory, score_frames
from mme_vla.registry import MEMORIES
from mme_vla.testing.small import moving_frames
from mme_vla.types import FrameBatch, HistoryTokens, Labels, MemoryTokens, ReadsLabels

D_VISION, WIDTH, MOTION, STATE = 32, 48, 17, 8
TOLERANCE = 1e-4
ROUNDING = 0.1
"""How much bfloat16 features may change tokens, as a share of the largest."""
LABELS = {"subtask_boundary", "subtask_index", "fact_visible", "fact_index"}
"""Labels of one number a frame in any dataset."""


def check_memory(name: str, frames: int = 80, **options: Any) -> None:
    """Run every check on the memory that is registered under `name`, and print a line for each that
    passed.

    The episode is synthetic: `frames` images in which a square moves, the first 20 of them a
    conditioning video.

    Args:
        name: the key in `MEMORIES`.
        frames: length of the episode, at least 40.
        options: the memory's own, as its YAML would give them.
    """
    memory = _built(name, options, seed=0)
    for attribute in ("budget", "capacity", "storage"):
        assert hasattr(memory, attribute), (
            f"{type(memory).__name__} has no {attribute}: set self.{attribute} in its constructor."
        )
    check_scorer(memory)
    fresh = _built(name, options, seed=1)
    fresh.load_state_dict(memory.state_dict())
    check_selection(memory, fresh, frames)
    print(
        f"{name}: select stays in bounds, ignores later frames, repeats, and agrees offline and"
        " online"
    )
    check_encoding(memory, frames)
    check_training(_built(name, options, seed=0), frames)
    print(
        f"{name}: forward hands over at most {memory.budget} finite tokens, ignores padding, and"
        " trains"
    )
    for dtype in (torch.float32, torch.bfloat16):
        check_streaming(memory, fresh, frames, dtype)
    print(f"{name}: streaming gives the same tokens as the full history")
    check_rebuilding(name, options, memory)
    print(f"{name}: saved weights give the same tokens when they are loaded")


def _built(name: str, options: dict[str, Any], seed: int) -> Memory:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        memory: Memory = MEMORIES.build({"name": name, **options}, d_vision=D_VISION, width=WIDTH)
    return memory.eval()


class Episode:
    """One synthetic episode, as read from a cache and as observed frame by frame, with equal tokens
    in both.
    """

    exec_start = 20

    def __init__(
        self, memory: Memory, frames: int, seed: int = 0, dtype: torch.dtype = torch.float32
    ) -> None:
        self.memory = memory
        self.length = frames
        self.images = moving_frames(frames, seed=seed)
        generator = torch.Generator().manual_seed(seed)
        tokens = torch.randn(frames, memory.storage.grid**2, D_VISION, generator=generator)
        self.tokens = tokens.to(dtype)
        self.motion = torch.randn(frames, MOTION, generator=generator)

    def cached(self, length: int | None = None) -> CachedHistory:
        """The full episode, or its first `length` frames, as read from a cache."""
        if length is None:
            length = self.length
        spec = self.memory.storage
        stored = spec.stored_frames(length)
        images = dict(enumerate(self.images[:length]))
        scores = score_frames(self.memory.make_scorer(), images, spec.grid**2)
        tokens = self.tokens[stored]
        if tokens.dtype == torch.bfloat16:
            tokens = tokens.view(torch.uint16)
        history = CachedHistory(spec, tokens.numpy(), stored, length, scores, self.exec_start)
        return self._with_motion(history)

    def _with_motion[H: History](self, history: H) -> H:
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
        self._deliver(history, FrameBatch.of(self.images[rendered], rendered, until))
        return history

    def extend(self, history: OnlineHistory, piece: int, until: int) -> None:
        """Deliver the frames that a history lacks, up to `until`."""
        for start in range(len(history), until, piece):
            stop = min(start + piece, until)
            self._deliver(history, FrameBatch.of(self.images[start:stop]))

    def _deliver(self, history: OnlineHistory, frames: FrameBatch) -> None:
        """Add the next frames with their tokens."""
        stored = len(history) + history.to_encode(frames.length, frames.index)
        history.take(frames, lambda _: self.tokens[stored])


def check_selection(memory: Memory, fresh: Memory, frames: int) -> None:
    """`select`: in bounds, in time order, blind to the future, repeatable, the same offline and
    online, with `rng` as without.

    Args:
        fresh: a second memory with the same weights.
    """
    episode = Episode(memory, frames)
    full = episode.cached()
    steps = (0, 1, 15, 16, 17, 39, frames - 1)
    for step in steps:
        start = episode.cached(step + 1)
        for seed in (None, step):
            selection = select_frames(memory, full, step, seed)
            again = select_frames(memory, full, step, seed)
            assert np.array_equal(selection, again), (
                "without rng, select must make the same choice every time."
                if seed is None
                else f"at step {step} two equal rng gave two choices: draw from rng alone."
            )
            short = select_frames(memory, start, step, seed)
            assert np.array_equal(selection, short), (
                f"frames after step {step} changed what select chose there."
            )
        selection = select_frames(memory, full, step)
        read = memory.frames_read([step], episode.exec_start)
        # A memory that reads states may select frames that have no tokens.
        selected_frames = set() if memory.uses_proprio else set(selection[:, 0].tolist())
        assert selected_frames <= set(read.tolist()), (
            f"at step {step} select chose what frames_read lacks."
        )
        sparse = select_frames(memory, episode.sparse(read, step + 1), step)
        assert np.array_equal(selection, sparse), (
            f"at step {step} select differs where only frames_read was rendered."
        )
    for piece in (1, 16, 23):
        history = episode.online(piece)
        offline = select_frames(memory, full, frames - 1)
        assert np.array_equal(select_frames(memory, history, frames - 1), offline), (
            f"with frames arriving {piece} at a time select chose otherwise than offline."
        )
    episode = Episode(memory, frames, seed=1)
    episode.exec_start = 8
    episode.images = episode.images[::-1]  # the square moves on another path
    second = episode.cached()
    for step in steps:
        expected = select_frames(fresh, second, step)
        assert np.array_equal(select_frames(memory, second, step), expected), (
            f"in a second episode select chose otherwise at step {step} than a memory that saw no"
            " other episode: choose from `history` at every call, and keep nothing on `self`."
        )


def select_frames(
    memory: Memory, history: History, step: int, seed: int | None = None
) -> np.ndarray:
    """A copy of a selection that keeps the rules by itself; `seed` is that of `rng`."""
    where = f"at step {step}" if seed is None else f"with rng, at step {step}"
    patches = memory.storage.grid**2
    before = deepcopy(history.scores)
    selection = memory.select(history, step, _rng(seed))
    scores = history.scores
    assert np.array_equal(scores.frames, before.frames) and np.array_equal(
        scores.values, before.values
    ), f"{where} select changed history.scores in place: change a copy."
    assert isinstance(selection, np.ndarray), (
        f"select must return a NumPy array of whole numbers [n, 2] of (frame, patch); {where} it"
        f" gave {type(selection).__name__}."
    )
    dtype = selection.dtype
    is_pairs = selection.ndim == 2 and selection.shape[1] == 2
    assert is_pairs and np.issubdtype(dtype, np.integer), (
        f"select must return whole numbers [n, 2] of (frame, patch); {where} it gave {dtype}"
        f" {selection.shape}."
    )
    assert np.issubdtype(dtype, np.signedinteger) and dtype.itemsize >= 4, (
        f"select must return int64; {where} it gave {dtype}, which cannot count the frames of long"
        " episodes or is no index: return selection.astype(np.int64)."
    )
    assert len(selection) > 0, (
        f"select chose nothing {where}: the current frame at least is always there."
    )
    assert selection[:, 0].max() <= step, (
        f"{where} select chose frame {selection[:, 0].max()}, which is later."
    )
    assert selection.min() >= 0 and selection[:, 1].max() < patches, (
        f"patches must lie in 0 to {patches - 1}; {where} select chose {selection[:, 1].min()} to"
        f" {selection[:, 1].max()}, of frames from {selection[:, 0].min()} on."
    )
    assert (np.diff(selection[:, 0]) >= 0).all(), f"{where} the selection is not in time order."
    assert len(np.unique(selection, axis=0)) == len(selection), (
        f"{where} select chose a patch twice."
    )
    if not memory.uses_proprio:
        missing = set(selection[:, 0].tolist()) - set(
            memory.storage.stored_frames(step + 1).tolist()
        )
        assert not missing, (
            f"{where} select chose frames {sorted(missing)}, which the StorageSpec does not keep"
            f" (keep_every={memory.storage.keep_every}). Those that it keeps are"
            " history.stored_frames."
        )
    selection = selection.copy()  # `select` may fill one array again and again
    try:
        memory.gather_selection(history, step, _rng(seed))
    except ValueError as error:  # more than `capacity`
        raise AssertionError(str(error)) from error
    return selection


def _rng(seed: int | None) -> np.random.Generator | None:
    return None if seed is None else np.random.default_rng(seed)


@torch.no_grad()
def encode_history(memory: Memory, history: HistoryTokens) -> MemoryTokens:
    """What `forward` returns, in the right form."""
    before = deepcopy(history)
    encoded = memory(history)
    for field in fields(history):
        expected, value = getattr(before, field.name), getattr(history, field.name)
        if not isinstance(value, dict):
            expected, value = {field.name: expected}, {field.name: value}
        assert all(torch.equal(value[name], expected[name]) for name in expected), (
            f"forward changed history.{field.name} in place: change a copy."
        )
    check_form(memory, encoded, len(history.mask))
    return encoded


def check_form(memory: Memory, encoded: MemoryTokens, batch: int) -> None:
    """Shapes, dtypes and finite numbers."""
    assert isinstance(encoded, MemoryTokens), (
        f"forward must return MemoryTokens(tokens, mask); got {type(encoded).__name__}."
    )
    shape = (batch, memory.budget, WIDTH)
    assert encoded.tokens.shape == shape, (
        f"forward must return tokens {shape}; got {tuple(encoded.tokens.shape)}."
    )
    assert encoded.tokens.dtype == torch.float32, (
        f"tokens must be of the weights' dtype, float32; got {encoded.tokens.dtype}."
    )
    assert encoded.mask.any(1).all(), "a row has no valid memory token."
    assert torch.isfinite(encoded.tokens[encoded.mask]).all(), "a valid memory token is not finite."
    assert encoded.ages is None or encoded.ages.shape == shape[:2], (
        f"the ages must be {shape[:2]}; got {tuple(encoded.ages.shape)}."
    )
    assert encoded.ages is None or torch.isfinite(encoded.ages[encoded.mask]).all(), (
        "the age of a valid memory token is not finite."
    )
    for name, loss in encoded.losses.items():
        assert loss.shape == shape[:1], (
            f"losses must have one number a sample, {shape[:1]}; {name} has {tuple(loss.shape)}."
        )
        assert torch.isfinite(loss).all(), f"the loss {name} is not finite: {loss.tolist()}."
        assert name != "action", "the loss of the actions is logged as `action`: rename yours."


def difference(first: MemoryTokens, second: MemoryTokens, rounding: float = 0) -> str:
    """What differs between two encodings of one selection; empty where nothing does.

    Args:
        rounding: what tokens may differ by, as a share of the largest.
    """
    mask = first.mask
    if not torch.equal(mask, second.mask):
        return "another mask"
    error = float((first.tokens - second.tokens)[mask].abs().max())
    if error > TOLERANCE + rounding * float(first.tokens[mask].abs().max()):
        return f"other tokens (by {error:.2g})"
    if first.ages is None and second.ages is None:
        return ""
    if first.ages is None or second.ages is None:
        return "ages only once"
    if not torch.allclose(first.ages[mask].float(), second.ages[mask].float(), atol=TOLERANCE):
        return "other ages"
    return ""


def encoded_steps(memory: Memory, frames: int) -> HistoryTokens:
    """An early and a late selection of one episode; the first has padding, if it is shorter."""
    full = Episode(memory, frames).cached()
    return stack_history([memory.gather_selection(full, step) for step in (2, frames - 1)])


def check_encoding(memory: Memory, frames: int) -> None:
    """`forward`: within budget, finite, blind to padding and to its batch, of features of either
    dtype; true ages.
    """
    history = encoded_steps(memory, frames)
    encoded = encode_history(memory, history)
    other = difference(encoded, encode_history(memory, history))
    assert not other, (
        f"the same selection gave {other} the second time. A state belongs to `start_stream` and"
        " `encode`, not to `self`."
    )
    check_rows(memory, history, encoded)
    changed = encode_history(memory, replace(history, features=-history.features))
    assert not torch.equal(changed.tokens[encoded.mask], encoded.tokens[encoded.mask]), (
        "forward does not read the features."
    )
    if memory.timed:
        check_ages(memory, history.rows(slice(1, None)))
    if not memory.uses_proprio:  # states and actions stay float32
        check_stored_dtype(memory, history)


def check_rows(memory: Memory, history: HistoryTokens, encoded: MemoryTokens) -> None:
    """Neither padding nor the other rows of a batch change what a row is encoded into."""
    mode = "in training mode, " if memory.training else ""
    cases = []
    for row in range(len(history.mask)):
        rows = slice(row, row + 1)
        how = "beside another sample", "compute each row of a batch by itself, without batch means"
        cases.append((rows, history.rows(rows), *how))
    padded = replace(
        history, features=history.features.clone(), positions=history.positions.clone()
    )
    padded.features[~history.mask] = 1e3
    padded.positions[~history.mask] = 77.0
    how = "with other numbers in its padding", "leave out what history.mask marks False"
    cases.append((slice(None), padded, *how))
    for rows, changed, condition, advice in cases:
        again = encode_history(memory, changed)
        other = difference(encoded.rows(rows), again)
        for name, loss in encoded.losses.items():
            if not torch.allclose(loss[rows], again.losses[name], atol=TOLERANCE):
                other = f"another loss {name}"
        assert not other, f"{mode}{condition} the same selection gives {other}: {advice}."


def check_ages(memory: Memory, history: HistoryTokens) -> None:
    """Of a timed memory: ages are those of the frames that tokens were made of.

    Args:
        history: one row.
    """
    encoded = encode_history(memory, history)
    assert encoded.ages is not None, (
        "timed is True and forward gives no ages: return MemoryTokens(tokens, mask, ages=…), made"
        " of history.ages."
    )
    assert history.ages is not None
    ages = encoded.ages[encoded.mask]
    selected = history.ages[history.mask]
    newest, oldest = ages.min(), ages.max()
    is_between = newest >= selected.min() - TOLERANCE and oldest <= selected.max() + TOLERANCE
    assert is_between, (
        f"ages must lie in {selected.min():g} to {selected.max():g}, those of the selected frames;"
        f" got {newest:g} to {oldest:g}."
    )
    # Another newest frame changes the tokens of that age, before it changes those of older frames.
    is_newest = (history.ages == newest) & history.mask
    changed = torch.where(is_newest[..., None], -history.features, history.features)
    other = encode_history(memory, replace(history, features=changed))
    is_same = (other.tokens == encoded.tokens).all(-1)[encoded.mask]
    assert (
        newest == oldest
        or not is_newest.any()
        or not is_same[ages == newest].all()
        or is_same[ages == oldest].all()
    ), (
        f"the frame of age {newest:g} changes the token of age {oldest:g} and not its own: the ages"
        " are in another order than the tokens."
    )


def check_stored_dtype(memory: Memory, history: HistoryTokens) -> None:
    """Features of bfloat16, as a policy stores them by default, give the tokens of float32 ones."""
    stored = replace(history, features=history.features.bfloat16())
    advice = (
        "with bfloat16 features, as a policy stores them (policy.history_dtype), {}. Cast them to"
        " the dtype of your weights: history.features.to(self.project.weight.dtype)."
    )
    try:
        encoded = encode_history(memory, stored)
    except Exception as error:
        raise AssertionError(advice.format(f"forward fails: {error}")) from error
    exact = encode_history(memory, replace(stored, features=stored.features.float()))
    other = difference(exact, encoded, ROUNDING)
    assert not other, advice.format(f"forward gives {other} than with float32 ones")


def check_training(memory: Memory, frames: int) -> None:
    """In training mode: rows are independent, and what it learns gets gradients."""
    with torch.no_grad():
        generator = torch.Generator().manual_seed(1)
        for parameter in memory.parameters():
            # Where it starts at zero, no gradient passes.
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    memory.train().requires_grad_(True)
    history = encoded_steps(memory, frames)
    names = memory.reads_labels if isinstance(memory, ReadsLabels) else ()
    if LABELS.issuperset(names):
        is_late = (history.positions[..., 0] >= 20) & history.mask
        history = replace(history, labels=Labels({name: is_late.float() for name in names}))
    encoded = encode_history(memory, history)
    # A memory may draw numbers in training, as dropout does.
    if not difference(encoded, encode_history(memory, history)):
        check_rows(memory, history, encoded)

    tokens = memory(history)
    weights = torch.randn(tokens.tokens.shape, generator=generator)
    total = (tokens.tokens * weights)[tokens.mask].sum()
    for loss in tokens.losses.values():
        total = total + loss.sum()
    if total.requires_grad:
        total.backward()
    unused = []
    for name, parameter in memory.named_parameters():
        # A bias that a normalisation subtracts again has a gradient of 0.
        is_bias = name.endswith("bias")
        if parameter.grad is None or not (is_bias or parameter.grad.any()):
            unused.append(name)
    assert not unused, (
        f"no gradient reaches {', '.join(unused)}: remove these parameters, or use them without"
        f" detach(). If they need more than {frames} frames, check a longer episode (frames=…)."
    )


@torch.no_grad()
def check_streaming(memory: Memory, fresh: Memory, frames: int, dtype: torch.dtype) -> None:
    """`encode`: an episode that grows gives the tokens of the complete one, whatever `prepare` did.

    Args:
        fresh: a second memory with the same weights.
        dtype: of the stored tokens.
    """
    rounding = 0 if dtype == torch.float32 else ROUNDING
    episodes = [Episode(memory, frames, seed=seed, dtype=dtype) for seed in (1, 2)]
    complete = [episode.cached() for episode in episodes]
    histories = [episode.online(16, 5) for episode in episodes]
    streams = [memory.start_stream() for _ in histories]
    for until in (5, 16, 32, 37, frames):
        for episode, history in zip(episodes, histories, strict=True):
            episode.extend(history, 16, until)
        streamed = memory.encode(histories, streams)
        check_form(memory, streamed, len(histories))
        selections = [fresh.gather_selection(history, until - 1) for history in complete]
        other = difference(encode_history(fresh, stack_history(selections)), streamed, rounding)
        assert not other, (
            f"after {until} frames of {dtype} `encode` gives {other} than `forward` does for a"
            " memory without a stream."
        )
        for history, stream in zip(histories, streams, strict=True):
            limit = frames + memory.capacity
            while limit and memory.prepare(history, stream):
                limit -= 1
            assert limit, (
                "prepare returns True without end: return whether work is left for the next"
                " decision."
            )
    single = memory.encode(histories[1:], [memory.start_stream()])
    check_form(memory, single, 1)
    other = difference(streamed.rows(slice(1, None)), single, rounding)
    assert not other, f"one episode encoded by itself gives {other} than beside another."


@torch.no_grad()
def check_rebuilding(name: str, options: dict[str, Any], memory: Memory) -> None:
    """Weights saved and loaded give the same tokens, also where the memory was made on the meta
    device.
    """
    with torch.device("meta"):
        bare: Memory = MEMORIES.build({"name": name, **options}, d_vision=D_VISION, width=WIDTH)
    names, expected = set(bare.state_dict()), set(memory.state_dict())
    assert names == expected, f"made on meta it has other tensors: {sorted(names ^ expected)}."
    copy = _built(name, options, seed=2)
    copy.load_state_dict(memory.state_dict())
    history = stack_history([memory.gather_selection(Episode(memory, 40).cached(), 39)])
    other = difference(encode_history(memory, history), encode_history(copy, history))
    assert not other, f"with the same weights a second one gives {other}."
