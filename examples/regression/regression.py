"""An own backbone: a small transformer that predicts a chunk in one pass, trained on the absolute
error.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from mme_vla import Backbone, Batch, register
from mme_vla.backbone.base import BackboneConfig, FineTuneSpec, Injection
from mme_vla.backbone.layers import Block, Span, additive_mask, attend, attention_mask
from mme_vla.speed import Recomputes


class Layer(nn.Module):
    """Attention under a mask, then an MLP."""

    def __init__(self, width: int, heads: int, mlp_dim: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.mlp_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, mlp_dim), nn.GELU(), nn.Linear(mlp_dim, width))

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        q, k, v = self.qkv(self.norm(x)).unflatten(-1, (3, self.heads, -1)).unbind(2)
        x = x + self.out(attend(q, k, v, mask))
        return x + self.mlp(self.mlp_norm(x))


@register("backbone", "regression")
class Regression(Backbone, Recomputes):
    """Patches, words and memory in one sequence; a learned query for each step of the chunk reads
    it.
    """

    # one's own dataclass will do; integrations read `vlm.width` and the like from it
    Config = BackboneConfig
    supports = frozenset({"blocks"})
    finetune_spec = FineTuneSpec(
        {"vision": r"vision\.|places", "vlm": r"words\.|order\.", "action": ""},
        lora_targets=("qkv", "out"),
        full_train=("head",),
    )

    def __init__(
        self, config: BackboneConfig, extra_experts: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(config, extra_experts)
        width, vision = config.vlm.width, config.vision
        self.vision_width = width
        self.horizon, self.action_dim = config.horizon, config.action_dim
        self.image_size, self.grid = vision.image_size, vision.image_size // vision.patch_size
        self.vision = nn.Conv2d(3, width, vision.patch_size, vision.patch_size)
        self.words, self.order = nn.Embedding(config.vocab_size, width), nn.Embedding(1024, width)
        self.places = nn.Parameter(torch.randn(self.grid**2, width) * 0.02)
        self.queries = nn.Parameter(torch.randn(config.horizon, width))
        self.layers = nn.ModuleList(
            Layer(width, config.num_heads, config.vlm.mlp_dim) for _ in range(config.depth)
        )
        self.head = nn.Linear(width, config.action_dim)
        self._recompute = False

    def encode_images(self, images: Tensor) -> Tensor:
        return self.vision(images).flatten(2).transpose(1, 2) + self.places

    def embed(self, batch: Batch) -> list[Block]:
        # b v n d
        tokens = self.encode_images(batch.images.flatten(0, 1)).unflatten(0, batch.images.shape[:2])
        mask = batch.image_mask[:, :, None].expand(tokens.shape[:3]).flatten(1)
        words = self.words(batch.prompt) + self.order.weight[: batch.prompt.shape[1]]
        return [
            Block("images", tokens.flatten(1, 2), mask, "vlm"),
            Block("prompt", words, batch.prompt_mask, "vlm"),
        ]

    def predict(self, injection: Injection) -> Tensor:
        """The chunk [b, h, a]."""
        queries = self.queries.expand(len(injection.blocks[0].tokens), -1, -1)
        everywhere = torch.ones(queries.shape[:2], dtype=torch.bool, device=queries.device)
        blocks = [*injection.blocks, Block("action", queries, everywhere, "action")]
        x, valid = torch.cat([b.tokens for b in blocks], 1), torch.cat([b.mask for b in blocks], 1)
        spans = [Span(block.name, len(block)) for block in blocks]
        mask = additive_mask(
            attention_mask(spans, spans, valid, valid, injection.visibility), x.dtype
        )
        for layer in self.layers:
            keep_nothing = self._recompute and torch.is_grad_enabled()
            x = checkpoint(layer, x, mask, use_reentrant=False) if keep_nothing else layer(x, mask)
        return self.head(x[:, -self.horizon :])

    def loss(self, batch: Batch, injection: Injection, noise: Mapping[str, Tensor]) -> Tensor:
        assert batch.actions is not None
        return (self.predict(injection).float() - batch.actions.float()).abs().mean(-1)

    @torch.no_grad()
    def sample(
        self,
        batch: Batch,
        injection: Injection,
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        return self.predict(injection)

    def recompute(self, mode: bool | str) -> None:
        self._recompute = bool(mode)
