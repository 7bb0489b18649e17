"""SigLIP: timm's vision transformer with the released model's dtype rules, and pooling."""

from functools import partial
from typing import Any, Self

import torch
from torch import Tensor, nn

from mme_vla.backbone.base import VisionConfig
from mme_vla.backbone.layers import compute_dtype
from mme_vla.errors import UserError
from mme_vla.speed import fused_kernels


class VisionTower(nn.Module):
    """Images [n, 3, s, s] in [−1, 1] → tokens [n, patches, d_out], row-major; not pooled, a linear
    head on each.
    """

    def __init__(self, config: VisionConfig, output_dim: int) -> None:
        """Build the tower; `output_dim` is the width of the head, the VLM's."""
        from timm.models.vision_transformer import VisionTransformer

        super().__init__()
        self.vit = VisionTransformer(
            img_size=config.image_size,
            patch_size=config.patch_size,
            embed_dim=config.width,
            depth=config.depth,
            num_heads=config.num_heads,
            # timm truncates the product: aim at the middle
            mlp_ratio=(config.mlp_dim + 0.5) / config.width,
            num_classes=output_dim,
            class_token=False,
            global_pool="",
            act_layer="gelu_tanh",
            norm_layer=partial(nn.LayerNorm, eps=1e-6),
            weight_init="skip",
        )
        self.eval()

    def train(self, mode: bool = True) -> Self:
        """Nothing in it differs in training: it stays as it is, and compiled code serves both
        modes.
        """
        return super().train(False)

    def forward(self, images: Tensor, frame_mask: Tensor | None = None, every: int = 0) -> Tensor:
        """Tokens of images [n, 3, s, s]; or of clips [n, t, 3, s, s], of the last of whose frames
        they are.

        Args:
            frame_mask: [n, t] bool, False on frames of clips that are not there.
            every: see `PastViews`.

        Raises:
            ValueError: images of another size.
        """
        vit: Any = self.vit
        clips = images.shape[:-3]
        size = vit.patch_embed.img_size
        if images.shape[-3:] != (3, *size):
            shape = list(images.shape[-3:])
            raise ValueError(f"Images are {shape}: resize them to [3, {size[0]}, {size[1]}].")
        images = images.flatten(0, -4)
        convolution = vit.patch_embed.proj
        # Patches and positions in float32, as released; then the compute dtype.
        kind = images.device.type if images.device.type != "meta" else "cpu"
        with torch.autocast(kind, enabled=False):
            weight, bias = convolution.weight.float(), convolution.bias.float()
            patches = nn.functional.conv2d(images.float(), weight, bias, stride=convolution.stride)
            x = patches.flatten(2).transpose(1, 2) + vit.pos_embed.float()
        dtype = compute_dtype(vit.head.weight)
        x = x.to(dtype)
        # Where the weights have the compute dtype, autocast would only cast those of the norms.
        casts = torch.is_autocast_enabled(kind)
        casts = casts and any(weight.dtype != dtype for weight in vit.parameters())
        with fused_kernels(x), torch.autocast(kind, dtype, enabled=casts):
            if frame_mask is None:
                for block in vit.blocks:
                    x = block(x)
            else:
                from mme_vla.backbone.clips import through_time

                x = through_time(vit.blocks, x.unflatten(0, clips), frame_mask, every)
            return vit.head(vit.norm(x)).to(dtype)


def pool_grid(tokens: Tensor, grid: int, pooling: str = "mean") -> Tensor:
    """Pool [..., s², d] tokens of an s×s grid to [..., grid², d] over non-overlapping windows.

    Args:
        tokens: row-major.
        grid: the new side; must divide s.
        pooling: `mean` as released, or `max` (paper, section 4.2).
    """
    side = int(tokens.shape[-2] ** 0.5)
    if side % grid:
        raise UserError(
            f"A {side}×{side} token grid cannot be pooled to {grid}×{grid}: {grid} must divide"
            f" {side}."
        )
    window = side // grid
    cells = tokens.unflatten(-2, (grid, window, grid, window))
    if pooling == "mean":
        return cells.mean(dim=(-4, -2)).flatten(-3, -2)
    if pooling == "max":
        return cells.amax(dim=(-4, -2)).flatten(-3, -2)
    raise UserError(f"pooling={pooling!r}: choose 'mean' (as released) or 'max' (paper).")
