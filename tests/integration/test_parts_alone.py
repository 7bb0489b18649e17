"""Backbone, memory and integration without a policy: what masks mean, and mistakes by name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch

from mme_vla import UserError
from mme_vla.backbone.base import BackboneConfig, ExpertConfig, VisionConfig
from mme_vla.backbone.layers import PI05_VISIBILITY, Block
from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.integration.base import Integration
from mme_vla.integration.context import Context, MemoryExpert
from mme_vla.integration.modulator import Modulator
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.memory.rmt import RMT
from mme_vla.memory.ttt import TTT
from mme_vla.model import MMEModel
from mme_vla.types import Batch, HistoryTokens, MemoryTokens

SIZES = BackboneConfig(
    VisionConfig(image_size=32, patch_size=8, width=32, depth=1, mlp_dim=32, num_heads=2),
    ExpertConfig(32, 32),
    ExpertConfig(16, 16),
    depth=2,
    head_dim=8,
    vocab_size=32,
)
BUDGET = 16


def small_model(kind: type[Integration] = Modulator) -> MMEModel:
    """A model whose memory reaches the actions."""
    torch.manual_seed(0)
    integration = kind(SIZES)
    backbone = Pi05Backbone(SIZES, integration.extra_experts())
    memory = FrameSamp(32, integration.memory_width, budget=BUDGET)
    model = MMEModel(backbone, memory, integration).eval()
    for name, parameter in model.named_parameters():
        if "dense" in name or "modulation" in name:
            torch.nn.init.normal_(parameter, std=0.5)
    return model


def two_samples(**changed: Any) -> Batch:
    generator = torch.Generator().manual_seed(1)
    words = torch.ones(2, 4, dtype=torch.long)
    features = torch.randn(2, BUDGET, 32, generator=generator)
    history = HistoryTokens(features, torch.zeros(2, BUDGET, 3), torch.ones(2, BUDGET).bool())
    batch = Batch(
        torch.zeros(2, 2, 3, 32, 32, dtype=torch.uint8),
        torch.ones(2, 2, dtype=torch.bool),
        words,
        words.bool(),
        history,
        torch.zeros(2, 20, 32),
    )
    return replace(batch, **changed)


def noise_of(model: MMEModel) -> dict[str, torch.Tensor]:
    return model.training_noise(2, torch.Generator().manual_seed(2))


def memory_of(model: MMEModel, mask: torch.Tensor, padding: float) -> MemoryTokens:
    generator = torch.Generator().manual_seed(3)
    tokens = torch.randn(2, BUDGET, model.integration.memory_width, generator=generator)
    return MemoryTokens(tokens.masked_fill(~mask[..., None], padding), mask)


@pytest.mark.parametrize("valid", [0, 5], ids=["no valid token", "some"])
@pytest.mark.parametrize("kind", [Modulator, Context, MemoryExpert])
def test_actions_do_not_depend_on_undefined_memory_tokens(
    kind: type[Integration], valid: int
) -> None:
    model = small_model(kind)
    mask = torch.ones(2, BUDGET, dtype=torch.bool)
    mask[0, valid:] = False
    noise, batch = noise_of(model), two_samples()
    losses, chunks = [], []
    for padding in (0.0, 50.0, float("nan")):
        memory = memory_of(model, mask, padding)
        losses.append(model(batch, noise, memory).detach())
        chunks.append(model.sample(batch, {"noise": noise["noise"]}, 1, memory))
    assert torch.isfinite(chunks[0]).all()
    assert losses[0] == losses[1] == losses[2]
    assert torch.equal(chunks[0], chunks[1]) and torch.equal(chunks[0], chunks[2])


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32])
def test_a_mask_that_is_not_bool_is_named_at_every_place(dtype: torch.dtype) -> None:
    model, mask = small_model(), torch.ones(2, BUDGET, dtype=dtype)
    tokens = torch.zeros(2, BUDGET, 32)
    with pytest.raises(ValueError, match=rf"HistoryTokens.mask is {dtype} \[2, 16\]"):
        HistoryTokens(tokens, torch.zeros(2, BUDGET, 3), mask)
    with pytest.raises(ValueError, match=rf"MemoryTokens.mask is {dtype} .*must be torch.bool"):
        MemoryTokens(tokens, mask)
    with pytest.raises(ValueError, match=rf"The mask of block 'sounds' is {dtype}"):
        Block("sounds", tokens, mask, "vlm")
    prompt_mask = torch.ones(2, 4, dtype=dtype)
    with pytest.raises(ValueError, match=rf"The mask of block 'prompt' is {dtype}"):
        model(two_samples(prompt_mask=prompt_mask), noise_of(model))
    with pytest.raises(ValueError, match=rf"Batch.image_mask is {dtype} \[2, 2\]"):
        model(two_samples(image_mask=torch.ones(2, 2, dtype=dtype)), noise_of(model))


@pytest.mark.parametrize("shape", [(2, 1), (1, 2)])
def test_a_mask_of_one_view_or_one_sample_is_not_broadcast(shape: tuple[int, int]) -> None:
    model = small_model()
    with pytest.raises(ValueError, match=r"Batch.image_mask .*must be torch.bool \[2, 2\]"):
        model(two_samples(image_mask=torch.ones(shape).bool()), noise_of(model))


def test_bits_of_bfloat16_are_no_features() -> None:
    history = two_samples().history
    assert history is not None
    with pytest.raises(ValueError, match=r"torch.uint16: .*features.view\(torch.bfloat16\)"):
        replace(history, features=history.features.bfloat16().view(torch.uint16))


def test_parts_of_other_sizes_are_named() -> None:
    model, batch = small_model(), two_samples()
    memory = FrameSamp(32, 24, budget=BUDGET)
    wrong = MMEModel(model.backbone, memory, model.integration)
    message = r"integration.memory_width\], has shape \[2, 16, 24\]: it must be \[2, 16, 16\]"
    with pytest.raises(ValueError, match=message):
        wrong(batch, noise_of(model))
    unread = MMEModel(model.backbone, model.memory, Integration(SIZES))
    with pytest.raises(ValueError, match=r"it must be \[2, 16, 0\]"):  # the memory had no effect
        unread(batch, noise_of(model))
    without_expert = MMEModel(Pi05Backbone(SIZES), model.memory, MemoryExpert(SIZES))
    with pytest.raises(UserError, match=r"'memory' .*\{'vlm': 32, 'action': 16\}.*extra_experts"):
        without_expert(batch, noise_of(model))


def adding(
    block: Callable[[MemoryTokens], Block], visibility: Mapping[str, set[str]]
) -> type[Integration]:
    class Adding(Integration):
        memory_width = 16

        def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
            assert memory is not None
            return [block(memory), *observation]

    Adding.visibility = {**PI05_VISIBILITY, **visibility}
    return Adding


@pytest.mark.parametrize(
    ("expert", "visibility", "message"),
    [
        ("acton", {"notes": {"notes"}}, "'notes' has tokens .* the expert 'acton'"),
        ("vlm", {"notes": {"notes"}}, r"tokens \[2, 16, 16\] for the expert 'vlm'"),
        ("action", {"notes": {"nots"}}, "No row of the visibility table belongs to nots"),
        ("action", {}, "No row of the visibility table belongs to notes"),
    ],
)
def test_a_block_in_no_expert_or_of_no_row_is_named(
    expert: str, visibility: Mapping[str, set[str]], message: str
) -> None:
    kind = adding(lambda memory: Block("notes", memory.tokens, memory.mask, expert), visibility)
    model = small_model(kind)
    with pytest.raises(UserError, match=message):
        model(two_samples(), noise_of(model))


@pytest.mark.parametrize("kind", [Modulator, Context, MemoryExpert])
def test_weights_of_bfloat16_train_and_sample(kind: type[Integration]) -> None:
    model = small_model(kind).bfloat16()
    noise = noise_of(model)
    assert torch.isfinite(model(two_samples(), noise))
    chunk = model.sample(two_samples(), {"noise": noise["noise"]}, 2)
    model.compute_dtype = torch.bfloat16
    assert torch.isfinite(chunk).all()
    torch.testing.assert_close(
        chunk, model.sample(two_samples(), {"noise": noise["noise"]}, 2), atol=0.1, rtol=0.1
    )


def test_weights_of_float16_are_refused_by_name() -> None:
    model = small_model().half()
    with pytest.raises(UserError, match=r"torch.float16 is too narrow .*bfloat16\(\)"):
        model(two_samples(), noise_of(model))


@pytest.mark.parametrize("noise", [None, torch.zeros(2, 20, 32)])
def test_noise_without_names_is_refused_by_loss_and_sample(noise: Any) -> None:
    model = small_model()
    with pytest.raises(ValueError, match=r"The noise is a .*give tensors by name"):
        model(two_samples(), noise)
    with pytest.raises(ValueError, match=r"The noise is a .*give tensors by name"):
        model.sample(two_samples(), noise)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Modulator(SIZES, num_heads=3, num_kv_heads=2), "num_heads=3 must be a multiple"),
        (lambda: Modulator(SIZES, num_heads=0), "integration.num_heads=0 must be at least 1"),
        (lambda: Modulator(SIZES, num_kv_heads=0), "integration.num_kv_heads=0 must be"),
        (lambda: Modulator(SIZES, head_dim=7), "head_dim=7 must be a multiple of pairs=2"),
        (lambda: TTT(32, 16, budget=64, heads=0), "memory.heads=0 must be at least 1"),
        (lambda: TTT(32, 16, budget=64, hidden=-4), "memory.hidden=-4 must be at least 1"),
        (lambda: RMT(32, 16, budget=64, kv_heads=0), "memory.kv_heads=0 must be at least 1"),
        (lambda: RMT(32, 16, budget=64, heads=-2), "memory.heads=-2 must be at least 1"),
        (lambda: FrameSamp(32, 16, every=True), "memory.every=True must be at least 1"),
    ],
)
def test_sizes_that_no_layer_can_have_are_named(build: Callable[[], object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        build()
