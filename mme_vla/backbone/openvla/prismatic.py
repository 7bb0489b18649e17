"""`Prismatic`: the VLM that OpenVLA-OFT and MemoryVLA share. Vision towers, a projector, and transformers' Llama."""

from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.backbone.layers.recomputing import Recompute, checkpoint_options
from mme_vla.backbone.layers.rope import rotation
from mme_vla.backbone.openvla.sizes import FusedVisionConfig, LlamaConfig
from mme_vla.backbone.openvla.vision import OPENVLA, FusedVision, Standard
from mme_vla.backbone.pi05.siglip import pool_grid

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
    """Pictures become tokens of a Llama, which reads them among words.

    It holds all that the published weights hold; the language head and the ends of the towers are read by no action.
    """

    def __init__(
        self, vision: FusedVisionConfig, llama: LlamaConfig, vocab_size: int, dino_standard: Standard = OPENVLA
    ) -> None:
        super().__init__()
        # The towers come first: with one seed they are the same in every variant, and so is a cache made by them.
        self.vision = FusedVision(vision, dino_standard)
        self.projector = Projector(vision.width, llama.width)
        self.language = _llama(llama, vocab_size)
        self.language.model.rotary_emb = Angles(llama.width // llama.num_heads)

    def encode_images(self, images: Tensor) -> Tensor:
        """Pictures [n, 3, s, s] in [−1, 1] → fused tokens [n, grid², d_vision]; no graph where nothing learns."""
        frozen = not any(p.requires_grad for p in self.vision.parameters())
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            return self.vision(self.vision.standardised(images))

    def pooled_tokens(self, images: Tensor, grid: int, pooling: str) -> Tensor:
        """Fused tokens [n, grid², d_vision] as memories store them."""
        return pool_grid(self.encode_images(images), grid, pooling)

    def embed(self, ids: Tensor) -> Tensor:
        """Embeddings [..., d] of token ids."""
        return self.language.model.embed_tokens(ids)

    def read(self, tokens: Tensor, mask: Tensor, positions: Tensor, every_layer: bool = False) -> Any:
        """Run the Llama.

        Args:
            tokens: embeddings [b, n, d]. mask: additive [b, 1, n, n] in their dtype; it alone says who sees whom.
            positions: [b, n] int64. every_layer: return what stands before each layer too.

        Returns:
            Hidden states [b, n, d] after the final norm; with `every_layer` a tuple, the embeddings first.
        """
        answer = self.language.model(
            inputs_embeds=tokens,
            attention_mask=mask,
            position_ids=positions,
            use_cache=False,
            output_hidden_states=every_layer,
        )
        return answer.hidden_states if every_layer else answer.last_hidden_state

    def recompute(self, wanted: Recompute) -> None:
        """Recompute the Llama's layers in the backward pass, through transformers' own switch."""
        if wanted:
            self.language.gradient_checkpointing_enable(checkpoint_options(wanted))
        else:
            self.language.gradient_checkpointing_disable()


class Angles(nn.Module):
    """Rotary angles from positions alone: no buffer that a model built on meta would have to compute again."""

    def __init__(self, head_dim: int) -> None:
        super().__init__()
        self.head_dim = head_dim

    def forward(self, x: Tensor, position_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Angles' cos and sin [b, n, h] at positions [b, n], in x's dtype: what transformers' layers ask for."""
        turn = rotation(position_ids, self.head_dim)
        return turn.cos.squeeze(2).to(x.dtype), turn.sin.squeeze(2).to(x.dtype)


def _llama(config: LlamaConfig, vocab_size: int) -> Any:
    import transformers

    sizes: Any = transformers.LlamaConfig(  # type: ignore[call-arg]
        vocab_size=vocab_size,
        hidden_size=config.width,
        intermediate_size=config.mlp_dim,
        num_hidden_layers=config.depth,
        num_attention_heads=config.num_heads,
        num_key_value_heads=config.num_heads,
        rms_norm_eps=config.norm_eps,
        max_position_embeddings=MAX_POSITIONS,
        tie_word_embeddings=False,
    )
    sizes._attn_implementation = "sdpa"
    return transformers.LlamaForCausalLM(sizes)
