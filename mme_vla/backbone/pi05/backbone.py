"""π0.5: what turns images, prompt, noisy actions and flow time into blocks, and the answer into a velocity."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.backbone.layers.blocks import Block
from mme_vla.backbone.layers.norms import AdaRMSNorm, RMSNorm
from mme_vla.backbone.layers.precision import float32_linear
from mme_vla.backbone.pi05.flow import time_embedding
from mme_vla.backbone.pi05.gemma import JointTransformer
from mme_vla.backbone.pi05.siglip import VisionTower, pool_grid
from mme_vla.backbone.pi05.sizes import BackboneConfig, ExpertConfig
from mme_vla.registry import BACKBONES
from mme_vla.types import Batch


@BACKBONES.register("pi05")
class Pi05Backbone(nn.Module):
    """Vision tower, VLM expert and action expert. It knows nothing of memory: extra experts are just more columns."""

    def __init__(self, config: BackboneConfig, extra_experts: Mapping[str, ExpertConfig] | None = None) -> None:
        super().__init__()
        self.config = config
        width = config.action.width
        # The vision tower comes first: with one seed it is the same in every variant, and so is a cache made by it.
        self.vision = VisionTower(config.vision, config.vlm.width)
        initialise(self.vision)
        self.embedding = nn.Embedding(config.vocab_size, config.vlm.width)
        experts = {**(extra_experts or {}), "vlm": config.vlm, "action": config.action}
        self.transformer = JointTransformer(config, experts)
        self.action_in = nn.Linear(config.action_dim, width)
        self.action_out = nn.Linear(width, config.action_dim)
        self.time_in = nn.Linear(width, width)
        self.time_out = nn.Linear(width, width)
        for module in (self.embedding, self.transformer, self.action_in, self.action_out, self.time_in, self.time_out):
            initialise(module)

    @property
    def device(self) -> torch.device:
        return self.embedding.weight.device

    def compile(self, **options: Any) -> None:
        """Compile the vision tower and every layer in place, each by itself: quick to compile, and shardable still."""
        # Layers share one code: each passes it in training, prefill and denoising, with and without gradients.
        torch._dynamo.config.recompile_limit = max(torch._dynamo.config.recompile_limit, 64)
        for module in (self.vision, *self.transformer.layers):
            module.compile(**options)

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → tokens [n, 256, d]; no graph is kept while the tower is frozen."""
        frozen = not any(p.requires_grad for p in self.vision.parameters())
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            return self.vision(images)

    def pooled_tokens(self, images: Tensor, grid: int, pooling: str) -> Tensor:
        """Tokens [n, grid², d] as memories store them."""
        return pool_grid(self.encode_images(images), grid, pooling)

    def observation_blocks(self, batch: Batch, images: Tensor) -> list[Block]:
        """Blocks of the current views and the prompt.

        Args:
            batch: masks and prompt. images: [b, v, 3, s, s] in [−1, 1], augmented if need be.
        """
        views = images.shape[1]
        tokens = self.encode_images(images.flatten(0, 1)).unflatten(0, (-1, views))  # b v n d
        image_mask = batch.image_mask[:, :, None].expand(tokens.shape[:3]).flatten(1)
        # Token embeddings are scaled by √d, image tokens are not.
        words = self.embedding(batch.prompt) * self.config.vlm.width**0.5
        return [
            Block("images", tokens.flatten(1, 2), image_mask, "vlm"),
            Block("prompt", words, batch.prompt_mask, "vlm"),
        ]

    def action_block(self, x_t: Tensor) -> Block:
        """The noisy chunk [b, h, a] as the block that answers."""
        mask = torch.ones(x_t.shape[:2], dtype=torch.bool, device=x_t.device)
        return Block("action", float32_linear(self.action_in, x_t), mask, "action")

    def time_condition(self, time: Tensor) -> Tensor:
        """Condition [b, d_action] of the adaptive norms for flow times [b], in float32."""
        x = time_embedding(time, self.config.action.width)
        for layer in (self.time_in, self.time_out):
            x = nn.functional.silu(float32_linear(layer, x))
        return x

    def velocity(self, answer: Tensor) -> Tensor:
        """Read the velocity [b, h, a] off the action block's output, in float32."""
        return float32_linear(self.action_out, answer)


def initialise(module: nn.Module) -> None:
    """Fresh weights: LeCun normal matrices, zero biases, unit-variance embeddings; adaptive norms keep their zeros."""
    adaptive = {id(m.dense) for m in module.modules() if isinstance(m, AdaRMSNorm)}
    for m in module.modules():
        if isinstance(m, RMSNorm):
            nn.init.zeros_(m.scale)
        elif id(m) in adaptive:
            for parameter in m.parameters():
                nn.init.zeros_(parameter)
        elif isinstance(m, nn.Linear | nn.Conv2d):
            fan_in = m.weight[0].numel()
            nn.init.normal_(m.weight, std=fan_in**-0.5)
            if m.bias is not None:
                nn.init.zeros_(m.bias)
        elif isinstance(m, nn.Embedding):
            nn.init.normal_(m.weight, std=m.embedding_dim**-0.5)
    if isinstance(module, VisionTower):
        assert module.vit.pos_embed is not None
        nn.init.normal_(module.vit.pos_embed, std=0.02)
