"""Flow heads: chosen by `backbone.head.name`, own ones in one class."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mme_vla import register
from mme_vla.backbone.base import BackboneConfig, ExpertConfig, Injection, VisionConfig
from mme_vla.backbone.building import read_backbone
from mme_vla.backbone.flow import FlowHead
from mme_vla.backbone.layers import PI05_VISIBILITY
from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.types import Batch

SIZES = BackboneConfig(
    VisionConfig(16, 2, 16, 1, 32, 2),
    ExpertConfig(16, 32),
    ExpertConfig(16, 32),
    depth=1,
    head_dim=8,
    vocab_size=32,
    action_dim=4,
    horizon=3,
)


@register("head", "late_times")
class LateTimes(FlowHead):
    """Squares flow times and scales the loss."""

    def __init__(self, *, scale: float = 1.0, **options: Any) -> None:
        super().__init__(**options)
        self.scale = scale

    def training_noise(self, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        noise = super().training_noise(count, generator)
        return noise | {"time": noise["time"] ** 2}

    def loss(self, predict: Any, actions: Tensor, noise: Any) -> Tensor:
        return self.scale * super().loss(predict, actions, noise)


def built(head: dict[str, Any]) -> Pi05Backbone:
    torch.manual_seed(0)
    return Pi05Backbone(replace(SIZES, head=head)).eval()


def batch() -> Batch:
    generator = torch.Generator().manual_seed(0)
    return Batch(
        torch.rand(2, 1, 3, 16, 16, generator=generator),
        torch.ones(2, 1, dtype=torch.bool),
        torch.ones(2, 4).long(),
        torch.ones(2, 4, dtype=torch.bool),
        actions=torch.randn(2, 3, 4, generator=generator),
    )


def test_own_head_defines_noise_and_loss() -> None:
    default, custom = built({"name": "flow"}), built({"name": "late_times", "scale": 3.0})
    noise, late = (b.training_noise(2, torch.Generator().manual_seed(1)) for b in (default, custom))
    assert torch.equal(late["time"], noise["time"] ** 2)
    injection = Injection(default.embed(batch()), PI05_VISIBILITY)
    assert torch.allclose(
        custom.loss(batch(), injection, late), 3 * default.loss(batch(), injection, late)
    )


def test_clean_flow_reads_the_output_as_the_chunk() -> None:
    backbone = built({"name": "clean_flow"})
    x = torch.full((1, 3, 4), 0.5)
    times = backbone.head.times(10, x.device)
    velocity = backbone.head.velocity(lambda x_t, index: torch.zeros_like(x_t), times, {"noise": x})
    assert torch.allclose(velocity(x, 5), x / 0.5)


def test_sizes_without_a_head_mean_the_flow_of_pi05() -> None:
    section = {"name": "pi05", "time_distribution": "uniform"}
    kind, sizes = read_backbone(section)
    assert kind is Pi05Backbone and sizes.head == {"name": "flow"}
    assert built({"name": "flow"}).head.time_distribution == "beta"
