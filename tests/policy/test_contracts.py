"""What the library asks of a user's parts it asks of its own: every registered one passes its
check.
"""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from mme_vla.backbone.layers import PI05_VISIBILITY
from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.config.trees import config_dir
from mme_vla.integration.context import Context
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.memory.history import History
from mme_vla.registry import BACKBONES, INTEGRATIONS, MEMORIES
from mme_vla.testing import check_backbone, check_integration, check_memory, check_task
from mme_vla.testing.check_integration import check_sampling
from mme_vla.testing.small import random_batch, small_policy, tiny_sections
from mme_vla.types import HistoryTokens, MemoryTokens

SIZES: dict[str, dict[str, Any]] = {
    "framesamp": {"budget": 256},
    "tokendrop": {"budget": 256},
    "ttt": {"budget": 16, "max_steps": 8, "max_video": 4},
    "rmt": {"budget": 16, "max_steps": 8, "max_video": 4},
    "retrieval": {"budget": 64, "every": 2, "longest": 3},
    "moment": {"budget": 16, "moments": 2, "grid": 2},
    "gist": {"budget": 48, "anchors": 1, "recent": 1, "gists": 4, "stride": 8},
    "actions": {"budget": 4, "max_steps": 12, "max_video": 6},
    "present": {"grid": 4},
    "learned_topk": {"budget": 32, "pool": 6},
    "spacetime": {"stride": 4},
    "bank": {"budget": 16, "grid": 4, "moments": 4, "video": 2, "hidden": 32, "length": 3},
    "anchors": {"spacing": 3},
    "events": {"budget": 64, "stride": 4},
    "pyramid": {"budget": 96, "strides": [1, 4]},
    "keyframes": {"budget": 64, "every": 4, "pool": 8},
}


def test_every_memory_that_ships_is_queried() -> None:
    shipped = {file.stem for file in (config_dir() / "memory").glob("*.yaml")}
    assert set(SIZES) == shipped - {"none", "joined"}  # the latter is made of others


@pytest.mark.parametrize("name", SIZES)
def test_every_memory_of_the_library_keeps_a_memorys_contract(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    check_memory(name, **SIZES[name])
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == [name] * 4


@pytest.mark.parametrize("name", ["context", "modulator", "expert"])
def test_every_integration_of_the_library_keeps_an_integrations_contract(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    check_integration(name)
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == [name] * 4


@torch.no_grad()
@pytest.mark.parametrize("head", ["flow", "clean_flow"])
def test_sampling_is_compared_to_the_joint_pass_through_the_head_of_the_backbone(head: str) -> None:
    policy = small_policy("framesamp_modul", **{"backbone.head.name": head})
    batch = random_batch(policy, batch=2, valid=64)
    memory = policy.model.memory_tokens(batch)
    assert memory is not None
    check_sampling(policy, batch, memory)


def test_the_backbone_of_the_library_keeps_a_backbones_contract() -> None:
    check_backbone(
        "pi05", **{k: v for k, v in tiny_sections("pi05")["backbone"].items() if k != "name"}
    )


def test_a_task_of_the_library_keeps_a_tasks_contract() -> None:
    pytest.importorskip(
        "mani_skill", reason="the simulator is not installed: the extra `sim` has it"
    )
    check_task("StopCube", difficulty="easy")


# Each check rejects a part that breaks one rule.


class _LooksAhead(FrameSamp):
    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        return super().select(history, len(history) - 1, rng)


class _Dices(FrameSamp):
    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        frames = super().select(history, step, rng)
        return frames[
            np.sort(np.random.default_rng().permutation(len(frames))[: max(len(frames) // 2, 1)])
        ]


class _ReadsPadding(FrameSamp):
    def forward(self, history: HistoryTokens) -> MemoryTokens:
        tokens = super().forward(history)
        return MemoryTokens(
            tokens.tokens + history.features.mean((1, 2), keepdim=True), tokens.mask
        )


class _Forgets(FrameSamp):
    def forward(self, history: HistoryTokens) -> MemoryTokens:
        tokens = super().forward(history)
        return MemoryTokens(torch.ones_like(tokens.tokens), tokens.mask)


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (_LooksAhead, "later"),
        (_Dices, "same choice"),
        (_ReadsPadding, "padding"),
        (_Forgets, "does not read"),
    ],
)
def test_a_broken_memory_is_reported_which_prefix_it_breaks(
    broken: type, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(MEMORIES._entries, "broken", broken)
    with pytest.raises(AssertionError, match=words):
        check_memory("broken", budget=256)


class _Unread(Context):
    """Memory is in the prefix and no block may attend to it."""

    def __init__(self, backbone: Any) -> None:
        super().__init__(backbone)
        self.visibility = {**PI05_VISIBILITY, "memory": {"memory"}}


def test_an_integration_that_loses_memory_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(INTEGRATIONS._entries, "broken", _Unread)
    with pytest.raises(AssertionError, match="does not reach the action"):
        check_integration("broken")


class _Random(Pi05Backbone):
    def loss(self, *args: Any, **kwargs: Any) -> Tensor:
        return super().loss(*args, **kwargs) + torch.rand(())


def test_a_backbone_whose_loss_does_not_repeat_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BACKBONES._entries, "broken", _Random)
    with pytest.raises(AssertionError, match="same noise must give the same loss"):
        check_backbone(
            "broken", **{k: v for k, v in tiny_sections("pi05")["backbone"].items() if k != "name"}
        )
