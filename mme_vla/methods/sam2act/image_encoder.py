"""SAM2's image encoder with adapters: transformers' `Sam2VisionModel`, LoRA on its queries and values."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.errors import missing_extra
from mme_vla.methods.sam2act.config import LEVELS, EncoderSizes, SAM2ActSizes

_REDUCTION = 16
"""Pixels of the encoder's images to a patch of its third map."""


class LoraProjection(nn.Module):
    """A fused projection to queries, keys and values, with low-rank changes of the queries and the values.

    Each change reaches as many numbers as the input has: the first ones and the last ones of the output. In the blocks
    that double the width that is half of the queries and half of the values, as released.
    """

    def __init__(self, qkv: nn.Linear, rank: int) -> None:
        super().__init__()
        width = qkv.in_features
        self.qkv = qkv
        self.linear_a_q, self.linear_b_q = nn.Linear(width, rank, bias=False), nn.Linear(rank, width, bias=False)
        self.linear_a_v, self.linear_b_v = nn.Linear(width, rank, bias=False), nn.Linear(rank, width, bias=False)
        for first, second in ((self.linear_a_q, self.linear_b_q), (self.linear_a_v, self.linear_b_v)):
            nn.init.kaiming_uniform_(first.weight, a=math.sqrt(5))
            nn.init.zeros_(second.weight)

    def forward(self, x: Tensor) -> Tensor:
        """[…, d] → […, 3·d']."""
        queries, values = self.linear_b_q(self.linear_a_q(x)), self.linear_b_v(self.linear_a_v(x))
        out: Tensor = self.qkv(x)
        between = out.shape[-1] - queries.shape[-1] - values.shape[-1]
        middle = out.new_zeros(*out.shape[:-1], between)
        return out + torch.cat([queries, middle, values], -1)


class ImageEncoder(nn.Module):
    """Virtual images → maps at three sizes. One encoder serves both looks."""

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        self.side = sizes.grid * _REDUCTION
        self.vision = _vision_model(sizes.encoder, self.side)
        for block in self.vision.backbone.blocks:
            block.attn.qkv = LoraProjection(block.attn.qkv, sizes.encoder.lora)
        self.fine = nn.Conv2d(sizes.encoder.neck, sizes.token // 4, 1)
        self.middle = nn.Conv2d(sizes.encoder.neck, sizes.token // 2, 1)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Maps [n, token/4, 4g, 4g], [n, token/2, 2g, 2g], [n, neck, g, g] of colours [n, 3, s, s] in [0, 1].

        Colours go in as they are: the released code neither subtracts a mean nor divides by a deviation.
        """
        size = (self.side, self.side)
        scaled = nn.functional.interpolate(images, size, mode="bilinear", align_corners=True)
        fine, middle, coarse = self.vision(scaled).fpn_hidden_states
        return self.fine(fine), self.middle(middle), coarse

    def frozen(self) -> list[nn.Parameter]:
        """What the authors never train: all but the adapters and the two small convolutions."""
        return [value for name, value in self.vision.named_parameters() if "linear_" not in name]


def _vision_model(sizes: EncoderSizes, side: int) -> Any:
    try:
        import transformers
    except ImportError as error:
        raise missing_extra("SAM2's image encoder", "baselines") from error
    hiera: dict[str, Any] = {
        "hidden_size": sizes.width,
        "num_attention_heads": sizes.heads,
        "image_size": [side, side],
        "window_positional_embedding_background_size": [sizes.background, sizes.background],
        "blocks_per_stage": list(sizes.blocks),
        "embed_dim_per_stage": sizes.widths,
        "num_attention_heads_per_stage": [sizes.heads * 2**stage for stage in range(LEVELS)],
        "window_size_per_stage": list(sizes.windows),
        "global_attention_blocks": list(sizes.global_blocks),
    }
    fine = side // 4
    options: dict[str, Any] = {
        "backbone_config": transformers.Sam2HieraDetConfig(**hiera),
        "backbone_channel_list": sizes.widths[::-1],
        "backbone_feature_sizes": [[fine >> level, fine >> level] for level in range(3)],
        "fpn_hidden_size": sizes.neck,
    }
    return transformers.Sam2VisionModel(transformers.Sam2VisionConfig(**options))
