"""Building blocks of backbone, memory and integration equal the released implementation, piece by
piece.
"""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch

from helpers.golden import error, load, params, vision_config
from mme_vla.backbone import flow
from mme_vla.backbone.base import BackboneConfig, ExpertConfig
from mme_vla.backbone.gemma import JointBlock
from mme_vla.backbone.layers import (
    AdaRMSNorm,
    RMSNorm,
    Span,
    additive_mask,
    attend,
    attention_mask,
    rms_normalise,
    rotary_positions,
    rotate,
    rotation,
)
from mme_vla.backbone.siglip import VisionTower, pool_grid
from mme_vla.integration.base import MEMORY_VISIBILITY
from mme_vla.integration.modulator import ModulatorLayer
from mme_vla.memory.base import FeatureEncoder, position_features, token_positions
from mme_vla.weights.tables import Piece, linear, prefixed, read

TOLERANCE = 1e-4


@pytest.fixture
def unit(parity):
    """Return a function that loads one golden file."""
    return partial(load, parity)


def vision_tower(tensors, about, resolution: int, output_dim: int) -> VisionTower:
    """A golden vision tower, its parameters read through the backbone's own name table."""
    from mme_vla.weights.names.jax_backbone import _vision

    vision = vision_config(about, resolution)
    sizes = ExpertConfig(output_dim, 8)
    tower = VisionTower(vision, output_dim)
    config = BackboneConfig(vision=vision, vlm=sizes, action=sizes)
    tower.vit.load_state_dict(read(_vision(config), params(tensors, "PaliGemma/img/")), strict=True)
    return tower.eval()


@torch.no_grad()
def test_vision_tower(unit):
    tensors, about = unit("unit_siglip")
    tower = vision_tower(tensors, about, about["res"], about["output_dim"])
    images = tensors["in/image"].permute(0, 3, 1, 2)
    outputs = {}
    tower.vit.blocks[0].register_forward_hook(
        lambda m, i, o: outputs.update(embedded=i[0], block0=o)
    )
    tower.vit.norm.register_forward_hook(lambda m, i, o: outputs.update(encoded=o))
    assert error(tower(images), tensors["out/tokens"]) <= TOLERANCE
    assert error(outputs["embedded"], tensors["out/with_posemb"]) <= TOLERANCE
    assert error(outputs["block0"], tensors["out/block0"]) <= TOLERANCE
    assert error(outputs["encoded"], tensors["out/encoded"]) <= TOLERANCE


@torch.no_grad()
def test_norms(unit):
    tensors, _ = unit("unit_norms")
    x, condition = tensors["in/x"], tensors["in/cond"]
    norm = RMSNorm(x.shape[-1])
    norm.load_state_dict({"scale": tensors["params/rmsnorm/scale"]})
    assert error(norm(x)[0], tensors["out/rmsnorm"]) <= TOLERANCE
    adaptive = AdaRMSNorm(x.shape[-1], condition.shape[-1])
    adaptive.load_state_dict(read(prefixed("dense", linear("adarms/Dense_0")), params(tensors)))
    out, gate = adaptive(x, condition)
    assert error(out, tensors["out/adarms"]) <= TOLERANCE
    assert error(gate, tensors["out/adarms_gate"]) <= TOLERANCE
    of_memory = read(linear("memory_rmsnorm/Dense_0"), params(tensors))
    a, beta = torch.nn.functional.linear(
        tensors["in/cond_per_token"], of_memory["weight"], of_memory["bias"]
    ).chunk(2, -1)
    assert error(rms_normalise(x) * (1 + a) + beta, tensors["out/memory_rmsnorm"]) <= TOLERANCE


def test_rotary_embedding_takes_any_position(unit):
    tensors, _ = unit("unit_rope")
    x = tensors["in/x"]
    assert (
        error(rotate(x, rotation(tensors["in/positions"], x.shape[-1])), tensors["out/y"])
        <= TOLERANCE
    )


def joint_block(tensors, about) -> JointBlock:
    """Two experts' attention of a golden unit as one of our blocks (norms and MLPs stay fresh and
    unused).
    """
    config = BackboneConfig(
        num_heads=about["num_heads"], num_kv_heads=about["num_kv_heads"], head_dim=about["head_dim"]
    )
    experts = {"vlm": ExpertConfig(about["w"][0], 8), "action": ExpertConfig(about["w"][1], 8)}
    block = JointBlock(config, experts, "action", last=False)
    heads, kv = (
        {"n": about["num_heads"], "h": about["head_dim"]},
        {"two": 2, "k": about["num_kv_heads"]},
    )
    for expert, suffix in (("vlm", ""), ("action", "_1")):
        q = Piece(f"q_einsum{suffix}/w", "n d h -> (n h) d", heads)
        k = Piece(
            f"kv_einsum{suffix}/w", "two k d h -> (two k h) d", {**kv, "h": about["head_dim"]}
        )
        out = Piece(f"attn_vec_einsum{suffix}/w", "n h d -> d (n h)", heads)
        weights = read({"qkv.weight": [q, k], "out.weight": [out]}, params(tensors))
        assert not block.experts[expert].load_state_dict(weights, strict=False).unexpected_keys
    return block


@torch.no_grad()
def test_joint_attention_with_cache_and_a_fully_masked_row(unit):
    tensors, about = unit("unit_attention")
    block = joint_block(tensors, about)
    rope = rotation(tensors["in/positions"], about["head_dim"])
    q, k, v = [], [], []
    for expert, x in (("vlm", tensors["in/x0"]), ("action", tensors["in/x1"])):
        projected = block.experts[expert].qkv(x).unflatten(-1, (-1, about["head_dim"]))
        parts = projected.split(
            [about["num_heads"], about["num_kv_heads"], about["num_kv_heads"]], dim=-2
        )
        for full, part in zip((q, k, v), parts, strict=True):
            full.append(part)
    keys, values = rotate(torch.cat(k, 1), rope), torch.cat(v, 1)
    assert error(keys, tensors["out/k"]) <= TOLERANCE
    assert error(values, tensors["out/v"]) <= TOLERANCE
    mask, split = tensors["in/mask"], about["len"]
    queries = rotate(torch.cat(q, 1), rope)
    y0, y1 = attend(queries, keys, values, additive_mask(mask, torch.float32)).split(split, 1)
    assert not mask.any(-1).all(), "the golden mask should hold a row that sees nothing"
    assert error(block.experts["vlm"].out(y0), tensors["out/y0"]) <= TOLERANCE
    assert error(block.experts["action"].out(y1), tensors["out/y1"]) <= TOLERANCE
    last = attend(
        queries[:, split[0] :], keys, values, additive_mask(mask[:, split[0] :], torch.float32)
    )
    assert error(block.experts["action"].out(last), tensors["out/y_last_from_cache"]) <= TOLERANCE


def test_boolean_mask_backend_matches_on_rows_that_see_a_key(unit):
    tensors, about = unit("unit_attention")
    generator = torch.Generator().manual_seed(0)
    b, n, heads, h = 2, tensors["in/mask"].shape[1], about["num_heads"], about["head_dim"]
    counts = (heads, about["num_kv_heads"], about["num_kv_heads"])
    q, k, v = (torch.randn(b, n, count, h, generator=generator) for count in counts)
    mask = tensors["in/mask"]
    sees = mask.any(-1)
    exact = attend(q, k, v, additive_mask(mask, torch.float32))
    fast = attend(q, k, v, mask[:, None])
    assert error(fast[sees], exact[sees]) <= TOLERANCE


def released_attention_mask(block_start, no_attend, valid):
    """Mask from released flags: a new block wherever a flag starts one or the
    no-attend flag turns.
    """
    cumulative = np.cumsum(block_start)
    starts_block = np.concatenate(
        [[True], (np.diff(cumulative) != 0) | (np.diff(no_attend.astype(int)) != 0)]
    )
    starts = [*np.nonzero(starts_block)[0], len(cumulative)]
    spans = [Span(str(i), int(b - a)) for i, (a, b) in enumerate(pairwise(starts))]
    first_image = int(np.argmax(no_attend)) if no_attend.any() else len(cumulative)
    table = {
        str(i): {
            str(j)
            for j, key in enumerate(starts[:-1])
            if cumulative[key] <= cumulative[query]
            and not (no_attend[query] and no_attend.any() and key < first_image)
        }
        for i, query in enumerate(starts[:-1])
    }
    return attention_mask(spans, spans, valid, valid, table), table


def test_masks_and_positions_of_arbitrary_blocks(unit):
    tensors, about = unit("unit_masks")
    for case in about["cases"]:
        valid, flags = tensors[f"{case}/input_mask"], tensors[f"{case}/ar_mask"].numpy()
        no_attend = tensors.get(
            f"{case}/na_mask", torch.zeros(len(flags), dtype=torch.bool)
        ).numpy()
        mask, _ = released_attention_mask(flags, no_attend, valid)
        assert torch.equal(mask, tensors[f"{case}/attn_mask"]), case
        assert torch.equal(rotary_positions(valid).int(), tensors[f"{case}/positions"]), case


def test_visibility_table_is_the_released_rule(parity):
    """The named table gives, token for token, the mask of every golden model that has memory in its
    sequence.
    """
    files = sorted(parity.glob("model_*-context.safetensors")) + sorted(
        parity.glob("model_*-expert.safetensors")
    )
    if not files:
        pytest.skip(f"no golden context or expert model in {parity}")
    for file in files:
        tensors, about = load(parity, file.stem)
        patches = (about["image_resolution"] // about["siglip"]["patch"]) ** 2
        lengths = {
            "memory": about["history_config"]["budget"],
            "images": 2 * patches,
            "prompt": about["max_token_len"],
            "action": about["action_horizon"],
        }
        spans = [Span(name, length) for name, length in lengths.items()]
        valid = tensors["out/input_mask"]
        assert torch.equal(
            attention_mask(spans, spans, valid, valid, MEMORY_VISIBILITY), tensors["out/attn_mask"]
        )
        assert torch.equal(rotary_positions(valid).int(), tensors["out/positions"])


def test_position_features(unit):
    tensors, _ = unit("unit_posemb3d")
    for key in (k for k in tensors if k.startswith("out/")):
        dim, grid = (int(part.lstrip("dimgr")) for part in key.removeprefix("out/").split("_"))
        for row, frame in enumerate(tensors[f"in/dim{dim}_frames"].tolist()):
            indices = np.stack([np.full(grid**2, frame), np.arange(grid**2)], 1)
            actual = position_features(torch.from_numpy(token_positions(indices, grid)), dim)
            assert error(actual, tensors[key][row]) <= TOLERANCE, key


def test_pooling(unit):
    tensors, _ = unit("unit_pool")
    for key in (k for k in tensors if k.startswith("out/p")):
        tokens, _, kind = key.removeprefix("out/p").partition("_")
        actual = pool_grid(tensors["in/tokens"], round(int(tokens) ** 0.5), kind or "mean")
        assert error(actual, tensors[key]) <= TOLERANCE, key


@torch.no_grad()
def test_feature_encoder(unit):
    tensors, _ = unit("unit_feature_encoder")
    weights = read(
        prefixed("position", linear("pos_proj")) | prefixed("project", linear("encoder_static")),
        params(tensors),
    )
    hidden, position_dim = weights["position.weight"].shape
    d_vision = tensors["in/image"].shape[-1]
    encoder = FeatureEncoder(d_vision, len(weights["project.bias"]), position_dim, hidden)
    encoder.load_state_dict(weights)
    assert (
        error(encoder.encode(tensors["in/image"], tensors["in/pos"]), tensors["out/y"]) <= TOLERANCE
    )


@torch.no_grad()
def test_modulator(unit):
    tensors, about = unit("unit_modulator")
    layer = ModulatorLayer(
        about["width"], about["num_heads"], about["num_kv_heads"], about["head_dim"], False
    )
    heads, kv = (
        {"n": about["num_heads"], "h": about["head_dim"]},
        {"two": 2, "k": about["num_kv_heads"]},
    )
    table = {
        "norm.scale": [Piece("mem_attn/mem_rms_norm/scale")],
        "q.weight": [Piece("mem_attn/q_einsum_mem/w", "n d h -> (n h) d", heads)],
        "kv.weight": [
            Piece(
                "mem_attn/kv_einsum_mem/w",
                "two k d h -> (two k h) d",
                {**kv, "h": about["head_dim"]},
            )
        ],
        "out.weight": [Piece("mem_attn/out_einsum_mem/w", "n h d -> d (n h)", heads)],
    } | prefixed("modulation", linear("mem_rms_norm_ffn/Dense_0"))
    layer.load_state_dict(read(table, params(tensors)))
    positions = torch.arange(tensors["in/memory"].shape[1])[None]
    k, v = layer.keys_values(tensors["in/memory"], rotation(positions, layer.head_dim))
    mask = additive_mask(tensors["in/memory_mask"][:, None], torch.float32)
    x = tensors["in/x"]
    after = torch.arange(k.shape[1], k.shape[1] + x.shape[1])[None]
    rope = rotation(after, layer.head_dim)
    normed = layer.norm(x)[0]
    assert error(layer.read_memory(normed, k, v, mask, rope), tensors["out/r"]) <= TOLERANCE
    assert error(layer(x, k, v, mask, rope, layer.norm.factor), tensors["out/x_hat"]) <= TOLERANCE


def test_time_embedding(unit):
    tensors, _ = unit("unit_time_embedding")
    for key in (k for k in tensors if k.startswith("out/")):
        actual = flow.time_embedding(tensors["in/time"], int(key.removeprefix("out/dim")))
        assert error(actual, tensors[key]) <= 1e-3, key
