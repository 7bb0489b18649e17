"""LeRobot's π0.5 with its short-window memory: weights and inputs that follow from names, and what
it answered.

    # where a LeRobot is installed that has it: writes data/lerobot_window.json
    python -m helpers.lerobot_window

The option is newer than LeRobot 0.6.1, so what it computes is recorded. Recorded with
huggingface/lerobot#4076 as it stood on main in autumn 2026 (attention in space and time composed,
appendix C of MEM).
"""

import json
import zlib
from typing import Any

import numpy as np
import torch
from torch import Tensor

from helpers import REPOSITORY
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import small_policy
from mme_vla.types import Batch, HistoryTokens, PastViews
from mme_vla.weights.ports import LEROBOT_PREFIX, port_adapter

RECORDED = REPOSITORY / "tests" / "data" / "lerobot_window.json"
FRAMES, STRIDE, EVERY, STATE = 3, 5, 2, 8
SETTINGS = {
    "memory_frames": FRAMES,
    "memory_stride": STRIDE,
    "memory_temporal_attention_every": EVERY,
}
VISION = {"image_size": 32, "patch_size": 8, "width": 32, "depth": 3, "mlp_dim": 48, "num_heads": 2}
ONLY = {"both": (True, True), "views": (True, False), "states": (False, True)}
"""What is on: past views, past states."""


def window_policy(views: bool, states: bool, **changed: Any) -> MMEPolicy:
    """The policy of ours that computes the same; fresh weights."""
    memory = {"frames": FRAMES, "stride": STRIDE, "every": EVERY, "views": views, "states": states}
    backbone = {"num_heads": 8, "vision": VISION}
    into: Any = {"mutual": True} if states else "none"
    return small_policy(
        "spacetime_context", backbone=backbone, memory=memory | changed, integration=into
    )


def weights(policy: MMEPolicy) -> dict[str, Tensor]:
    """Tensors in LeRobot's names, each random with its name as the seed."""
    values = {}
    for name, shape in port_adapter(policy).shapes(policy.state_dict()).items():
        sampled = np.random.default_rng(zlib.crc32(name.encode())).normal(size=shape) * 0.1
        if "vision_tower" in name and name.endswith(
            ("layer_norm1.weight", "layer_norm2.weight", "layernorm.weight")
        ):
            sampled = sampled + 1
        values[LEROBOT_PREFIX + name] = torch.from_numpy(sampled.astype(np.float32))
    return values


def inputs() -> dict[str, Tensor]:
    """Clips [b, v, t, 3, s, s] uint8 of which one frame is not there, their states, words and
    noise.
    """
    rng, size = np.random.default_rng(0), VISION["image_size"]
    frame_mask = torch.ones(2, FRAMES, dtype=torch.bool)
    frame_mask[0, 0] = False
    prompt_mask = torch.ones(2, 7, dtype=torch.bool)
    prompt_mask[1, 5:] = False
    return {
        "clips": torch.from_numpy(
            rng.integers(0, 256, (2, 2, FRAMES, 3, size, size), dtype=np.uint8)
        ),
        "seen": frame_mask,
        "states": torch.from_numpy(rng.normal(size=(2, FRAMES, STATE)).astype(np.float32)),
        "words": torch.from_numpy(rng.integers(4, 64, (2, 7))),
        "said": prompt_mask,
        "noise": torch.from_numpy(rng.normal(size=(2, 20, 32)).astype(np.float32)),
    }


def as_batch(policy: MMEPolicy) -> Batch:
    """The inputs as our policy reads them."""
    tensors = inputs()
    clips = tensors["clips"].transpose(1, 2)  # b t v 3 s s
    memory = policy.require_memory()
    features = torch.zeros(2, memory.capacity, policy.backbone.vision_width)
    if memory.capacity:
        features[..., :STATE] = tensors["states"]
    mask = tensors["seen"][:, : memory.capacity]
    places = torch.zeros(*mask.shape, 3)
    past = (
        PastViews(clips[:, :-1], tensors["seen"][:, :-1], EVERY)
        if memory.past_view_spec is not None
        else None
    )
    return Batch(
        images=clips[:, -1],
        image_mask=torch.ones(2, 2, dtype=torch.bool),
        prompt=tensors["words"] * tensors["said"],
        prompt_mask=tensors["said"],
        history=HistoryTokens(features, places, mask, torch.full((2,), 20)),
        past=past,
    )


def their_chunk(views: bool, states: bool) -> Tensor:
    """What LeRobot's policy returns, [b, h, a]."""
    import pytest

    from helpers.lerobot_pi05 import reduce_sizes

    policy, arguments = window_policy(views, states), inputs()
    with pytest.MonkeyPatch.context() as patch:
        lerobot_module = reduce_sizes(patch, policy.backbone.config)
        config = lerobot_module.PI05Config(
            use_visual_memory=views,
            use_proprioceptive_memory=states,
            chunk_size=policy.horizon,
            n_action_steps=1,
            device="cpu",
            image_resolution=(VISION["image_size"],) * 2,
            **SETTINGS,
        )
        model = lerobot_module.PI05Pytorch(config).eval()
        tensors = {
            name.removeprefix(LEROBOT_PREFIX): tensor for name, tensor in weights(policy).items()
        }
        missing, unexpected = model.load_state_dict(tensors, strict=False)
        assert not unexpected and all(
            "embed_tokens" in name or "lm_head" in name for name in missing
        ), missing
        clips = arguments["clips"].float() / 127.5 - 1
        images = [clips[:, view] if views else clips[:, view, -1] for view in range(2)]
        masks = [arguments["seen"] if views else torch.ones(2, dtype=torch.bool)] * 2
        proprio = torch.nn.functional.pad(arguments["states"], (0, 32 - STATE))
        of_states = {"states": proprio, "state_masks": arguments["seen"]} if states else {}
        with torch.no_grad():
            chunk: Tensor = model.sample_actions(
                images,
                masks,
                arguments["words"] * arguments["said"],
                arguments["said"],
                noise=arguments["noise"],
                **of_states,
            )
    return chunk


def main() -> None:
    chunks = {
        only: their_chunk(*on).double().numpy().round(6).tolist() for only, on in ONLY.items()
    }
    RECORDED.write_text(json.dumps(chunks) + "\n")


if __name__ == "__main__":
    main()
