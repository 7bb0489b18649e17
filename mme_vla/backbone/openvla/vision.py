"""DINOv2 and SigLIP side by side, as Prismatic VLMs see: timm's vision transformers, one token a patch."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.backbone.openvla.sizes import FusedVisionConfig, TowerConfig


@dataclass(frozen=True)
class Standard:
    """Mean and standard deviation of each colour, for pictures in [0, 1]."""

    mean: Sequence[float]
    std: Sequence[float]

    def apply(self, pixels: Tensor) -> Tensor:
        """Standardise [..., 3, s, s]."""
        mean, std = (pixels.new_tensor(values)[:, None, None] for values in (self.mean, self.std))
        return (pixels - mean) / std


IMAGENET = Standard((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
OPENVLA = Standard((0.484375, 0.455078125, 0.40625), (0.228515625, 0.2236328125, 0.224609375))
"""ImageNet's numbers rounded to bfloat16, as OpenVLA's published processor holds them."""
HALF = Standard((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


class FusedVision(nn.Module):
    """Two towers on the same picture; a token is [DINOv2 | SigLIP] of one patch, row-major.

    Each gives what stands after its block before the last, without a norm: the last block, the final norm and SigLIP's
    pooling head are part of the published weights, and no action reads them.
    """

    def __init__(self, config: FusedVisionConfig, dino_standard: Standard = OPENVLA) -> None:
        super().__init__()
        size = {"img_size": config.image_size, "patch_size": config.patch_size}
        registers = {"class_token": True, "reg_tokens": 4, "no_embed_class": True, "init_values": 1e-5}
        self.dino = _tower(config.dino, global_pool="token", **size, **registers)
        self.siglip = _tower(config.siglip, global_pool="map", class_token=False, **size)
        self.dino_standard = dino_standard

    def standardised(self, images: Tensor) -> Tensor:
        """Pictures [..., 3, s, s] in [−1, 1] → six channels [..., 6, s, s]: DINOv2's, then SigLIP's."""
        pixels = (images + 1) / 2
        return torch.cat([self.dino_standard.apply(pixels), HALF.apply(pixels)], dim=-3)

    def forward(self, pixels: Tensor) -> Tensor:
        """Six channels [n, 6, s, s] → tokens [n, grid², d_dino + d_siglip]."""
        towers = (self.dino, self.siglip)
        return torch.cat([_patches(tower, x) for tower, x in zip(towers, pixels.split(3, dim=1), strict=True)], dim=-1)


def _tower(config: TowerConfig, **options: Any) -> nn.Module:
    from timm.models.vision_transformer import VisionTransformer

    return VisionTransformer(
        embed_dim=config.width,
        depth=config.depth,
        num_heads=config.num_heads,
        mlp_ratio=(config.mlp_dim + 0.5) / config.width,  # timm truncates the product: aim at the middle
        num_classes=0,
        norm_layer=partial(nn.LayerNorm, eps=1e-6),
        **options,
    )


def _patches(tower: Any, pixels: Tensor) -> Tensor:
    (tokens,) = tower.forward_intermediates(
        pixels, indices=[len(tower.blocks) - 2], norm=False, stop_early=True, output_fmt="NLC", intermediates_only=True
    )
    return tokens
