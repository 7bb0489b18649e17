"""OpenVLA-OFT at full size, on the meta device: names, shapes and adapters are the published ones
to the number.
"""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers.baselines import baselines_folder
from helpers.openvla_golden import WRAPPER
from mme_vla.extras.methods.openvla_oft.model import OpenVlaBackbone
from mme_vla.extras.methods.openvla_oft.weights import HEAD, STATE, VLA, openvla_name
from mme_vla.policy.build import build_policy
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.policy.mme import MMEPolicy

OFT = {"rank": 32, "alpha": 16.0, "init": "gaussian"}


@pytest.fixture(scope="module")
def published() -> dict[str, Any]:
    folder: Path = baselines_folder("openvla_oft")
    return json.loads((folder / "full_size_names.json").read_text())  # type: ignore[no-any-return]


def full_size() -> MMEPolicy:
    built = build_policy("openvla_oft", backbone="openvla", device="meta")
    assert isinstance(built, MMEPolicy)
    return built


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return full_size()


def named(policy: MMEPolicy) -> dict[str, list[int]]:
    return {
        str(openvla_name(name)): list(tensor.shape) for name, tensor in policy.state_dict().items()
    }


def test_names_and_shapes_are_the_published_ones(
    policy: MMEPolicy, published: dict[str, Any]
) -> None:
    groups = ((VLA, "base"), (HEAD, "action_head"), (STATE, "proprio_projector"))
    expected = {
        f"{prefix}{name}": shape
        for prefix, group in groups
        for name, shape in published[group].items()
    }
    assert named(policy) == expected


def test_parameters_are_counted_as_published(policy: MMEPolicy, published: dict[str, Any]) -> None:
    counts, backbone = published["counts"], policy.backbone
    assert isinstance(backbone, OpenVlaBackbone) and backbone.state_token is not None
    parts = {
        "total": backbone.vlm,
        "dino": backbone.vlm.vision.dino,
        "siglip": backbone.vlm.vision.siglip,
        "projector": backbone.vlm.projector,
        "llama": backbone.vlm.language,
        "action_head": backbone.head,
        "proprio_projector": backbone.state_token,
    }
    for name, module in parts.items():
        assert sum(p.numel() for p in module.parameters()) == counts[name], name


def test_adapters_are_the_published_ones_and_all_that_learns_beside_head_and_state(
    published: dict[str, Any],
) -> None:
    policy = full_size()
    with torch.device("meta"):
        learning = apply_finetuning(policy, "lora", freeze_vision=False, **OFT)
    shapes = {name: shape for name, shape in named(policy).items() if ".lora_" in name}
    assert shapes == {
        f"{VLA}{name.removeprefix(WRAPPER)}": shape for name, shape in published["lora"].items()
    }
    counts = published["counts"]
    assert learning["vision"] == counts["lora_vision"]
    assert learning["vlm"] == counts["lora_projector"] + counts["lora_llama"]
    assert learning["action"] == counts["action_head"] + counts["proprio_projector"]


def test_under_a_memory_the_towers_have_no_adapters(published: dict[str, Any]) -> None:
    policy = build_policy("openvla_oft_framesamp_context", backbone="openvla", device="meta")
    targets = [
        "projector.fc1",
        "projector.fc2",
        "projector.fc3",
        *policy.finetune_spec.lora_targets[-8:],
    ]
    with torch.device("meta"):
        learning = apply_finetuning(policy, "lora", targets=targets, **OFT)
    counts = published["counts"]
    assert learning["vision"] == 0
    assert learning["vlm"] == counts["lora_projector"] + counts["lora_llama"]
    # position layer and projection of the released encoder
    assert learning["memory"] == 590_592 + 12_062_720
