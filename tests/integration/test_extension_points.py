"""Every extension point of a backbone, for an integration of one's own: training, sampling and
weights.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from mme_vla import MMEPolicy, UserError
from mme_vla.backbone.base import ExpertConfig, Hook
from mme_vla.backbone.layers import PI05_VISIBILITY, Block
from mme_vla.config.composition import compose
from mme_vla.integration.base import Integration, required
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.policy.build import build_from_config
from mme_vla.registry import INTEGRATIONS, MEMORIES
from mme_vla.testing import check_integration
from mme_vla.testing.small import open_gates, random_batch, small_policy, unit_stats
from mme_vla.types import HistoryTokens, MemoryTokens
from mme_vla.weights import load_weights, transfer
from mme_vla.weights.orbax import write_orbax
from mme_vla.weights.released import to_released

VISIBLE = {"images", "prompt", "memory"}
BESIDE = {**PI05_VISIBILITY, "memory": VISIBLE, "action": VISIBLE | {"action"}}


class Beside(Integration):
    """Stands beside the actions, after a layer of its own."""

    expert = "action"

    def __init__(self, backbone: Any) -> None:
        super().__init__(backbone)
        self.memory_width = backbone.action.width
        self.visibility = BESIDE
        self.project = nn.Linear(self.memory_width, self._width(backbone))

    def _width(self, backbone: Any) -> int:
        return int(backbone.action.width)

    def beside(self, memory: MemoryTokens | None) -> Sequence[Block]:
        memory = required(memory)
        return [Block("memory", self.project(memory.tokens), memory.mask, self.expert)]


class BesideInASeparateExpert(Beside):
    expert = "recall"

    def _width(self, backbone: Any) -> int:
        return 48

    def extra_experts(self) -> dict[str, ExpertConfig]:
        return {"recall": ExpertConfig(48, 96)}


class Everything(BesideInASeparateExpert):
    """All extension points at once."""

    def __init__(self, backbone: Any) -> None:
        super().__init__(backbone)
        self.mix = nn.Linear(self.memory_width, self.memory_width)
        self.word = nn.Linear(self.memory_width, backbone.vlm.width)
        self.visibility = {**BESIDE, "word": {"word"}, "prompt": {"word", "images", "prompt"}}
        self.visibility["action"] = VISIBLE | {"word", "action"}

    def _mean(self, memory: MemoryTokens | None) -> Tensor:
        memory = required(memory)
        valid = memory.mask[..., None]
        return memory.tokens.masked_fill(~valid, 0).sum(1) / valid.sum(1)

    def condition(self, memory: MemoryTokens | None) -> Callable[[Tensor], Tensor]:
        change = self.mix(self._mean(memory))
        return lambda condition: condition + change

    def hook(self, memory: MemoryTokens | None) -> Hook:
        change = self._mean(memory)[:, None]
        return lambda layer, x: x + change

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        word = self.word(self._mean(memory))[:, None]
        return [
            Block(
                "word",
                word,
                torch.ones(word.shape[:2], dtype=torch.bool, device=word.device),
                "vlm",
            ),
            *observation,
        ]


class Weighted(FrameSamp):
    """A memory with one parameter more than the released one it derives from."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.weight = nn.Parameter(torch.ones(self.encoder.project.out_features))

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        tokens = super().forward(history)
        return MemoryTokens(tokens.tokens * self.weight, tokens.mask)


class Another(FrameSamp):
    """One that encodes in its own way: it lacks what the released one has."""

    def __init__(self, d_vision: int, width: int, **options: Any) -> None:
        super().__init__(d_vision, width, **options)
        self.encoder = nn.Linear(d_vision, width)  # type: ignore[assignment]

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        return MemoryTokens(self.encoder(history.features), history.mask)


EXTENSION_POINTS = [Beside, BesideInASeparateExpert, Everything]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    for custom in EXTENSION_POINTS:
        monkeypatch.setitem(INTEGRATIONS._entries, custom.__name__, custom)
    for memory in (Weighted, Another):
        monkeypatch.setitem(MEMORIES._entries, memory.__name__, memory)


def policy_of(
    integration: type[Integration], memory: type = FrameSamp, seed: int = 42
) -> MMEPolicy:
    cfg = compose("policy", ["model=framesamp_modul", "backbone=tiny"])
    cfg.integration = {"name": integration.__name__}
    cfg.memory = {"name": "framesamp" if memory is FrameSamp else memory.__name__, "budget": 128}
    policy = build_from_config(cfg, seed=seed)
    policy.require_processor().stats = unit_stats()
    open_gates(policy)
    return policy


@pytest.mark.parametrize("integration", EXTENSION_POINTS)
def test_an_extension_point_leads_to_the_action_in_training_and_in_every_step_of_sampling(
    integration: type[Integration],
) -> None:
    check_integration(integration.__name__)


@pytest.mark.parametrize("integration", EXTENSION_POINTS)
def test_a_policy_learns_and_acts_through_an_extension_point(
    integration: type[Integration],
) -> None:
    policy = policy_of(integration)
    batch = random_batch(policy, valid=64)
    draws = policy.training_noise(2, torch.Generator().manual_seed(0))
    before, _ = policy(batch, draws)
    before.backward()
    torch.optim.SGD(policy.parameters(), 1e-2).step()
    assert policy(batch, draws)[0] < before
    frames = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    episodes = [policy.start_episode("press the button", seed) for seed in (0, 1)]
    for episode, frame in zip(episodes, (frames, frames[::-1][:2]), strict=True):
        episode.observe({"front": frame, "wrist": frame}, np.zeros((len(frame), 8), np.float32))
    noise = [episode.noise_state for episode in episodes]
    together = policy.act(episodes)
    for episode, state in zip(episodes, noise, strict=True):
        episode.noise_state = state
    alone = np.stack([policy.act(episode) for episode in episodes])
    assert np.abs(together - alone).max() < 1e-4


# Released checkpoints


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> tuple[MMEPolicy, Path]:
    """A released tree of FrameSamp with the modulator, and the policy it was written from."""
    pytest.importorskip("tensorstore", reason="Orbax checkpoints need the extra 'orbax'")
    policy = small_policy("framesamp_modul", seed=5)
    folder = tmp_path_factory.mktemp("released")
    write_orbax(to_released(policy), folder / "params")
    return policy, folder


@pytest.mark.parametrize(
    ("integration", "memory"),
    [*[(o, FrameSamp) for o in EXTENSION_POINTS], (Beside, Weighted), (Beside, Another)],
)
def test_only_the_custom_component_is_new_when_starting_from_a_released_checkpoint(
    integration: type[Integration], memory: type, released: tuple[MMEPolicy, Path]
) -> None:
    source, folder = released
    policy, released_state = policy_of(integration, memory), source.state_dict()
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    start = transfer(policy, folder)
    assert set(start.new) == set(before) - set(released_state)
    assert any(name.startswith("integration.") for name in start.new)
    assert all("mem_attn" in name or "mem_" in name for name in start.left)
    assert start.left
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, before[name] if name in start.new else released_state[name]), (
            name
        )


def test_loading_all_of_one_says_which_tensors_have_no_released_names(
    released: tuple[MMEPolicy, Path],
) -> None:
    with pytest.raises(
        UserError, match=r"(?s)experts\.recall\.attention_norm.*and 4 more.*start_from\(\)"
    ):
        load_weights(policy_of(BesideInASeparateExpert), released[1])


def test_the_memoryless_ports_start_a_custom_integration_too(tmp_path: Path) -> None:
    from mme_vla.cli.weights import convert

    small_policy("pi05", seed=5).save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "lerobot", to="lerobot")
    policy = policy_of(Everything)
    start = transfer(policy, tmp_path / "lerobot")
    component = policy.finetune_spec.component_of
    assert set(start.new) == {name for name in policy.state_dict() if component(name) == "memory"}
