"""OpenVLA-OFT: the original's stages, loss, gradients, predictions and first updates, at the golden
models' size.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from helpers.baselines import baselines_folder, case, relative_error, rule_weight
from helpers.openvla_golden import batch, fused, golden_name, policy
from mme_vla.backbone.layers import additive_mask
from mme_vla.extras.methods.openvla_oft.config import FusedVisionConfig, LlamaConfig, TowerConfig
from mme_vla.extras.methods.openvla_oft.model import OpenVlaBackbone, TokenSequence, absolute_error
from mme_vla.extras.methods.openvla_oft.processor import ClippedQuantiles
from mme_vla.extras.methods.openvla_oft.weights import VLA, openvla_name
from mme_vla.extras.methods.prismatic import Prismatic

TOLERANCE = 3e-5  # of the largest entry
GRADIENT = 1e-3
CASES = ["policy", "memory_context"]


@pytest.fixture(scope="module")
def folder() -> Path:
    return baselines_folder("openvla_oft")


def near(ours: Tensor, golden: Tensor, tolerance: float = TOLERANCE) -> None:
    assert relative_error(ours, golden) <= tolerance


class Stages:
    """One golden case run through the network, stage by stage."""

    def __init__(self, folder: Path, name: str) -> None:
        self.golden, self.about = case(folder, name)
        self.policy = policy(self.golden, self.about)
        self.backbone: Any = self.policy.backbone
        self.batch = batch(self.golden, self.about)
        self.memory = self.policy.model.memory_tokens(self.batch)

    def sequence(self) -> TokenSequence:
        observation = self.backbone.blocks_of(self.batch, fused(self.backbone, self.golden))
        return self.backbone.sequence(
            self.policy.integration.inject(observation, self.memory).blocks
        )

    def as_golden(self, rows: Tensor, sequence: TokenSequence) -> tuple[Tensor, Tensor]:
        """Rows [b, n, …] in the original's order (padding last), and which of them are
        not padding.
        """
        mask = self.golden["out/multimodal_mask"]
        out, real = (
            torch.zeros(*mask.shape, *rows.shape[2:], dtype=rows.dtype),
            torch.zeros_like(mask),
        )
        for b in range(len(rows)):
            places = sequence.positions[b][sequence.valid[b]]
            out[b, places] = rows[b][sequence.valid[b]]
            real[b, places] = True
        return out, real


@pytest.fixture(scope="module", params=CASES)
def stages(request: pytest.FixtureRequest, folder: Path) -> Stages:
    return Stages(folder, request.param)


@torch.no_grad()
def test_openvla_oft_tokens_of_images_state_and_memory(stages: Stages) -> None:
    golden, backbone = stages.golden, stages.backbone
    pixels = golden["in/pixel_values"][:, :6]
    for name, tower, three in (
        ("dino", backbone.vlm.vision.dino, pixels[:, :3]),
        ("siglip", backbone.vlm.vision.siglip, pixels[:, 3:]),
    ):
        (first,) = tower.forward_intermediates(
            three, indices=[0], output_fmt="NLC", intermediates_only=True, return_prefix_tokens=True
        )
        tokens = torch.cat([first[1], first[0]], 1) if isinstance(first, tuple) else first
        near(tokens, golden[f"out/{name}_block0_camera0"])
    tokens = fused(backbone, golden)
    near(tokens.flatten(1, 2), golden["out/fused_patches"])
    near(backbone.vlm.projector(tokens).flatten(1, 2), golden["out/projected_patches"])
    near(backbone.state_token(golden["in/proprio"])[:, 0], golden["out/proprio_token"])
    if stages.memory is not None:
        near(stages.memory.tokens, golden["out/memory_tokens"])


@torch.no_grad()
def test_openvla_oft_sequence_hidden_states_and_read_out(stages: Stages) -> None:
    golden, backbone, sequence = stages.golden, stages.backbone, stages.sequence()
    embedded, real = stages.as_golden(sequence.tokens, sequence)
    assert torch.equal(real, golden["out/multimodal_mask"])
    near(embedded, golden["out/inputs_embeds"] * real[..., None])
    after: list[Tensor] = []
    layers = backbone.vlm.language.model.layers
    hooks = [
        layer.register_forward_hook(lambda _layer, _inputs, out: after.append(out))
        for layer in layers
    ]
    last = backbone.hidden(sequence)
    for hook in hooks:
        hook.remove()
    for i, state in enumerate(after):
        near(stages.as_golden(state, sequence)[0], golden[f"out/layer{i}"] * real[..., None])
    near(stages.as_golden(last, sequence)[0], golden["out/last_hidden"] * real[..., None])
    near(backbone.slots(sequence, last), golden["out/head_input"])


def test_openvla_oft_loss_and_gradients(stages: Stages) -> None:
    golden, about, policy = stages.golden, stages.about, stages.policy
    memory = policy.model.memory_tokens(stages.batch)
    observation = stages.backbone.blocks_of(stages.batch, fused(stages.backbone, golden))
    output = stages.backbone.predict_from(policy.integration.inject(observation, memory).blocks)
    near(output.detach(), golden["out/predicted_actions"])
    errors = absolute_error(output, golden["in/actions"])
    metrics, detached = about["metrics"], errors.detach()
    near(detached.mean(), golden["out/loss"])
    near(detached[:, 0].mean(), torch.tensor(metrics["curr_action_l1_loss"]))
    near(detached[:, 1:].mean(), torch.tensor(metrics["next_actions_l1_loss"]))
    policy.zero_grad()
    errors.mean().backward()
    gradients = {
        golden_name(name): p.grad for name, p in policy.named_parameters() if p.grad is not None
    }
    for name, norm in about["grad_l2"].items():
        assert float(gradients[name].norm()) == pytest.approx(norm, rel=GRADIENT), name
    assert not set(about["no_gradient"]) & set(gradients)
    learning = {
        golden_name(name)
        for name, parameter in policy.named_parameters()
        if parameter.requires_grad
    }
    assert learning == set(about["trainable"])


@torch.no_grad()
def test_openvla_oft_prediction_from_the_prompt_alone(stages: Stages) -> None:
    """One sample at a time in the original; here all in one batch."""
    golden, stats = stages.golden, stages.about["norm_stats"]["proprio"]
    quantiles = ClippedQuantiles.of(
        SimpleNamespace(**{name: stats[name] for name in ("q01", "q99", "min", "max")})
    )
    observation_ = replace(
        stages.batch, proprio=quantiles.normalize(golden["in/raw_proprio"].double()).float()
    )
    observation = stages.backbone.blocks_of(observation_, fused(stages.backbone, golden))
    blocks = stages.policy.integration.inject(observation, stages.memory).blocks
    near(stages.backbone.predict_from(blocks), golden["out/predict_normalised"])


@torch.no_grad()
def test_openvla_oft_language_model_alone(folder: Path) -> None:
    golden, about = case(folder, "llama_small")
    layer = f"{VLA}language_model.model.layers"
    depth = 1 + max(
        int(name.removeprefix(f"{layer}.").split(".")[0])
        for name in about["parameters"]
        if layer in name
    )
    width, mlp = (
        golden["in/embeds"].shape[-1],
        about["parameters"][f"{layer}.0.mlp.gate_proj.weight"][0],
    )
    tower = TowerConfig(width=4, depth=2, mlp_dim=4, num_heads=1)
    best: dict[int, float] = {}
    for heads in _heads(width, about):
        vlm = Prismatic(
            FusedVisionConfig(14, 14, tower, tower),
            LlamaConfig(width, mlp, depth, heads, about["rms_norm_eps"]),
            8,
        )
        state = {name: openvla_name(f"backbone.vlm.{name}") for name in vlm.state_dict()}
        values = {
            target: rule_weight(source, tuple(about["parameters"][source]), about["weight_seed"])
            for target, source in state.items()
            if source in about["parameters"]
        }
        assert len(values) == len(about["parameters"])
        vlm.load_state_dict(values, strict=False)
        mask = golden["in/mask"]
        allowed = additive_mask(mask[:, None].expand(-1, mask.shape[1], -1), torch.float32)
        places = torch.arange(mask.shape[1]).expand(len(mask), -1)
        hidden = vlm.read(golden["in/embeds"], allowed, places, every_layer=True)
        assert len(hidden) == sum(name.startswith("out/hidden") for name in golden)
        best[heads] = max(
            float(((state - golden[f"out/hidden{i}"]).abs() * mask[..., None]).max())
            for i, state in enumerate(hidden)
        )
    assert min(best.values()) <= TOLERANCE * max(
        float(golden[f"out/hidden{i}"].abs().max()) for i in range(depth + 1)
    )


def _heads(width: int, about: dict[str, Any]) -> list[int]:
    """The case does not say how many heads there are: those that the width allows."""
    if "sizes" in about:
        return [about["sizes"]["llm"]["num_attention_heads"]]
    return [heads for heads in range(1, width + 1) if width % (2 * heads) == 0]


def test_openvla_oft_first_updates(folder: Path) -> None:
    golden, about = case(folder, "training")
    weights, model = case(folder, "policy")
    built = policy(weights, model).train()
    backbone = built.backbone
    assert isinstance(backbone, OpenVlaBackbone)
    data = batch(golden, model)
    trained = [p for p in built.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, **about["optimizer"])
    for i, update in enumerate(about["updates"]):
        rate = about["optimizer"]["lr"] * (about["gamma"] if i >= about["milestone"] else 1)
        assert rate == pytest.approx(update["lr"])
        optimizer.param_groups[0]["lr"] = rate
        errors = absolute_error(
            backbone.predict_from(backbone.blocks_of(data, fused(backbone, golden))), data.actions
        )
        assert errors.mean().item() == pytest.approx(update["loss_value"], rel=TOLERANCE)
        optimizer.zero_grad()
        errors.mean().backward()
        norm = torch.stack([p.grad.norm() for p in trained if p.grad is not None]).norm()
        assert float(norm) == pytest.approx(update["grad_norm"], rel=GRADIENT)
        optimizer.step()
        values = {golden_name(name): p for name, p in built.named_parameters()}
        for name in about["watched"]:
            near(values[name].detach(), golden[f"out/step{i}/{name}"], GRADIENT)
