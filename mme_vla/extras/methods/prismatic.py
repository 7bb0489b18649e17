"""`Prismatic`: the VLM that OpenVLA-OFT and MemoryVLA share. Vision towers, a projector, and
transformers' Llama.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.backbone.layers import rotation
from mme_vla.extras.methods.openvla_oft.config import FusedVisionConfig, LlamaConfig, TowerConfig
from mme_vla.speed import Recompute, checkpoint_options


@dataclass(frozen=True)
class Standard:
    """Mean and standard deviation of each colour, for images in [0, 1]."""

    mean: Sequence[float]
    std: Sequence[float]

    def apply(self, pixels: Tensor) -> Tensor:
        """Standardise [..., 3, s, s]."""
        mean = pixels.new_tensor(self.mean)[:, None, None]
        std = pixels.new_tensor(self.std)[:, None, None]
        return (pixels - mean) / std


IMAGENET = Standard((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
OPENVLA = Standard((0.484375, 0.455078125, 0.40625), (0.228515625, 0.2236328125, 0.224609375))
"""ImageNet's numbers rounded to bfloat16, as OpenVLA's published processor holds them."""
HALF = Standard((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


class FusedVision(nn.Module):
    """Two towers on the same image; a token is [DINOv2 | SigLIP] of one patch, row-major.

    Each gives what stands after its block before the last, without a norm: the last block, the
    final norm and SigLIP's pooling head are part of the published weights, and no action reads
    them.
    """

    def __init__(self, config: FusedVisionConfig, dino_standard: Standard = OPENVLA) -> None:
        super().__init__()
        size = {"img_size": config.image_size, "patch_size": config.patch_size}
        registers = {
            "class_token": True,
            "reg_tokens": 4,
            "no_embed_class": True,
            "init_values": 1e-5,
        }
        self.dino = _tower(config.dino, global_pool="token", **size, **registers)
        self.siglip = _tower(config.siglip, global_pool="map", class_token=False, **size)
        self.dino_standard = dino_standard

    def forward(self, pixels: Tensor) -> Tensor:
        """Six channels [n, 6, s, s] → tokens [n, grid², d_dino + d_siglip]."""
        towers: tuple[Any, Any] = (self.dino, self.siglip)
        read = []
        for tower, channels in zip(towers, pixels.split(3, dim=1), strict=True):
            read += tower.forward_intermediates(
                channels,
                indices=[len(tower.blocks) - 2],
                norm=False,
                stop_early=True,
                output_fmt="NLC",
                intermediates_only=True,
            )
        return torch.cat(read, dim=-1)


def _tower(config: TowerConfig, **options: Any) -> nn.Module:
    from timm.models.vision_transformer import VisionTransformer

    return VisionTransformer(
        embed_dim=config.width,
        depth=config.depth,
        num_heads=config.num_heads,
        # timm truncates the product: aim at the middle
        mlp_ratio=(config.mlp_dim + 0.5) / config.width,
        num_classes=0,
        norm_layer=partial(nn.LayerNorm, eps=1e-6),
        **options,
    )


MAX_POSITIONS = 2048  # Llama 2's; rotary angles know no end, and nothing here depends on it


class Projector(nn.Module):
    """Fused vision tokens [..., d_vision] → the language model's width, in three layers."""

    def __init__(self, d_vision: int, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(d_vision, 4 * d_vision)
        self.fc2 = nn.Linear(4 * d_vision, width)
        self.fc3 = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        gelu = nn.functional.gelu
        return self.fc3(gelu(self.fc2(gelu(self.fc1(tokens)))))


class Prismatic(nn.Module):
    """Images become tokens of a Llama, which reads them among words.

    It holds all that the published weights hold; the language head and the ends of the towers are
    read by no action.
    """

    def __init__(
        self,
        vision: FusedVisionConfig,
        llama: LlamaConfig,
        vocab_size: int,
        dino_standard: Standard = OPENVLA,
    ) -> None:
        import transformers

        super().__init__()
        # The towers come first: with one seed they are the same in every variant, and so is a cache
        # made by them.
        self.vision = FusedVision(vision, dino_standard)
        self.projector = Projector(vision.width, llama.width)
        sizes: Any = transformers.LlamaConfig(  # type: ignore[call-arg]
            vocab_size=vocab_size,
            hidden_size=llama.width,
            intermediate_size=llama.mlp_dim,
            num_hidden_layers=llama.depth,
            num_attention_heads=llama.num_heads,
            num_key_value_heads=llama.num_heads,
            rms_norm_eps=llama.norm_eps,
            max_position_embeddings=MAX_POSITIONS,
            tie_word_embeddings=False,
        )
        sizes._attn_implementation = "sdpa"
        self.language: Any = transformers.LlamaForCausalLM(sizes)
        self.language.model.rotary_emb = Angles(llama.width // llama.num_heads)

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → fused tokens [n, grid², d_vision]; no graph where
        nothing learns.
        """
        frozen = not any(p.requires_grad for p in self.vision.parameters())
        pixels = (images + 1) / 2
        # DINOv2's three channels, then SigLIP's
        channels = torch.cat([self.vision.dino_standard.apply(pixels), HALF.apply(pixels)], dim=-3)
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            return self.vision(channels)

    def embed(self, ids: Tensor) -> Tensor:
        """Embeddings [..., d] of token ids."""
        return self.language.model.embed_tokens(ids)

    def read(
        self, tokens: Tensor, mask: Tensor, positions: Tensor, every_layer: bool = False
    ) -> Any:
        """Run the Llama.

        Args:
            tokens: embeddings [b, n, d].
            mask: additive [b, 1, n, n] in their dtype; it alone decides the visibility.
            positions: [b, n] int64.
            every_layer: return what stands before each layer too.

        Returns:
            Hidden states [b, n, d] after the final norm; with `every_layer` a tuple, the embeddings
            first.
        """
        output = self.language.model(
            inputs_embeds=tokens,
            attention_mask=mask,
            position_ids=positions,
            use_cache=False,
            output_hidden_states=every_layer,
        )
        return output.hidden_states if every_layer else output.last_hidden_state

    def recompute(self, mode: Recompute) -> None:
        """Recompute the Llama's layers in the backward pass, through transformers' own switch."""
        if mode:
            self.language.gradient_checkpointing_enable(checkpoint_options(mode))
        else:
            self.language.gradient_checkpointing_disable()


class Angles(nn.Module):
    """Rotary angles from positions alone: no buffer that a model built on meta would have to
    compute again.
    """

    def __init__(self, head_dim: int) -> None:
        super().__init__()
        self.head_dim = head_dim

    def forward(self, x: Tensor, position_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Angles' cos and sin [b, n, h] at positions [b, n], in x's dtype: as transformers' layers
        take them.
        """
        cos, signed_sin = rotation(position_ids, self.head_dim)
        # Its first half is negative, where transformers' layers negate what is multiplied.
        sin = signed_sin.chunk(2, dim=-1)[1].repeat(1, 1, 1, 2)
        return cos.squeeze(2).to(x.dtype), sin.squeeze(2).to(x.dtype)
