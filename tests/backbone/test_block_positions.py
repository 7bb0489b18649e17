"""Blocks may have positions of several coordinates."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.backbone.layers import Block, apply_custom_positions, rotation
from mme_vla.integration.context import Context
from mme_vla.types import MemoryTokens


def block(positions: Tensor | None, count: int = 3) -> Block:
    return Block(
        "images", torch.zeros(1, count, 4), torch.ones(1, count, dtype=torch.bool), "vlm", positions
    )


def test_equal_coordinates_are_one_position() -> None:
    positions = torch.tensor([[0, 1, 5]])
    base, several = rotation(positions, 8), rotation(positions[..., None].expand(-1, -1, 3), 8)
    assert torch.equal(base.cos, several.cos) and torch.equal(base.sin, several.sin)
    assert not torch.equal(
        base.cos, rotation(torch.tensor([[[0, 0, 0], [1, 2, 1], [5, 5, 4]]]), 8).cos
    )


def test_blocks_with_one_number_stand_beside_those_with_several() -> None:
    several = torch.tensor([[[7, 0, 0], [7, 0, 1], [7, 1, 0]]])
    positions = apply_custom_positions(torch.arange(6)[None], [block(None), block(several)])
    assert positions.tolist() == [[[0] * 3, [1] * 3, [2] * 3, *several[0].tolist()]]
    with pytest.raises(ValueError, match=r"\[2, 3\] coordinates"):
        apply_custom_positions(torch.arange(6)[None], [block(several[..., :2]), block(several)])


def test_the_backbone_reads_coordinates_of_image_tokens() -> None:
    policy = build_policy("pi05")
    assert isinstance(policy, MMEPolicy)
    with torch.no_grad():
        for parameter in policy.parameters():
            if not parameter.any():  # gates begin at zero
                parameter.normal_(std=0.5)
    batch = policy.full_batch()
    injection = policy.model.inject(policy.model.prepare_images(batch), None)
    images, *others = injection.blocks
    counted = torch.arange(len(images))[None, :, None].expand(-1, -1, 3)
    shifted = counted.clone()
    shifted[..., 1] += 3
    chunk, time = torch.ones(1, policy.horizon, policy.action_dim), torch.full((1,), 0.5)

    def velocity(positions: Tensor | None) -> Tensor:
        blocks = [replace(images, positions=positions), *others]
        hidden = policy.backbone.transformer(  # type: ignore[operator]
            [*blocks, policy.backbone.action_block(chunk)],  # type: ignore[operator]
            policy.backbone.transformer.layout(
                [*blocks, policy.backbone.action_block(chunk)], injection.visibility
            ),  # type: ignore[operator]
            policy.backbone.time_condition(time),  # type: ignore[operator]
            None,
        )
        return hidden

    with torch.no_grad():
        assert torch.equal(velocity(None), velocity(counted))
        assert not torch.equal(velocity(None), velocity(shifted))


class PlacedContext(Context):
    """Memory tokens at positions of three coordinates."""

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        made, *others = super().blocks(observation, memory)
        return [replace(made, positions=torch.zeros(1, len(made), 3)), *others]


@pytest.mark.parametrize(
    ("model", "backbone"),
    [("framesamp_context", "nano"), ("openvla_oft_framesamp_context", "openvla_tiny")],
)
def test_a_backbone_that_counts_tokens_itself_refuses_coordinates(
    model: str, backbone: str
) -> None:
    policy: Any = build_policy(model, backbone=backbone)
    policy.integration.__class__ = PlacedContext
    kind = type(policy.backbone).__name__
    with pytest.raises(
        UserError, match=rf"'memory' has positions \[1, \d+, 3\], and {kind} .*Allowed here"
    ):
        policy.sample_actions(policy.full_batch())
