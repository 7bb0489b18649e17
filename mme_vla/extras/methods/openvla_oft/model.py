"""OpenVLA-OFT: a VLM in which every token sees every other, and a chunk regressed in one pass."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.backbone.base import Backbone, FineTuneSpec, HasExtraExperts, Injection
from mme_vla.backbone.layers import Block, additive_mask
from mme_vla.extras.methods.openvla_oft.config import OpenVlaConfig
from mme_vla.extras.methods.prismatic import Prismatic
from mme_vla.registry import BACKBONES
from mme_vla.speed import Recompute, Recomputes
from mme_vla.types import Batch


class StateToken(nn.Module):
    """Normalised state [b, s] → one token [b, 1, d]."""

    def __init__(self, state_dim: int, width: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(state_dim, width), nn.Linear(width, width)

    def forward(self, state: Tensor) -> Tensor:
        return self.fc2(nn.functional.gelu(self.fc1(state)))[:, None]


class ResidualMLP(nn.Module):
    """x + ReLU(W LayerNorm(x))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm, self.linear = nn.LayerNorm(width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        return x + nn.functional.relu(self.linear(self.norm(x)))


class ActionHead(nn.Module):
    """Hidden states of a step's slots, side by side → that step's action; no
    activation at the end.
    """

    def __init__(self, width: int, action_dim: int, blocks: int = 2) -> None:
        super().__init__()
        self.input_norm = nn.LayerNorm(action_dim * width)
        self.input = nn.Linear(action_dim * width, width)
        self.blocks = nn.ModuleList(ResidualMLP(width) for _ in range(blocks))
        self.output_norm, self.output = nn.LayerNorm(width), nn.Linear(width, action_dim)

    def forward(self, slots: Tensor) -> Tensor:
        """[b, h, a·d] → [b, h, a]."""
        x = nn.functional.relu(self.input(self.input_norm(slots)))
        for block in self.blocks:
            x = block(x)
        return self.output(self.output_norm(x))


@dataclass(frozen=True)
class TokenSequence:
    """One pass of the VLM: tokens [b, n, d], who may be seen [b, n], positions [b, n].

    read: [b, h·a]; the position whose hidden state predicts each slot.
    """

    tokens: Tensor
    valid: Tensor
    positions: Tensor
    read: Tensor


@BACKBONES.register("openvla")
class OpenVlaBackbone(Backbone, HasExtraExperts, Recomputes):
    """`<s>`, images, state, memory, words, a slot of zeros for each number of the chunk, `</s>`.

    Nothing is causal and no block is hidden from another, so an integration's visibility table has
    no effect; memory stands after the state, wherever the integration names it. A slot is answered
    by the hidden state *before* it, as in predicting the next token (Kim et al., OpenVLA-OFT).
    """

    Config = OpenVlaConfig
    supports = frozenset({"blocks"})
    LORA_TARGETS = (
        *("patch_embed.proj", "attn.qkv", "attn.proj", "mlp.fc1", "mlp.fc2"),
        *("attn_pool.q", "attn_pool.kv", "attn_pool.proj"),
        *("projector.fc1", "projector.fc2", "projector.fc3"),
        *("q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj", "lm_head"),
    )

    def __init__(
        self, config: OpenVlaConfig, extra_experts: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(config, extra_experts)
        self.config = config
        width = config.vlm.width
        self.vision_width = config.vision.width
        self.image_size, self.grid = config.vision.image_size, config.vision.grid
        self.horizon, self.action_dim = config.horizon, config.action_dim
        self.vlm = Prismatic(config.vision, config.vlm, config.vocab_size)
        self.vlm.language.model.embed_tokens.shard_alone = True
        self.state_token = StateToken(config.state_dim, width) if config.state_dim else None
        self.head = ActionHead(width, config.action_dim)
        self.heads = ("head",) if self.state_token is None else ("state_token", "head")
        # Towers; projector and language model; state token and head.
        components = {"vision": r"vlm\.vision\.", "vlm": r"vlm\.", "action": ""}
        self.finetune_spec = FineTuneSpec(components, self.LORA_TARGETS, self.heads)

    def init_experts(self, names: Sequence[str]) -> None:
        """Draw the head and the state's token, which OpenVLA itself has nothing of."""
        for name in self.heads:
            for module in self.get_submodule(name).modules():
                if isinstance(module, nn.Linear | nn.LayerNorm):
                    module.reset_parameters()

    @property
    def vision(self) -> Any:  # type: ignore[override]
        """Both towers."""
        return self.vlm.vision

    # Observation

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → fused tokens [n, grid², d_vision], before
        the projector.
        """
        return self.vlm.encode_images(images)

    def embed(self, batch: Batch) -> list[Block]:
        """Blocks `begin`, `images`, `state` (where it is read) and `prompt`, in sequence order."""
        fused = self.encode_images(batch.images.flatten(0, 1)).unflatten(0, batch.images.shape[:2])
        return self.blocks_of(batch, fused)

    def blocks_of(self, batch: Batch, fused: Tensor) -> list[Block]:
        """The observation's blocks, from fused tokens [b, v, n, d_vision] of its views.

        Raises:
            ValueError: the network reads the state, and the batch has none.
        """
        token_mask = batch.image_mask[:, :, None].expand(fused.shape[:3]).flatten(1)
        words = self.vlm.embed(batch.prompt)
        blocks = [
            Block("begin", words[:, :1], batch.prompt_mask[:, :1], "vlm"),
            Block("images", self.vlm.projector(fused).flatten(1, 2), token_mask, "vlm"),
        ]
        if self.state_token is not None:
            if batch.proprio is None:
                raise ValueError(
                    "This backbone reads the state: batch.proprio must hold it, normalised (it is"
                    " None)."
                )
            blocks.append(
                Block(
                    "state",
                    self.state_token(batch.proprio),
                    torch.ones_like(token_mask[:, :1]),
                    "vlm",
                )
            )
        return [*blocks, Block("prompt", words[:, 1:], batch.prompt_mask[:, 1:], "vlm")]

    # The pass

    def sequence(self, blocks: Sequence[Block]) -> TokenSequence:
        """Put the blocks in order and add the slots and `</s>`.

        The words of one sample may be fewer than another's. Slots and `</s>` follow each one's last
        word by position; attention has no other order, so the padding between does no harm.
        """
        observed, memories, prompts = [], [], []
        for block in blocks:
            if block.name == "prompt":
                prompts.append(block)
            elif block.name in ("begin", "images", "state"):
                observed.append(block)
            else:
                memories.append(block)
        (prompt,) = prompts
        slots = self.horizon * self.action_dim
        zeros = prompt.tokens.new_zeros(len(prompt.tokens), slots, prompt.tokens.shape[-1])
        parts, masks = [], []
        for block in (*observed, *memories, prompt):
            parts.append(block.tokens.to(zeros))
            masks.append(block.mask)
        end = self.vlm.embed(
            torch.full_like(prompt.mask[:, :1], self.config.end_id, dtype=torch.long)
        )
        tokens = torch.cat([*parts, zeros, end], 1)
        tail = torch.ones_like(prompt.mask[:, :1]).expand(-1, slots + 1)
        valid = torch.cat([*masks, tail], 1)
        first = tokens.shape[1] - slots - 1  # of the slots
        start = first - len(prompt)
        words = prompt.mask.sum(1, keepdim=True)
        here = torch.arange(tokens.shape[1], device=tokens.device).expand(len(tokens), -1)
        positions = here - (here >= first) * (len(prompt) - words)
        read = torch.cat([start + words - 1, here[:, first : first + slots - 1]], 1)
        return TokenSequence(tokens, valid, positions, read)

    def hidden(self, sequence: TokenSequence, every_layer: bool = False) -> Any:
        """The VLM's hidden states [b, n, d]: every token sees every valid one."""
        attention_mask = sequence.valid[:, None, :].expand(-1, sequence.valid.shape[1], -1)
        mask = additive_mask(attention_mask, sequence.tokens.dtype)
        return self.vlm.read(sequence.tokens, mask, sequence.positions, every_layer)

    def slots(self, sequence: TokenSequence, hidden: Tensor) -> Tensor:
        """What the head reads [b, h, a·d]: the hidden states before the slots, a step's side by
        side.
        """
        outputs = hidden.gather(1, sequence.read[..., None].expand(-1, -1, hidden.shape[-1]))
        return outputs.unflatten(1, (self.horizon, self.action_dim)).flatten(2)

    def predict_from(self, blocks: Sequence[Block]) -> Tensor:
        """The chunk [b, h, a] for the blocks of an injection."""
        sequence = self.sequence(blocks)
        return self.head(self.slots(sequence, self.hidden(sequence)))

    def loss(self, batch: Batch, injection: Injection, noise: Mapping[str, Tensor]) -> Tensor:
        """The absolute error [b, h], averaged over the numbers of an action."""
        assert batch.actions is not None
        return absolute_error(self.predict_from(injection.blocks), batch.actions)

    @torch.no_grad()
    def sample(
        self,
        batch: Batch,
        injection: Injection,
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """The chunk [b, h, a], without random numbers."""
        return self.predict_from(injection.blocks)

    def recompute(self, mode: Recompute) -> None:
        self.vlm.recompute(mode)

    def compile(self, **options: Any) -> None:
        """Compile the towers and every layer of the language model, each by itself."""
        for module in (
            self.vlm.vision.dino,
            self.vlm.vision.siglip,
            *self.vlm.language.model.layers,
        ):
            module.compile(**options)


def absolute_error(predicted: Tensor, actions: Tensor) -> Tensor:
    """Mean |answer − actions| over the numbers of an action: [b, h, a] → [b, h]."""
    return (predicted.float() - actions.float()).abs().mean(-1)
