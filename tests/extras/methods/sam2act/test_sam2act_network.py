"""SAM2Act+'s modules and network against golden numbers of the original code."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from helpers.sam2act_golden import load, meta, relative_error, sample_array, sample_weight
from mme_vla.extras.methods.sam2act.config import EncoderSizes, SAM2ActSizes
from mme_vla.extras.methods.sam2act.geometry import (
    VIEWS,
    PointFinder,
    constant_channels,
    heatmap_loss,
)
from mme_vla.extras.methods.sam2act.model import ConvexUp, EncodedViews, SAM2ActNetwork
from mme_vla.extras.methods.sam2act.sam2 import (
    KeyframeBank,
    LoraProjection,
    MemoryAttention,
    MemoryEncoder,
    sine_positions,
)
from mme_vla.extras.methods.sam2act.weights import RATES, released_names
from mme_vla.weights.tables import read

MODULE, NETWORK, GRADIENT = 1e-4, 5e-4, 2e-3
TINY_ENCODER = EncoderSizes(
    width=8, heads=1, blocks=(1, 1, 2, 1), windows=(8, 4, 4, 2), global_blocks=(3,), lora=2
)


def fill(module: nn.Module, weights: dict[str, Tensor], place: str, stages: int) -> None:
    """Give a module the tensors that the released code names so; `place` is where it is in our
    network.
    """
    table = released_names([f"{place}{name}" for name in module.state_dict()], stages)
    module.load_state_dict(
        {name.removeprefix(place): value for name, value in read(table, weights).items()}
    )


# Modules


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    return load("memory")


def params(golden: dict[str, np.ndarray], prefix: str = "sam2.") -> dict[str, Tensor]:
    arrays = {
        name: torch.from_numpy(value)
        for name, value in golden.items()
        if name.startswith("params/")
    }
    return {prefix + name.removeprefix("params/"): value for name, value in arrays.items()}


def mask_stages(golden: dict[str, np.ndarray]) -> int:
    return round(np.log2(golden["encoder/masks"].shape[-1] / golden["encoder/features"].shape[-1]))


def small_bank(golden: dict[str, np.ndarray]) -> KeyframeBank:
    """A bank of the golden file's sizes, every one of them read from its arrays."""
    weights, stages = params(golden), mask_stages(golden)
    width, remembered = golden["encoder/features"].shape[1], golden["params/maskmem_tpos_enc"].shape
    layers = {
        name.split(".")[3] for name in weights if name.startswith("sam2.memory_attention.layers.")
    }
    bank = KeyframeBank(
        grid=golden["encoder/features"].shape[-1],
        token=width,
        memory=golden["encoder/out"].shape[1],
        layers=len(layers),
        feedforward=len(golden["params/memory_attention.layers.0.linear1.bias"]),
        mask_stages=stages,
        remembered=remembered[0],
    )
    fill(bank, weights, "memory.", stages)
    return bank.eval()


@torch.no_grad()
def test_a_keyframe_is_encoded_as_the_original_does(golden: dict[str, np.ndarray]) -> None:
    bank = small_bank(golden)
    assert isinstance(bank.encoder, MemoryEncoder)
    actual = bank.encoder(
        *(torch.from_numpy(golden[f"encoder/{name}"]) for name in ("features", "masks"))
    )
    assert relative_error(actual, golden["encoder/out"]) < MODULE
    expected = golden["encoder/position"]
    positions = sine_positions(expected.shape[-1], expected.shape[1])
    assert relative_error(positions.expand(expected.shape), expected) < MODULE


@torch.no_grad()
def test_tokens_attend_to_one_and_to_several_memories(golden: dict[str, np.ndarray]) -> None:
    attention = small_bank(golden).attention
    assert isinstance(attention, MemoryAttention)
    current, positions = (
        torch.from_numpy(golden[f"attention/{name}"]) for name in ("current", "current_position")
    )
    counts = [
        int(key.removeprefix("attention/out")) for key in golden if key.startswith("attention/out")
    ]
    assert len(counts) > 1
    for count in counts:
        memories = [
            torch.from_numpy(golden[f"attention/{name}{count}"])
            for name in ("memory", "memory_position")
        ]
        actual = attention(*(x.transpose(0, 1) for x in (current, positions, *memories)))
        assert relative_error(actual.transpose(0, 1), golden[f"attention/out{count}"]) < MODULE


@torch.no_grad()
def test_the_bank_follows_the_golden_stream(golden: dict[str, np.ndarray]) -> None:
    bank = small_bank(golden)
    features, positions = (
        torch.from_numpy(golden[f"bank/{name}"]) for name in ("features", "position")
    )
    side, reset = bank.grid, int(golden["bank/reset_before_step"])
    state = bank.init_state()
    for step in range(len(features)):
        state = bank.init_state() if step == reset else state
        tokens = features[step].permute(1, 2, 0).unflatten(-1, (side, side))
        enriched = bank.read(state, tokens, positions.transpose(0, 1))
        assert relative_error(enriched, golden["bank/enriched"][step]) < MODULE
        state = bank.update(state, tokens, torch.from_numpy(golden["bank/heatmaps"][step]))
        assert relative_error(state.maps[-1], golden["bank/stored"][step]) < MODULE
        places = bank.positions().expand(VIEWS, -1, -1)
        assert relative_error(places, golden["bank/stored_position"][step]) < MODULE


@torch.no_grad()
def test_upsampling_is_convex_as_in_the_original(golden: dict[str, np.ndarray]) -> None:
    module = ConvexUp(golden["convex/in"].shape[1], golden["convex/out"].shape[1])
    weights = {
        name.removeprefix("convex."): value
        for name, value in params(golden, "").items()
        if "convex." in name
    }
    module.load_state_dict(weights)
    assert (
        relative_error(module(torch.from_numpy(golden["convex/in"])), golden["convex/out"]) < MODULE
    )


@torch.no_grad()
def test_adapters_reach_queries_and_values_alone(golden: dict[str, np.ndarray]) -> None:
    weights = {
        name.removeprefix("lora_qkv."): value
        for name, value in params(golden, "").items()
        if "lora_qkv" in name
    }
    out, into = weights["qkv.weight"].shape
    module = LoraProjection(nn.Linear(into, out), len(weights["linear_a_q.weight"]))
    module.load_state_dict(weights)
    x = torch.from_numpy(golden["lora/in"])
    assert relative_error(module(x), golden["lora/out"]) < MODULE
    keys = slice(into, out - into)
    assert torch.equal(module(x)[..., keys], module.qkv(x)[..., keys])


# Network


class Rendered:
    """The golden network: its sizes from the names' shapes, its weights and inputs
    random by rule.
    """

    def __init__(self) -> None:
        described = meta()
        sizes, self.shapes = described["sizes"], described["network_parameters"]
        self.seed, self.remembered, self.grid = sizes["seed"], sizes["maskmem"], sizes["grid"]
        widths = {
            name: self.shapes[f"mvt1.{source}.weight"][0]
            for name, source in (
                ("sam", "fusion.conv2d"),
                ("pictures", "patchify.conv2d"),
                ("state", "proprio_preprocess.linear"),
            )
        }
        masks = [
            re.search(r"mask_downsampler\.encoder\.(\d+)\.weight", name) for name in self.shapes
        ]
        self.stages = max(int(match[1]) for match in masks if match) // 3
        self.sizes = SAM2ActSizes(
            encoder=TINY_ENCODER,
            grid=sizes["grid"],
            patch=self.shapes["mvt1.patchify.conv2d.weight"][-1],
            width=sizes["attn"],
            heads=sizes["heads"],
            depth=sizes["depth"],
            language=sizes["lang"],
            words=sizes["lang_len"],
            state_dim=self.shapes["mvt1.proprio_preprocess.linear.weight"][1],
            rotation_bins=sizes["rot"],
            head=self.shapes["mvt2.feat_fc_ex_rot.0.weight"][0],
            memory=self.shapes["sam2.memory_encoder.out_proj.weight"][0],
            memory_layers=sizes["layers"],
            memory_feedforward=sizes["ff"],
            mask_stages=self.stages,
            remembered=sizes["maskmem"],
            **widths,
        )
        self.network = SAM2ActNetwork(self.sizes).eval()
        source = {
            name: sample_weight(name, shape, self.seed) for name, shape in self.shapes.items()
        }
        source["mvt2.feat_fc_init_bn.num_batches_tracked"] = torch.zeros((), dtype=torch.int64)
        self.weights = source
        for place in ("coarse.", "fine.", "memory."):
            fill(self.network.get_submodule(place[:-1]), source, place, self.stages)

    def encoded_views(self, tag: str, batch: int) -> EncodedViews:
        """An input of the golden case, with the channels that never change."""
        grid, sizes, n = self.grid, self.sizes, batch * VIEWS

        def part(name: str, *shape: int) -> Tensor:
            scale = 0.5 if name == "image" else 1.0
            return torch.from_numpy(
                (scale * sample_array(f"{tag}.{name}", shape, self.seed)).astype(np.float32)
            )

        image = part("image", batch, VIEWS, 7, sizes.side, sizes.side)
        constant = constant_channels(sizes.side).expand(batch, -1, -1, -1, -1)
        maps = (
            part("sam_s0", n, sizes.token // 4, 4 * grid, 4 * grid),
            part("sam_s1", n, sizes.token // 2, 2 * grid, 2 * grid),
            part("sam_s2", n, self.shapes["mvt1.fusion.conv2d.weight"][1], grid, grid),
        )
        state = part("proprio", batch, sizes.state_dim)
        return EncodedViews(
            torch.cat([image, constant], 2),
            maps,
            state,
            part("language", batch, sizes.words, sizes.language),
        )


@pytest.fixture(scope="module")
def case() -> Rendered:
    return Rendered()


@pytest.fixture(scope="module")
def expected() -> dict[str, np.ndarray]:
    return load("network")


def test_every_golden_parameter_has_a_place_and_every_place_a_parameter(case: Rendered) -> None:
    targets = [name for name in case.network.state_dict() if not name.startswith("encoder.")]
    sources = {
        piece.path for pieces in released_names(targets, case.stages).values() for piece in pieces
    }
    assert sources == set(case.shapes) - {RATES}


@torch.no_grad()
def test_the_coarse_view_follows_the_golden_stream(
    case: Rendered, expected: dict[str, np.ndarray]
) -> None:
    remembered, finder = case.network.memory.init_state(), PointFinder(case.sizes.side)
    steps = int(expected["coarse_steps"])
    for step in range(steps):
        views = case.encoded_views(f"coarse{step}", 1)
        logits, remembered = case.network.coarse_step(views, remembered)
        assert relative_error(logits, expected[f"coarse{step}/heatmap"]) < NETWORK
        assert relative_error(finder.find(logits), expected[f"coarse{step}/waypoint"]) < NETWORK
    forgetful, _ = case.network.coarse_step(
        case.encoded_views(f"coarse{steps - 1}", 1), case.network.memory.init_state()
    )
    assert relative_error(forgetful, expected["last_heatmap_without_memory"]) < NETWORK
    assert relative_error(forgetful, expected[f"coarse{steps - 1}/heatmap"]) > 10 * NETWORK


@torch.no_grad()
def test_the_closer_view_rotates_and_grips_as_the_original(
    case: Rendered, expected: dict[str, np.ndarray]
) -> None:
    logits, tokens = case.network.fine_step(case.encoded_views("fine", 1))
    assert relative_error(logits, expected["fine/trans"]) < NETWORK
    waypoint = PointFinder(case.sizes.side).find(logits)
    assert relative_error(waypoint, expected["fine/waypoint"]) < NETWORK
    heads = case.network.fine.heads
    assert heads is not None
    actual: dict[str, Any] = heads(heads.features(tokens, waypoint))
    both = torch.cat([actual["gripper"], actual["collision"]], -1)
    assert relative_error(both[:, None], expected["fine/feat_ex_rot"]) < NETWORK
    for axis in "xyz":
        assert relative_error(actual[axis][:, None], expected[f"fine/feat_{axis}"]) < NETWORK


def test_a_sequence_of_keyframes_has_the_golden_loss_and_gradients(case: Rendered) -> None:
    golden, norms = load("training"), meta()["training_grad_l2"]
    waypoints = torch.from_numpy(golden["waypoints"])[:, 0]
    case.network.zero_grad()
    logits = case.network.coarse_sequences(
        case.encoded_views("training", len(waypoints)), len(waypoints)
    )
    assert relative_error(logits[-1:], golden["last_heatmap"]) < NETWORK
    loss = heatmap_loss(logits, waypoints).mean()
    assert relative_error(loss, golden["loss"]) < NETWORK
    loss.backward()
    table = released_names(case.network.state_dict(), case.stages)
    targets = {pieces[0].path: name for name, pieces in table.items()}
    parameters = dict(case.network.named_parameters())
    assert norms
    for source, norm in norms.items():
        gradient = parameters[targets[source]].grad
        assert gradient is not None, source
        assert gradient.norm().item() == pytest.approx(norm, rel=GRADIENT), source
