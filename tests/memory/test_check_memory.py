"""`check_memory` finds each of these mistakes, and names what is wrong."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from mme_vla.memory.base import MemoryModule, PerceptualMemory, encode_selection, stack_history
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.memory.history import History
from mme_vla.memory.tokendrop import TokenDrop
from mme_vla.registry import MEMORIES
from mme_vla.testing import check_memory
from mme_vla.types import HistoryTokens, MemoryTokens

Change = Callable[[Any, HistoryTokens, MemoryTokens], MemoryTokens]


def encoded_by(change: Change) -> dict[str, Any]:
    """A `forward` that changes what FrameSamp returns."""

    def forward(self: PerceptualMemory, history: HistoryTokens) -> MemoryTokens:
        return change(self, history, PerceptualMemory.forward(self, history))

    return {"forward": forward}


def selected_by(
    change: Callable[..., np.ndarray], kind: type[MemoryModule] = FrameSamp
) -> dict[str, Any]:
    """A `select` that changes what a memory of the library chooses."""

    def select(
        self: Any, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        return change(self, history, step, rng, kind.select(self, history, step, None))

    return {"select": select}


def streamed_by(change: Callable[[MemoryTokens], MemoryTokens]) -> dict[str, Any]:
    """An `encode` that changes what `forward` gives."""

    def encode(self: MemoryModule, histories: list[History], streams: list[Any]) -> MemoryTokens:
        selections = [self.gather_selection(history, len(history) - 1) for history in histories]
        return change(encode_selection(self, stack_history(selections)))

    return {"encode": encode}


def with_second_row(memory: Any, history: HistoryTokens, tokens: MemoryTokens) -> MemoryTokens:
    values = tokens.tokens.clone()
    if len(values) > 1:
        values[0] += values[1]
    return replace(tokens, tokens=values)


def without_batch_mean(memory: Any, history: HistoryTokens, tokens: MemoryTokens) -> MemoryTokens:
    if not memory.training:
        return tokens
    return replace(tokens, tokens=tokens.tokens - tokens.tokens.mean(0))


def next_step(memory: Any, history: HistoryTokens, tokens: MemoryTokens) -> MemoryTokens:
    assert history.step is not None
    history.step += 1
    return tokens


def idle_weights(memory: Any, history: HistoryTokens, tokens: MemoryTokens) -> MemoryTokens:
    weights = sum(parameter.sum() for parameter in memory.parameters())
    return replace(tokens, tokens=tokens.tokens.detach() + 0 * weights)


def unlike_float32(dtype: torch.dtype) -> Change:
    return lambda memory, history, tokens: replace(tokens, tokens=tokens.tokens.to(dtype))


def zero_of_bfloat16(memory: Any, history: HistoryTokens, tokens: MemoryTokens) -> MemoryTokens:
    is_float32 = history.features.dtype == torch.float32
    return replace(tokens, tokens=tokens.tokens * is_float32)


def refuse_bfloat16(memory: Any, history: HistoryTokens, tokens: MemoryTokens) -> MemoryTokens:
    assert history.features.dtype == torch.float32
    return tokens


def losing(loss: Callable[[HistoryTokens], torch.Tensor], name: str = "write") -> dict[str, Any]:
    return encoded_by(
        lambda memory, history, tokens: replace(
            tokens, losses={name: loss(history)} if memory.training else {}
        )
    )


def aged(change: Callable[[torch.Tensor], torch.Tensor | None]) -> dict[str, Any]:
    return encoded_by(
        lambda memory, history, tokens: replace(tokens, ages=change(tokens.ages))  # type: ignore[arg-type]
    )


def of_first_episode(
    memory: Any, history: Any, step: int, rng: Any, selection: np.ndarray
) -> np.ndarray:
    return memory.__dict__.setdefault("choices", {}).setdefault(step, selection)


def reused_buffer_of_the_future(
    memory: Any, history: History, step: int, rng: Any, selection: np.ndarray
) -> np.ndarray:
    buffer = memory.__dict__.setdefault("buffer", np.zeros((1, 2), np.int64))
    buffer[0] = min(len(history) - 1, step) - len(history) % 2, 0
    return np.maximum(buffer, 0, out=buffer)


def halved(memory: Any, history: History, step: int, rng: Any, selection: np.ndarray) -> np.ndarray:
    history.scores.until(step).values[:] *= 0.5
    return selection


def random_rows(
    memory: Any, history: Any, step: int, rng: Any, selection: np.ndarray
) -> np.ndarray:
    if rng is None:
        return selection
    return selection[np.sort(np.random.permutation(len(selection))[: -(-len(selection) // 2)])]


def drift(memory: Any, history: History, stream: Any) -> bool:
    with torch.no_grad():
        memory.encoder.project.bias += 0.1
    return False


class BatchNormed(FrameSamp):
    def __init__(self, d_vision: int, width: int, **options: Any) -> None:
        super().__init__(d_vision, width, **options)
        self.norm = nn.BatchNorm1d(width)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        tokens = super().forward(history)
        return replace(tokens, tokens=self.norm(tokens.tokens.mT).mT)


MISTAKES: dict[str, tuple[Any, str]] = {
    "row 0 has row 1's tokens": (encoded_by(with_second_row), "^beside another sample .* other"),
    "choices of the first episode": (
        {"selected_frames": None, **selected_by(of_first_episode, TokenDrop)},
        "in a second episode select chose otherwise",
    ),
    "a later frame with rng": (
        selected_by(lambda m, h, step, rng, selection: selection + np.array([rng is not None, 0])),
        "with rng, at step 0 select chose frame 1, which is later",
    ),
    "unsorted with rng": (
        selected_by(
            lambda m, h, step, rng, selection: selection if rng is None else selection[::-1]
        ),
        "with rng, at step 1 the selection is not in time order",
    ),
    "global random numbers": (selected_by(random_rows), "draw from rng alone"),
    "prepare changes tokens": ({"prepare": drift}, "`encode` gives other tokens"),
    "prepare without end": (
        {"prepare": lambda memory, history, stream: True},
        "prepare returns True without end",
    ),
    "a mask of its own in encode": (
        streamed_by(
            lambda tokens: MemoryTokens(
                tokens.tokens * tokens.mask[..., None],
                torch.ones_like(tokens.mask),
                {},
                tokens.ages,
            )
        ),
        "`encode` gives another mask",
    ),
    "other ages in encode": (
        streamed_by(lambda tokens: replace(tokens, ages=tokens.ages + 1)),  # type: ignore[operator,arg-type]
        "`encode` gives other ages",
    ),
    "no batch axis in encode": (
        streamed_by(
            lambda tokens: (
                MemoryTokens(tokens.tokens[0], tokens.mask[0]) if len(tokens.mask) == 1 else tokens
            )
        ),
        "must return tokens",
    ),
    "no batch axis": (
        encoded_by(
            lambda memory, history, tokens: (
                tokens if len(tokens.mask) > 1 else MemoryTokens(tokens.tokens[0], tokens.mask[0])
            )
        ),
        "must return tokens",
    ),
    "no ages": (aged(lambda ages: None), "timed is True and forward gives no ages"),
    "ages not finite": (aged(lambda ages: ages * torch.nan), "age .* is not finite"),
    "negated ages": (aged(lambda ages: -ages), "ages must lie in 0 to"),
    "reversed ages": (
        encoded_by(
            lambda memory, history, tokens: replace(
                tokens,
                ages=(history.step[:, None] - tokens.ages) * tokens.mask,  # type: ignore[index,operator]
            )
        ),
        "ages are in another order",
    ),
    "step changed": (encoded_by(next_step), "forward changed history.step in place"),
    "scores changed": (selected_by(halved, TokenDrop), "changed history.scores in place"),
    "weights without gradients": (encoded_by(idle_weights), "no gradient reaches"),
    "tokens detached": (
        encoded_by(lambda m, h, tokens: replace(tokens, tokens=tokens.tokens.detach())),
        "no gradient reaches",
    ),
    "batch mean in training": (
        encoded_by(without_batch_mean),
        "in training mode, beside another sample",
    ),
    "batch norm": (BatchNormed, "in training mode, beside"),
    "loss not finite": (
        losing(lambda history: history.features.sum((1, 2)) * torch.nan),
        "the loss write is not finite",
    ),
    "loss of padding": (
        losing(lambda history: history.features.mean((1, 2))),
        "other numbers in its padding .* another loss write",
    ),
    "loss named action": (
        losing(lambda history: history.mask.sum(1).float(), "action"),
        "logged as `action`",
    ),
    "one buffer": (selected_by(reused_buffer_of_the_future), "frames after step .* changed"),
    "fails on bfloat16": (encoded_by(refuse_bfloat16), "with bfloat16 features.*forward fails"),
    "zero on bfloat16": (encoded_by(zero_of_bfloat16), "with bfloat16 features.*other tokens"),
    "float16 tokens": (encoded_by(unlike_float32(torch.float16)), "got torch.float16"),
    "float64 tokens": (encoded_by(unlike_float32(torch.float64)), "got torch.float64"),
    "uint8 indices": (
        selected_by(lambda m, h, step, rng, selection: selection.astype(np.uint8)),
        "select must return int64; at step 0 it gave uint8",
    ),
}
SCORED = {"choices of the first episode", "scores changed"}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_it_finds(mistake: str, monkeypatch: pytest.MonkeyPatch) -> None:
    members, message = MISTAKES[mistake]
    kind = TokenDrop if mistake in SCORED else FrameSamp
    options = {"budget": 64, "grid": 4, "stride": 4} if mistake in SCORED else {"budget": 256}
    mistaken = type("Mistaken", (kind,), members) if isinstance(members, dict) else members
    monkeypatch.setitem(MEMORIES._entries, "mistaken", mistaken)
    with pytest.raises(AssertionError, match=message):
        check_memory("mistaken", **options)
