"""Raw frames → resize → vision tower → pooling → selection equals the released memory buffer,
online and offline.
"""

import json

import numpy as np
import pytest
import torch

from helpers.golden import error, load, params, vision_config
from mme_vla.backbone.base import BackboneConfig, ExpertConfig
from mme_vla.backbone.siglip import VisionTower, pool_grid
from mme_vla.memory.base import position_features
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.memory.history import OnlineHistory
from mme_vla.memory.tokendrop import TokenDrop, most_changed, ranked_patches
from mme_vla.memory.ttt import TTT
from mme_vla.processing.images import resize_with_pad
from mme_vla.types import FrameBatch
from mme_vla.weights.names.jax_backbone import _vision
from mme_vla.weights.tables import read

TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def buffer(parity):
    return load(parity, "unit_memory_buffer")


@pytest.fixture(scope="module")
def tokens(buffer):
    """Unpooled tokens [t, 256, d] of every golden frame."""
    tensors, about = buffer
    image_params = params(tensors, "PaliGemma/img/")
    kernel = image_params["PaliGemma/img/embedding/kernel"]
    heads = image_params[
        "PaliGemma/img/Transformer/encoderblock/MultiHeadDotProductAttention_0/query/bias"
    ].shape[1]
    fc = image_params["PaliGemma/img/Transformer/encoderblock/MlpBlock_0/Dense_0/bias"]
    side = round(image_params["PaliGemma/img/pos_embedding"].shape[1] ** 0.5)
    sizes = {
        "width": kernel.shape[-1],
        "depth": len(fc),
        "mlp_dim": fc.shape[1],
        "num_heads": heads,
    }
    vision = vision_config({**sizes, "patch": len(kernel)}, side * len(kernel))
    tower = VisionTower(vision, about["img_dim"])
    widths = ExpertConfig(about["img_dim"], 8)
    tower.vit.load_state_dict(
        read(_vision(BackboneConfig(vision=vision, vlm=widths, action=widths)), image_params)
    )
    with torch.no_grad():
        return tower.eval()(resize_with_pad(tensors["in/frames"], vision.image_size))


def history_of(memory, frames, tokens, until: int) -> OnlineHistory:
    """An online history fed one frame at a time up to and including `until`."""
    history = OnlineHistory(memory.storage, memory.make_scorer())
    pooled = pool_grid(tokens, memory.storage.grid)
    for t in range(until + 1):
        stored = history.to_encode(1) + t
        history.take(FrameBatch.of(frames[t : t + 1]), lambda _, made=pooled[stored]: made)
    return history


def memories(about):
    options = {
        "d_vision": about["img_dim"],
        "width": 8,
        "budget": about["budget"],
        "position_dim": about["pos_dim"],
    }
    return {
        "token_drop": TokenDrop(**options, stride=about["stride"], candidates=about["keptsize"]),
        "frame_sampling": FrameSamp(**options, grid=round(about["tpi"] ** 0.5)),
    }


def test_online_selection_is_exact(buffer, tokens):
    tensors, about = buffer
    frames = tensors["in/frames"].numpy()
    memory = memories(about)
    for entry in about["online"]:
        step = entry["step"]
        dropped = memory["token_drop"].select(
            history_of(memory["token_drop"], frames, tokens, step), step
        )
        assert dropped.tolist() == [[f, p] for f, _, p in entry["token_drop"]], step
        sampled = memory["frame_sampling"].select(
            history_of(memory["frame_sampling"], frames, tokens, step), step
        )
        assert sorted(set(sampled[:, 0].tolist())) == entry["frames"], step


def test_selected_tokens_and_positions(buffer, tokens):
    tensors, about = buffer
    frames = tensors["in/frames"].numpy()
    steps = sorted(
        {int(k.split("/")[1].removeprefix("step")) for k in tensors if k.startswith("out/step")}
    )
    for kind, memory in memories(about).items():
        for step in steps:
            recalled = memory.gather_selection(history_of(memory, frames, tokens, step), step)
            key = f"out/step{step}/{kind}"
            assert torch.equal(recalled.mask, tensors[f"{key}/mask"])
            assert error(recalled.features, tensors[f"{key}/image_emb"]) <= TOLERANCE
            position = (
                position_features(recalled.positions, about["pos_dim"]) * recalled.mask[:, None]
            )
            assert error(position, tensors[f"{key}/pos_emb"]) <= TOLERANCE


def recurrent(about, entry) -> TTT:
    """A recurrent memory with the golden limits; which frames it reads does not depend on its
    layer.
    """
    limits = {
        "max_steps": entry["max_steps"],
        "max_video": entry["max_video"],
        "stride": about["recurrent_horizon"],
    }
    return TTT(about["img_dim"], 8, budget=64, hidden=8, position_dim=about["pos_dim"], **limits)


def test_recurrent_selection_is_exact(buffer, tokens):
    tensors, about = buffer
    frames = tensors["in/frames"].numpy()
    for entry in about["recurrent"]:
        memory = recurrent(about, entry)
        history = history_of(memory, frames, tokens, entry["step"])
        history.exec_start = entry["exec_start"]
        selected = memory.select(history, entry["step"])
        patches = memory.storage.grid**2
        assert selected.tolist() == [[f, p] for f in entry["indices"] for p in range(patches)], (
            entry["step"]
        )
        key = f"out/recurrent_step{entry['step']}_exec{entry['exec_start']}"
        if f"{key}/mask" in tensors:
            recalled = memory.gather_selection(history, entry["step"])
            assert torch.equal(
                recalled.mask.unflatten(0, (-1, patches)).all(-1), tensors[f"{key}/mask"]
            )
            assert error(recalled.features, tensors[f"{key}/image_emb"].flatten(0, 2)) <= TOLERANCE
            position = (
                position_features(recalled.positions, about["pos_dim"]) * recalled.mask[:, None]
            )
            assert error(position, tensors[f"{key}/pos_emb"].flatten(0, 2)) <= TOLERANCE


def test_pooled_tokens_of_a_frame(buffer, tokens):
    tensors, _ = buffer
    for key in (k for k in tensors if k.startswith("out/frame")):
        frame, grid = int(key.split("/")[1].removeprefix("frame")), int(key.rsplit("x", 1)[1])
        assert error(pool_grid(tokens[frame : frame + 1], grid), tensors[key]) <= TOLERANCE, key


def test_full_episode_selection_is_exact(buffer, tokens):
    """The released offline rule: the whole episode competes for the heap, the step filters
    afterwards.
    """
    tensors, about = buffer
    memory = memories(about)["token_drop"]
    scores = history_of(memory, tensors["in/frames"].numpy(), tokens, about["frames"] - 1).scores
    ranked = ranked_patches(scores, memory.storage.grid**2, about["keptsize"])
    assert ranked.tolist() == [[f, p] for f, _, p in about["offline_kept_indices_ascending_score"]]
    for entry in about["offline"]:
        frames = most_changed(ranked, entry["step"], entry["budget"])
        assert frames.tolist() == [[f, p] for f, _, p in entry["token_drop"]], (
            entry["step"],
            entry["budget"],
        )


def test_frame_sampling_indices(parity):
    from mme_vla.memory.framesamp import evenly_spaced_frames

    about = json.loads((parity / "unit_sampling_indices.json").read_text())
    for entry in about["frame_sampling"]:
        frames = evenly_spaced_frames(entry["step"], entry["n_frames"])
        assert isinstance(frames, np.ndarray)
        assert frames.tolist() == entry["indices"], entry["step"]
