"""What a memory's tokens say of their place, and a repeated frame, for every memory that has
positions.
"""

from dataclasses import replace
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from mme_vla.config.trees import config_dir
from mme_vla.errors import UserError
from mme_vla.memory.base import FeatureEncoder, Memory, stack_history
from mme_vla.memory.perturbation import Pause
from mme_vla.memory.transforms import TransformedHistory, map_frames
from mme_vla.registry import MEMORIES
from mme_vla.testing.check_memory import D_VISION, WIDTH, Episode
from mme_vla.types import HistoryTokens

WITH_POSITIONS: dict[str, dict[str, Any]] = {
    "framesamp": {"budget": 64},
    "tokendrop": {"budget": 64, "grid": 4},
    "retrieval": {"budget": 64},
    "ttt": {"budget": 16, "grid": 4},
    "rmt": {"budget": 16, "grid": 4},
    "gist": {"budget": 128},
    "learned_topk": {"budget": 32, "pool": 8, "grid": 4},
    "moment": {},
    "actions": {"budget": 4},
    "present": {},
    "anchors": {"budget": 48},
    "events": {"budget": 64},
    "pyramid": {"budget": 80},
    "keyframes": {"budget": 48, "pool": 8},
}

OTHERS: dict[str, dict[str, Any]] = {
    "bank": {"budget": 16, "grid": 4}, "spacetime": {"frames": 3},
    "joined": {"members": [{"name": "framesamp", "budget": 32}, {"name": "actions", "budget": 4}]},
}  # fmt: skip


def build(name: str, **options: Any) -> Memory:
    torch.manual_seed(0)
    section = {"name": name, **(WITH_POSITIONS | OTHERS)[name], **options}
    memory: Memory = MEMORIES.build(section, d_vision=D_VISION, width=WIDTH)
    return memory.eval()


def shifted(history: HistoryTokens, *by: float) -> HistoryTokens:
    """The selection at other times, rows or columns."""
    return replace(
        history, positions=(history.positions + torch.tensor(by)) * history.mask[..., None]
    )


@torch.no_grad()
@pytest.mark.parametrize("name", WITH_POSITIONS)
def test_tokens_say_of_their_place_what_positions_allows(name: str) -> None:
    full, changes = build(name), {}
    history = stack_history([full.gather_selection(Episode(full, 48).cached(), 47)])
    for positions in ("time_space", "space", "none"):
        memory = build(name, positions=positions)
        base = memory(history)
        for what, other in (
            ("time", shifted(history, 100, 0, 0)),
            ("space", shifted(history, 0, 3, 2)),
        ):
            tokens = memory(other).tokens
            changes[positions, what] = not torch.equal(tokens[base.mask], base.tokens[base.mask])
        if positions == "time_space":
            assert torch.equal(base.tokens, full(history).tokens), "the default"
    assert changes == {
        ("time_space", "time"): True, ("time_space", "space"): True, ("space", "time"): False,
        ("space", "space"): True, ("none", "time"): False, ("none", "space"): False,
    }  # fmt: skip


def test_every_memory_whose_tokens_have_positions_has_the_key() -> None:
    sections = {
        path.stem: OmegaConf.load(path) for path in (config_dir() / "memory").glob("*.yaml")
    }
    assert {*sections} == {*WITH_POSITIONS, *OTHERS, "none"}
    assert {name for name, section in sections.items() if "positions" in section} == {
        *WITH_POSITIONS
    }


def test_without_positions_there_is_no_position_layer_and_a_narrower_encoder() -> None:
    full, none = (FeatureEncoder(2048, 1024, positions=positions) for positions in (None, "none"))
    assert {name: tuple(value.shape) for name, value in none.state_dict().items()} == {
        "project.weight": (1024, 2048), "project.bias": (1024,)
    }  # fmt: skip
    sizes = [sum(p.numel() for p in encoder.parameters()) for encoder in (full, none)]
    assert sizes[0] - sizes[1] == 768 * 1024 + 768 * 768 + 768
    with pytest.raises(UserError, match=r"memory\.positions='time'"):
        build("framesamp", positions="time")


@torch.no_grad()
@pytest.mark.parametrize("name", WITH_POSITIONS | OTHERS)
def test_every_memory_learns_from_a_repeated_frame(name: str) -> None:
    memory, run = build(name), 16
    frames = map_frames([Pause(run, 4)], 48, Episode.exec_start, keep=[47])
    base = Episode(memory, 48).cached()
    paused = TransformedHistory(base, frames)
    tokens = memory.gather_selection(paused, len(paused) - 1)
    assert tokens.step is not None and int(tokens.step) == 47 + run and tokens.mask.any()
    recorded = frames.real[tokens.positions[tokens.mask][:, 0].long().numpy()]
    assert recorded.max() <= 47
    assert torch.isfinite(memory(stack_history([tokens])).tokens).all()
