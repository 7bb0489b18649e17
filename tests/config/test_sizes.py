"""An impossible size of a network is refused under the key that sets it."""

from collections.abc import Mapping
from typing import Any

import pytest

from mme_vla.backbone.base import BackboneConfig
from mme_vla.config.sections import read_section
from mme_vla.errors import UserError
from mme_vla.extras.methods.memoryvla.model import MemoryVlaConfig
from mme_vla.extras.methods.openvla_oft.config import OpenVlaConfig
from mme_vla.extras.nano.backbone import NanoConfig
from mme_vla.integration.context import MemoryExpert

TOWER = {"width": 8, "depth": 2, "mlp_dim": 8, "num_heads": 2}


@pytest.mark.parametrize(
    ("config", "section", "message"),
    [
        (
            BackboneConfig,
            {"vision": {"image_size": 225}},
            r"backbone\.vision\.image_size=225 must be a multiple of",
        ),
        (
            BackboneConfig,
            {"action": {"width": 16, "mlp_dim": -1}},
            r"backbone\.action\.mlp_dim=-1 must be at least 1",
        ),
        (
            NanoConfig,
            {"vlm": {"width": 0, "mlp_dim": 16}},
            r"backbone\.vlm\.width=0 must be at least 1",
        ),
        (
            NanoConfig,
            {"vision": {"width_8": 9}},
            r"backbone\.vision\.width_8=9 must be a multiple of",
        ),
        (
            OpenVlaConfig,
            {"vision": {"patch_size": 0}},
            r"backbone\.vision\.patch_size=0 must be at least 1",
        ),
        (
            OpenVlaConfig,
            {"vision": {"dino": TOWER | {"depth": 1}}},
            r"backbone\.vision\.dino\.depth=1 has no block",
        ),
        (
            OpenVlaConfig,
            {"vision": {"siglip": TOWER | {"width": 9}}},
            r"backbone\.vision\.siglip\.width=9 must be a",
        ),
        (OpenVlaConfig, {"vlm": {"width": 96}}, r"backbone\.vlm\.width=96 must be a multiple of"),
        (MemoryVlaConfig, {"vlm": {"depth": 0}}, r"backbone\.vlm\.depth=0 must be at least 1"),
        (
            MemoryVlaConfig,
            {"head": {"num_heads": 3}},
            r"backbone\.head\.width=1024 must be a multiple of",
        ),
    ],
)
def test_an_impossible_size_names_its_key(
    config: type, section: Mapping[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        read_section(config, section, "backbone")


@pytest.mark.parametrize("key", ["width", "mlp_dim"])
def test_an_impossible_size_of_the_memory_expert_names_its_key(key: str) -> None:
    with pytest.raises(UserError, match=rf"integration\.{key}=0 must be at least 1"):
        MemoryExpert(BackboneConfig(), **{key: 0})
