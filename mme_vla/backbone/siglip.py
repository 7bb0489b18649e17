"""SigLIP: timm's vision transformer with the released model's dtype rules, pooling, and attention over past frames."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.backbone.attention import fused_kernels
from mme_vla.backbone.config import VisionConfig
from mme_vla.backbone.layers import compute_dtype
from mme_vla.errors import UserError, require

PERIOD = 10_000.0


def through_time(layers: Sequence[Any], x: Tensor, visible: Tensor, every: int) -> Tensor:
    """What a transformer's layers make of the last frame of clips.

    Args:
        layers: timm's `Block`s. x: [n, t, p, d]. visible: [n, t] bool, False on frames that are not there.
        every: each so-many-th layer looks through time, and at least the last; the past is dropped above them.

    Returns:
        [n, p, d].
    """
    n, t = x.shape[:2]
    temporal = {i for i in range(len(layers)) if (i + 1) % every == 0} or {len(layers) - 1}
    when = moments(t, x.shape[-1], x.device).to(x.dtype)[:, None]
    before = (torch.ones(t, t, dtype=torch.bool, device=x.device).tril() & visible[:, None]) | torch.eye(
        t, dtype=torch.bool, device=x.device
    )  # a frame that is not there sees itself, so that no row is empty
    for i, layer in enumerate(layers):
        if i in temporal:
            x = x + space_time(layer.attn, layer.norm1(x + when), before)
            x = x + layer.mlp(layer.norm2(x))
        else:
            x = layer(x.flatten(0, 1)).unflatten(0, (n, -1))
        if i == max(temporal):
            x = x[:, -1:]
    return x[:, 0]


def space_time(attention: Any, x: Tensor, before: Tensor) -> Tensor:
    """Attention over patches whose values are mixed over time, [n, t, p, d] → [n, t, p, d].

    Args:
        attention: timm's `Attention`. before: [n, t, t] bool, which frames a frame looks at.
    """
    n, t, p = x.shape[:3]
    q, k, v = attention.qkv(x).unflatten(-1, (3, attention.num_heads, -1)).permute(3, 0, 4, 1, 2, 5)  # n h t p c
    of_patch = [part.permute(0, 3, 1, 2, 4).flatten(0, 1) for part in (q, k, v)]  # n·p h t c
    mask = before.repeat_interleave(p, 0)[:, None]
    mixed = functional.scaled_dot_product_attention(of_patch[0], of_patch[1], of_patch[2], attn_mask=mask)
    mixed = mixed.unflatten(0, (n, p)).permute(0, 3, 2, 1, 4)  # n t h p c
    q, k = (part.transpose(1, 2).flatten(0, 1) for part in (q, k))
    output = functional.scaled_dot_product_attention(q, k, mixed.flatten(0, 1))
    return attention.proj(output.transpose(1, 2).flatten(2).unflatten(0, (n, t)))


def moments(count: int, width: int, device: torch.device) -> Tensor:
    """Where frames stand in time, [count, width] float32: sines and cosines that are exactly 0 at the last."""
    ages = torch.arange(1 - count, 1, device=device, dtype=torch.float32)
    rates = torch.exp(torch.arange(0, width, 2, device=device, dtype=torch.float32) * (-math.log(PERIOD) / width))
    angles = ages[:, None] * rates
    return torch.stack([angles.sin(), angles.cos() - 1], -1).flatten(1)


class VisionTower(nn.Module):
    """Images [n, 3, s, s] in [−1, 1] → tokens [n, patches, d_out], row-major; not pooled, a linear head on each."""

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
            mlp_ratio=(config.mlp_dim + 0.5) / config.width,  # timm truncates the product: aim at the middle
            num_classes=output_dim,
            class_token=False,
            global_pool="",
            act_layer="gelu_tanh",
            norm_layer=partial(nn.LayerNorm, eps=1e-6),
            weight_init="skip",
        )
        self.eval()

    def train(self, mode: bool = True) -> Self:
        """Nothing in it differs in training: it stays as it is, and compiled code serves both modes."""
        return super().train(False)

    def forward(self, images: Tensor, frame_mask: Tensor | None = None, every: int = 0) -> Tensor:
        """Tokens of images [n, 3, s, s]; or of clips [n, t, 3, s, s], of the last of whose frames they are.

        Args:
            frame_mask: [n, t] bool, False on frames of clips that are not there. every: see `PastViews`.
        """
        vit: Any = self.vit
        clips, images = images.shape[:-3], images.flatten(0, -4)
        convolution = vit.patch_embed.proj
        # Patches and positions in float32, as released; then the compute dtype.
        with torch.autocast(images.device.type if images.device.type != "meta" else "cpu", enabled=False):
            weight, bias = convolution.weight.float(), convolution.bias.float()
            patches = nn.functional.conv2d(images.float(), weight, bias, stride=convolution.stride)
            x = patches.flatten(2).transpose(1, 2) + vit.pos_embed.float()
        dtype = compute_dtype(vit.head.weight)
        x = x.to(dtype)
        with fused_kernels(x):
            if frame_mask is None:
                for block in vit.blocks:
                    x = block(x)
            else:
                x = through_time(vit.blocks, x.unflatten(0, clips), frame_mask, every)
        return vit.head(vit.norm(x)).to(dtype)


def pool_grid(tokens: Tensor, grid: int, pooling: str = "mean") -> Tensor:
    """Pool [..., s², d] tokens of an s×s grid to [..., grid², d] over non-overlapping windows.

    Args:
        tokens: row-major. grid: the new side; must divide s.
        pooling: `mean` as released, or `max` (paper, section 4.2).
    """
    side = int(tokens.shape[-2] ** 0.5)
    require(
        not (side % grid), f"A {side}×{side} token grid cannot be pooled to {grid}×{grid}: {grid} must divide {side}."
    )
    window = side // grid
    cells = tokens.unflatten(-2, (grid, window, grid, window))
    if pooling == "mean":
        return cells.mean(dim=(-4, -2)).flatten(-3, -2)
    if pooling == "max":
        return cells.amax(dim=(-4, -2)).flatten(-3, -2)
    raise UserError(f"pooling={pooling!r}: choose 'mean' (as released) or 'max' (paper).")
