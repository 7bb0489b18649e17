"""Recurrent memory alone equals the released implementation: which frames, TTT, RMT."""

import json
from functools import partial

import numpy as np
import pytest
import torch

from helpers.golden import error, load, params
from mme_vla.memory.recurrent import recurrent_frames
from mme_vla.memory.rmt import RMTLayer
from mme_vla.memory.ttt import TTTLayer
from mme_vla.weights.names.jax_memory import layer_names, rotary_table
from mme_vla.weights.tables import read

TOLERANCE = 1e-4
BF16_TOLERANCE = 2e-2


@pytest.fixture
def unit(parity):
    """Return a function that loads one golden file."""
    return partial(load, parity)


def test_recurrent_frames(parity):
    for entry in json.loads((parity / "unit_sampling_indices.json").read_text())[
        "recurrent_sampling"
    ]:
        limits = (entry["max_steps"], entry["max_video"], entry["horizon"])
        frames = recurrent_frames(entry["step"], entry["exec_start"], *limits)
        assert isinstance(frames, np.ndarray)
        assert frames.tolist() == entry["indices"], entry


@pytest.fixture
def ttt(unit):
    """The golden layer, with a window that holds every frame's output."""
    tensors, about = unit("unit_ttt")
    budget = about["steps"] * about["tokens"]
    rates = (about["base_lr"], about["max_lr"], about["max_grad_norm"])
    layer = TTTLayer(about["hidden"], about["ttt_heads"], budget, about["tokens"], *rates)
    layer.load_state_dict(read(layer_names(layer, ""), params(tensors, "/")))
    assert layer.rate_constant == pytest.approx(float(tensors["params/ttt_base_lr_inv"]), abs=1e-6)
    return layer, tensors, about


@torch.no_grad()
@pytest.mark.parametrize("chunk", [1, 3, 8])
def test_ttt_outputs_and_fast_weights(ttt, chunk):
    layer, tensors, _ = ttt
    x, valid = tensors["in/x"], tensors["in/mask"]
    state = layer.initial(len(x))
    for part, real in zip(x.split(chunk, 1), valid.split(chunk, 1), strict=True):
        state, _ = layer.advance(state, part, real)
    assert error(state[0], tensors["out/W1_final"]) <= TOLERANCE
    assert error(state[1], tensors["out/b1_final"]) <= TOLERANCE
    tokens, mask = layer.read(state)
    assert error(tokens, tensors["out/y"]) <= TOLERANCE
    assert torch.equal(mask, valid.repeat_interleave(x.shape[2], 1))


@torch.no_grad()
def test_ttt_step_sizes_and_clipping(ttt):
    layer, tensors, about = ttt
    x, valid = tensors["in/x"], tensors["in/mask"]
    _, numbers = layer.advance(layer.initial(len(x)), x, valid, statistics=True)
    assert error(numbers["step_size"][valid], tensors["stats/eta_mean"].mean(1)[valid]) <= TOLERANCE
    assert float(numbers["clipped_rates"].mean()) == pytest.approx(
        about["fraction_eta_above_max_lr"], abs=1e-6
    )
    golden = torch.stack([tensors["stats/grad_w_norm"], tensors["stats/grad_b_norm"]])
    clipped = (golden > about["max_grad_norm"]).float().mean((0, 2))
    assert error(numbers["clipped_gradients"][valid], clipped[valid]) <= TOLERANCE
    assert (numbers["inner_loss_after"][valid] < numbers["inner_loss_before"][valid]).all()


def rmt(tensors, about, **options) -> torch.Tensor:
    """The golden layer's slots after the last frame."""
    layer = RMTLayer(
        about["hidden"], about["rmt_heads"], about["rmt_kv"], about["budget"], **options
    )
    layer.load_state_dict(read(layer_names(layer, ""), params(tensors, "/")))
    x = tensors["in/x"]
    return layer.read(layer.advance(layer.initial(len(x)), x, tensors["in/mask"])[0])[0]


@torch.no_grad()
def test_rmt_slots(unit):
    tensors, about = unit("unit_rmt")
    assert (
        error(rmt(tensors, about, attention_dtype="float32"), tensors["out/memory_f32attn"])
        <= TOLERANCE
    )


@torch.no_grad()
def test_rmt_slots_with_the_released_cast(unit):
    tensors, about = unit("unit_rmt")
    assert error(rmt(tensors, about), tensors["out/memory"]) <= BF16_TOLERANCE


@torch.no_grad()
def test_rmt_slots_with_cosines_only(unit):
    tensors, about = unit("unit_rmt")
    slots = rmt(tensors, about, attention_dtype="float32", rotation="cosine_only")
    assert error(slots, tensors["out/memory_f32attn_realrope"]) <= TOLERANCE


def test_rotary_table_is_the_released_constant(unit):
    tensors, about = unit("unit_rmt")
    table = rotary_table(
        2 * (about["tokens"] + about["budget"]), about["hidden"] // about["rmt_heads"]
    )
    assert error(table.real, tensors["out/freqs_cos"]) <= TOLERANCE
    assert error(table.imag, tensors["out/freqs_sin"]) <= TOLERANCE
