"""Reading a history without an episode: indices of any integers, and mistakes by name."""

from typing import Any

import numpy as np
import pytest
import torch

from mme_vla import UserError
from mme_vla.memory.base import MemoryModule, stack_history
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.memory.history import (
    CachedHistory,
    History,
    LazyHistory,
    OnlineHistory,
    StorageSpec,
    score_frames,
)
from mme_vla.memory.tokendrop import TokenDrop
from mme_vla.types import FrameBatch

SPEC = StorageSpec(2)
FRAMES = 10
TOKENS = torch.randn(FRAMES, 4, 8, generator=torch.Generator().manual_seed(0))
IMAGES = np.random.default_rng(0).integers(0, 256, (FRAMES, 8, 8, 3), dtype=np.uint8)
PAIRS = np.array([[0, 1], [0, 3], [3, 0], [9, 2]])


def history_of(kind: str) -> History:
    if kind == "cached":
        return CachedHistory(SPEC, TOKENS.numpy(), np.arange(FRAMES), FRAMES)
    if kind == "lazy":
        numbers = np.arange(FRAMES, dtype=np.uint8)[:, None, None, None]
        lazy = LazyHistory(SPEC, lambda images: TOKENS[images[:, 0, 0, 0].astype(np.int64)])
        lazy.take(FrameBatch.of(np.tile(numbers, (1, 8, 8, 3))), lambda images: TOKENS)
        return lazy
    online = OnlineHistory(SPEC)
    online.take(FrameBatch.of(IMAGES), lambda images: TOKENS)
    return online


KINDS = ["cached", "online", "lazy"]


@pytest.mark.parametrize("kind", KINDS)
def test_indices_of_any_integers_read_the_same_tokens(kind: str) -> None:
    history = history_of(kind)
    expected = TOKENS[PAIRS[:, 0], PAIRS[:, 1]]
    for dtype in (np.int64, np.int32, np.uint8, np.uint64):
        assert torch.equal(history.gather(PAIRS.astype(dtype)), expected), dtype
    same: list[Any] = [PAIRS.tolist(), torch.from_numpy(PAIRS), torch.from_numpy(PAIRS).byte()]
    for indices in same:
        assert torch.equal(history.gather(indices), expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "indices",
    [PAIRS.T, PAIRS[:, 0], PAIRS.astype(np.float32), PAIRS > 0, [[0, 4]], [[0, -1]]],
    ids=["transposed", "frames", "floats", "bool", "patch behind the last", "patch -1"],
)
def test_other_indices_are_refused_with_what_is_read(kind: str, indices: Any) -> None:
    with pytest.raises(UserError, match=r"whole numbers \[n, 2\], each row a frame and a patch"):
        history_of(kind).gather(indices)


def test_a_cache_may_hold_a_tensor_of_bfloat16() -> None:
    history = CachedHistory(SPEC, TOKENS.bfloat16(), np.arange(FRAMES), FRAMES)  # type: ignore[arg-type]
    bits = TOKENS.bfloat16().view(torch.uint16).numpy()
    stored = CachedHistory(SPEC, bits, np.arange(FRAMES), FRAMES)
    assert torch.equal(history.gather(PAIRS), stored.gather(PAIRS))


@pytest.mark.parametrize("step", [-1, FRAMES, FRAMES + 5])
@pytest.mark.parametrize("kind", KINDS)
def test_a_step_outside_of_the_history_is_refused(kind: str, step: int) -> None:
    memory = FrameSamp(8, 4, budget=8, grid=2)
    with pytest.raises(UserError, match=f"step={step} must be 0 or more and less than 10"):
        memory.gather_selection(history_of(kind), step)


def test_a_selection_of_any_integers_is_gathered() -> None:
    class Listed(FrameSamp):
        def select(self, *arguments: Any) -> Any:
            return super().select(*arguments).astype(np.uint8).tolist()

    expected = FrameSamp(8, 4, budget=8, grid=2).gather_selection(history_of("online"), 9)
    selection = Listed(8, 4, budget=8, grid=2).gather_selection(history_of("online"), 9)
    assert torch.equal(selection.features, expected.features)
    assert torch.equal(selection.positions, expected.positions)


def test_a_selection_is_encoded_with_and_without_a_batch() -> None:
    memory = FrameSamp(8, 4, budget=8, grid=2)
    selection = memory.gather_selection(history_of("online"), 9)
    single, batched = memory(selection), memory(stack_history([selection]))
    torch.testing.assert_close(single.tokens, batched.tokens[0])
    assert torch.equal(single.ages, batched.ages[0])


@pytest.mark.parametrize("spec", [StorageSpec(4), StorageSpec(2, "max")])
def test_a_history_of_another_grid_or_pooling_is_refused(spec: StorageSpec) -> None:
    tokens = np.zeros((FRAMES, spec.grid**2, 8), np.float32)
    history = CachedHistory(spec, tokens, np.arange(FRAMES), FRAMES)
    with pytest.raises(UserError, match=r"FrameSamp reads frames stored as .*grid=2.*'mean'"):
        FrameSamp(8, 4, budget=8, grid=2).gather_selection(history, 3)


def test_tokens_of_another_grid_are_not_taken() -> None:
    with pytest.raises(ValueError, match=r"returned tokens \[10, 16, 8\], expected \[10, 4, d\]"):
        OnlineHistory(SPEC).take(FrameBatch.of(IMAGES), lambda images: torch.zeros(FRAMES, 16, 8))


def test_a_memory_that_chooses_by_scores_gets_no_history_without() -> None:
    memory: MemoryModule = TokenDrop(8, 4, budget=8, grid=2, stride=2)
    message = r"chooses by scores of frames \(change2x2-every2\).*memory.make_scorer\(\)"
    with pytest.raises(UserError, match=message):
        OnlineHistory(memory.storage)
    stored = memory.storage.stored_frames(FRAMES)
    with pytest.raises(UserError, match=message):
        CachedHistory(memory.storage, TOKENS[stored].numpy(), stored, FRAMES)
    online = OnlineHistory(memory.storage, memory.make_scorer())
    online.take(FrameBatch.of(IMAGES), lambda images: TOKENS[stored])
    scores = score_frames(memory.make_scorer(), dict(enumerate(IMAGES)), 4)
    cached = CachedHistory(memory.storage, TOKENS[stored].numpy(), stored, FRAMES, scores)
    for history in (online, cached):
        assert memory.gather_selection(history, 9).mask.sum() == 8


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("selected", "words"),
    [
        ([[5, 0]], r"FrameSamp\.select returned frame 5 at step 4; expected none later"),
        ([[0, 0]] * 5, r"FrameSamp\.select returned 5 tokens; at most 4, its capacity"),
        (None, r"whole numbers \[n, 2\], each row a frame and a patch .* got object \[\]: None"),
    ],
)
def test_a_selection_is_of_frames_until_the_step_and_fits_the_capacity(
    kind: str, selected: Any, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = FrameSamp(8, 8, budget=4, grid=2)
    monkeypatch.setattr(memory, "select", lambda history, step, rng=None: selected)
    with pytest.raises(UserError, match=words):
        memory.gather_selection(history_of(kind), 4)
