"""Pictures as keypoints: torchvision's ResNet-18 with group norms, and a spatial softmax over its last map."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from mme_vla.errors import missing_extra

if TYPE_CHECKING:
    from torch.nn import GroupNorm

CHANNELS = 512
"""Of ResNet-18's last stage."""


def picture_encoder() -> nn.Sequential:
    """ResNet-18 without pooling and classifier, fresh, a group norm of 16 channels a group for each batch norm.

    Pictures [n, 3, H, W] → [n, 512, ⌈H/32⌉, ⌈W/32⌉].

    Raises:
        UserError: torchvision is not installed.
    """
    try:
        from torchvision.models import resnet18
    except ImportError:
        raise missing_extra("Diffusion Policy", "baselines") from None

    def norm(channels: int) -> "GroupNorm":
        return nn.GroupNorm(channels // 16, channels)

    return nn.Sequential(*list(resnet18(weights=None, norm_layer=norm).children())[:8])


def map_size(side: int) -> int:
    """Cells of the encoder's map along a side of so many pixels: halved five times, rounded up."""
    for _ in range(5):
        side = -(-side // 2)
    return side


def cell_centres(height: int, width: int, device: torch.device | None = None) -> Tensor:
    """(x, y) of each cell of a map in [−1, 1], row by row: [height·width, 2]."""
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height, device=device), torch.linspace(-1, 1, width, device=device), indexing="ij"
    )
    return torch.stack([x.flatten(), y.flatten()], dim=-1)


class SpatialSoftmax(nn.Module):
    """Maps [n, c, H, W] → the expected place (x, y) of each of k learned features, [n, k, 2] in [−1, 1]."""

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.nets = nn.Conv2d(channels, keypoints, 1)

    def forward(self, features: Tensor) -> Tensor:
        maps = self.nets(features)
        weights = maps.flatten(2).softmax(-1)
        height, width = maps.shape[-2:]
        return weights @ cell_centres(height, width, maps.device).to(weights)


def keypoint_pool(keypoints: int) -> nn.Sequential:
    """Maps → [n, 2·keypoints]: x0, y0, x1, … As trained, a ReLU follows: what lies left or above has a 0 there."""
    return nn.Sequential(SpatialSoftmax(CHANNELS, keypoints), nn.Flatten(), nn.ReLU())
