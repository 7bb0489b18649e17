"""One look at the scene: transformer, decoder of heatmaps, and for the closer look the heads."""

import math

import torch
from torch import Tensor, nn

from mme_vla.backbone.sam2act.convex import ChannelNorm, ConvexUp
from mme_vla.backbone.sam2act.heatmaps import read_maps
from mme_vla.backbone.sam2act.sizes import SAM2ActSizes
from mme_vla.backbone.sam2act.transformer import SLOPE, MultiViewTransformer
from mme_vla.backbone.sam2act.views import VIEWS, project


class HeatmapDecoder(nn.Module):
    """Patch tokens and the encoder's finer maps → heatmap logits at the pictures' size."""

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        half, quarter = sizes.token // 2, sizes.token // 4
        self.side = sizes.side
        self.first, self.first_norm = ConvexUp(sizes.token, half), ChannelNorm(half)
        self.second, self.second_norm = ConvexUp(half, quarter), ChannelNorm(quarter)
        self.last = ConvexUp(quarter, 1)

    def forward(self, tokens: Tensor, fine: Tensor, middle: Tensor) -> Tensor:
        """Logits [n, 1, s, s] of tokens [n, token, g, g].

        Args:
            fine, middle: maps of the encoder, [n, token/4, 4g, 4g] and [n, token/2, 2g, 2g].
        """
        x = nn.functional.leaky_relu(self.first_norm(self.first(tokens) + middle), SLOPE)
        x = nn.functional.leaky_relu(self.second_norm(self.second(x) + fine), SLOPE)
        half = self.side // ConvexUp.RATIO
        x = nn.functional.interpolate(x, (half, half), mode="bilinear")
        logits: Tensor = self.last(x)
        return logits.float()


class Heads(nn.Module):
    """Rotation, gripper and collision from the closer look's tokens at the waypoint."""

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        width, self.bins, self.patch = sizes.feature, sizes.rotation_bins, sizes.patch
        self.gripper = _mlp(width, sizes.head, 4)
        self.norm = nn.BatchNorm1d(width)
        self.x, self.y, self.z = (_mlp(width, sizes.head, sizes.rotation_bins) for _ in range(3))
        self.rates: Tensor
        self.register_buffer("rates", code_rates(width), persistent=False)

    def compute_rates(self, device: torch.device) -> None:
        """Give the codes' rates their values, where the module was built on meta."""
        self.rates = code_rates(2 * len(self.rates)).to(device)

    def features(self, tokens: Tensor, waypoints: Tensor) -> Tensor:
        """What the heads read [b, f] of tokens [b·3, token, g, g] at waypoints [b, 3] of the closer look's cube."""
        batch, (token, grid) = len(waypoints), tokens.shape[1:3]
        by_view = tokens.view(batch, VIEWS, token, grid, grid)
        whole = by_view.amax((-2, -1)).transpose(1, 2).flatten(1)  # channel by channel
        pixels = project(waypoints, grid * self.patch) / self.patch  # b v 2
        there = read_maps(tokens, pixels.flatten(0, 1)[:, None]).view(batch, -1)  # view by view
        return torch.cat([whole, there], -1)

    def forward(self, features: Tensor, rotation: Tensor | None = None) -> dict[str, Tensor]:
        """Logits `gripper` [b, 2], `collision` [b, 2], and of each rotation bin `x`, `y`, `z` [b, bins].

        The bin about y is told what the one about x is, and the one about z both.

        Args:
            features: [b, f]. rotation: [b, 3] bins to tell; the most likely ones by default.
        """
        gripper, collision = self.gripper(features).chunk(2, -1)
        normed = self.norm(features)
        x = self.x(normed)
        told = normed + self.code(x.argmax(-1) if rotation is None else rotation[:, 0])
        y = self.y(told)
        told = told + self.code(y.argmax(-1) if rotation is None else rotation[:, 1])
        return {"gripper": gripper, "collision": collision, "x": x, "y": y, "z": self.z(told)}

    def code(self, bins: Tensor) -> Tensor:
        """Sines and cosines [b, f] of bins [b]."""
        angles = bins[:, None] * self.rates
        return torch.cat([angles.sin(), angles.cos()], -1)


class Branch(nn.Module):
    """A look: the transformer and the decoder; of the closer look the heads as well."""

    def __init__(self, sizes: SAM2ActSizes, with_heads: bool = False) -> None:
        super().__init__()
        self.transformer = MultiViewTransformer(sizes)
        self.decoder = HeatmapDecoder(sizes)
        self.heads = Heads(sizes) if with_heads else None


def _mlp(width: int, inner: int, out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(width, inner), nn.ReLU(), nn.Linear(inner, inner // 2), nn.ReLU(), nn.Linear(inner // 2, out)
    )


def code_rates(width: int) -> Tensor:
    """Rates [width/2] of the sines and cosines that tell a bin."""
    return torch.exp(torch.arange(0, width, 2) * (-math.log(10_000) / width))
