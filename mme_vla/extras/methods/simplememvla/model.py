"""The vision-language model of SimpleMemVLA: transformers' Qwen3.5, its hidden states, and the
words it generates.

Shapes: b batch · L tokens · D width · k temporal patches (pairs of frames) · m merged tokens of
one.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.errors import missing_extra
from mme_vla.extras.methods.simplememvla.head import Condition
from mme_vla.extras.methods.simplememvla.video import pixel_rows
from mme_vla.speed import Recompute, checkpoint_options

try:
    from transformers import DynamicCache, Qwen3_5Model
    from transformers.models.qwen3_5.modeling_qwen3_5 import Qwen3_5GatedDeltaNet
except ImportError:
    raise missing_extra("SimpleMemVLA", "vlm") from None

if TYPE_CHECKING:
    from transformers import Qwen3_5Config


class ContinuedDeltaNet(Qwen3_5GatedDeltaNet):
    """The delta net of transformers, which continues from a cache by more than one token too.

    transformers before 5.11 starts such a continuation from an empty state, with padding before it.
    """

    def forward(
        self,
        hidden_states: Tensor,
        cache_params: Any = None,
        attention_mask: Tensor | None = None,
        **options: Any,
    ) -> Tensor:
        """Tokens [b, n, D] → [b, n, D]; the cache is updated."""
        fresh = cache_params is None or not cache_params.has_previous_state(self.layer_idx)
        if fresh or hidden_states.shape[1] == 1:
            read: Tensor = super().forward(hidden_states, cache_params, attention_mask, **options)
            return read
        count = hidden_states.shape[1]
        layer = cache_params.layers[self.layer_idx]
        state = layer.recurrent_states
        new = self.in_proj_qkv(hidden_states).transpose(1, 2)
        columns = torch.cat([layer.conv_states.to(new), new], -1)
        recent = columns[..., -self.conv_kernel_size :].clone()
        cache_params.update_conv_state(recent, self.layer_idx)
        mixed = functional.conv1d(columns[..., 1:], self.conv1d.weight, groups=self.conv_dim)
        mixed = functional.silu(mixed[..., -count:]).transpose(1, 2)
        q, k, v = mixed.split([self.key_dim, self.key_dim, self.value_dim], -1)
        q, k = q.unflatten(-1, (-1, self.head_k_dim)), k.unflatten(-1, (-1, self.head_k_dim))
        repeats = self.num_v_heads // self.num_k_heads
        if repeats > 1:
            q, k = q.repeat_interleave(repeats, 2), k.repeat_interleave(repeats, 2)
        decay = functional.softplus(self.in_proj_a(hidden_states).float() + self.dt_bias)
        read, state = self.chunk_gated_delta_rule(
            q,
            k,
            v.unflatten(-1, (-1, self.head_v_dim)),
            g=-self.A_log.float().exp() * decay,
            beta=self.in_proj_b(hidden_states).sigmoid(),
            initial_state=state,
            output_final_state=True,
            use_qk_l2norm_in_kernel=True,
        )
        cache_params.update_recurrent_state(state, self.layer_idx)
        gate = self.in_proj_z(hidden_states).reshape(-1, self.head_v_dim)
        normed = self.norm(read.reshape(-1, self.head_v_dim), gate)
        output: Tensor = self.out_proj(normed.reshape(len(hidden_states), count, -1))
        return output


class AttentionCache(DynamicCache):
    """The cache of a language model without delta nets: transformers requests their
    state of any.
    """

    def has_previous_state(self, layer_idx: int | None = None) -> bool:
        """False: there is none."""
        return False


class WordIds(NamedTuple):
    """What ends a response: the id of `<|im_end|>`, and of the line break behind it."""

    end: int
    newline: int


class Prefill(NamedTuple):
    """A prompt's beginning as the language model keeps it: attention keys and values, and delta-net
    states.
    """

    cache: Any
    length: int


class VideoLanguageModel(nn.Module):
    """Qwen3.5 with a language head tied to its embedding. Tensors have the names of the published
    checkpoint.
    """

    def __init__(self, config: "Qwen3_5Config") -> None:
        super().__init__()
        self.model = Qwen3_5Model(config)
        for layer in self.model.language_model.layers:
            if hasattr(layer, "linear_attn"):
                # the same weights, with another forward
                layer.linear_attn.__class__ = ContinuedDeltaNet
        self.reset_buffers()

    def reset_buffers(self) -> None:
        """Compute the rotary frequencies, which no file holds."""
        visual, rotary = self.model.visual.rotary_pos_emb, self.model.language_model.rotary_emb
        device = self.embedding.weight.device
        exponents = torch.arange(0, visual.dim, 2, dtype=torch.float32, device=device) / visual.dim
        visual.inv_freq = 1.0 / (visual.theta**exponents)
        frequencies, _ = rotary.compute_default_rope_parameters(rotary.config, device)
        rotary.inv_freq, rotary.original_inv_freq = frequencies, frequencies.clone()

    @property
    def embedding(self) -> nn.Embedding:
        return self.model.language_model.embed_tokens

    def recompute(self, mode: Recompute) -> None:
        """Compute layers again in the backward pass instead of keeping their activations, or keep
        them.
        """
        if mode:
            self.model.gradient_checkpointing_enable(checkpoint_options(mode))
        else:
            self.model.gradient_checkpointing_disable()

    def encode_patches(self, pairs: Tensor) -> Tensor:
        """Tokens [k, m, D] of temporal patches: pairs of frames [k, 2, 3, H, W] uint8."""
        vision = self.model.visual.config
        rows = pixel_rows(pairs, vision.patch_size, vision.spatial_merge_size)
        height, width = (side // vision.patch_size for side in pairs.shape[-2:])
        # on the CPU: transformers reads it as numbers
        grid = torch.tensor([[len(pairs), height, width]])
        tokens = self.model.visual(
            rows.to(self.embedding.weight.dtype), grid_thw=grid
        ).pooler_output
        return tokens.reshape(len(pairs), -1, tokens.shape[-1])

    def embed(self, ids: Tensor, *replaced: tuple[Tensor, Tensor]) -> Tensor:
        """Embeddings [b, L, D] of tokens [b, L], some replaced.

        Args:
            replaced: pairs of a mask [b, L] and of the tokens [n, D] that take its places, in
                order.
        """
        embedded: Tensor = self.embedding(ids)
        for mask, tokens in replaced:
            embedded = embedded.masked_scatter(mask[..., None], tokens.to(embedded))
        return embedded

    def hidden(
        self, embedded: Tensor, positions: Tensor, cache: Any = None, mask: Tensor | None = None
    ) -> Tensor:
        """Hidden states [b, L, D] after the final norm.

        Args:
            embedded: [b, L, D].
            positions: [b, 3, L].
            cache: of `new_cache`, continued in place.
            mask: [b, L of everything so far], False on padding at the left. Padding at the right
                needs none.
        """
        output = self.model.language_model(
            inputs_embeds=embedded, position_ids=positions.transpose(0, 1), past_key_values=cache,
            use_cache=cache is not None, attention_mask=mask,
        )  # fmt: skip
        states: Tensor = output.last_hidden_state
        return states

    def new_cache(self) -> Any:
        """An empty cache of the language model."""
        config: Any = self.model.config.text_config
        kind = DynamicCache if "linear_attention" in config.layer_types else AttentionCache
        return kind(config=config)

    def logits(self, hidden: Tensor) -> Tensor:
        """Logits [..., vocabulary] float32 of hidden states [..., D]."""
        return functional.linear(hidden, self.embedding.weight.to(hidden.dtype)).float()

    # Words

    def generate(
        self,
        embedded: Tensor,
        positions: Tensor,
        ends: WordIds,
        limit: int,
        mask: Tensor | None = None,
        prefill: Prefill | None = None,
        words: Sequence[Sequence[int]] | None = None,
    ) -> tuple[list[list[int]], Condition]:
        """Generate the sub-tasks of prompts, greedily, and return their words' hidden states.

        Args:
            embedded: [b, n, D] of the prompts, padded on the left, without what `prefill` holds.
            positions: [b, 3, n].
            mask: [b, n], False on padding.
            limit: most words of a response before its end.
            prefill: the beginning of one prompt; its cache is continued.
            words: ids to take instead, without `<|im_end|>`.

        Returns:
            The ids of each response up to `<|im_end|>`, and the condition, which includes the line
            break behind it.
        """
        cache = self.new_cache() if prefill is None else prefill.cache
        last = self.hidden(embedded, positions, cache, mask)[:, -1]
        place = positions[:, :, -1].amax(1)
        responses: list[list[int]] = [[] for _ in range(len(embedded))]
        # what follows the words: the end and the line break
        tails: list[list[int]] = [[] for _ in responses]
        hidden: list[Tensor] = []
        tokens: list[Tensor] = []
        while any(len(tail) < 2 for tail in tails):
            logits = self.logits(last)
            if words is None:
                likeliest = logits.argmax(-1).tolist()
            else:
                likeliest = []
                for word_ids in words:
                    targets = [*word_ids, ends.end]
                    likeliest.append(targets[min(len(hidden), len(word_ids))])
            inputs = []
            for response, tail, word in zip(responses, tails, likeliest, strict=True):
                if tail or word == ends.end or len(response) == limit:
                    tail.append(ends.newline if tail else ends.end)
                    inputs.append(tail[-1])
                else:
                    response.append(word)
                    inputs.append(word)
            place = place + 1
            token = self.embed(torch.tensor(inputs, device=embedded.device)[:, None])
            if mask is not None:
                mask = functional.pad(mask, (0, 1), value=True)
            last = self.hidden(token, place[:, None, None].expand(-1, 3, 1), cache, mask)[:, -1]
            hidden.append(last)
            tokens.append(token[:, 0])
        lengths = torch.tensor(
            [len(response) + 2 for response in responses], device=embedded.device
        )
        count = len(hidden)
        steps = torch.arange(count, device=embedded.device)
        first = place - count + 1
        where = (first[:, None] + steps)[:, None].expand(-1, 3, -1)
        condition = Condition(
            torch.stack(hidden, 1), torch.stack(tokens, 1), where, steps < lengths[:, None]
        )
        return [[*response, ends.end] for response in responses], condition


def words_loss(
    model: VideoLanguageModel, hidden: Tensor, ids: Tensor, spans: Sequence[tuple[int, int]]
) -> tuple[Tensor, Tensor]:
    """The cross entropy of responses, averaged over all their tokens, and the share of tokens that
    are the likeliest.

    Args:
        hidden: [b, L, D].
        ids: [b, L].
        spans: first token of each response, and the one behind its last.
    """
    rows = [(i, place) for i, (start, end) in enumerate(spans) for place in range(start, end)]
    row, place = torch.tensor(rows, device=hidden.device).T
    logits, targets = model.logits(hidden[row, place - 1]), ids[row, place]
    right = (logits.detach().argmax(-1) == targets).float().mean()
    return functional.cross_entropy(logits, targets), right


def response_condition(
    hidden: Tensor, embedded: Tensor, positions: Tensor, spans: Sequence[tuple[int, int]]
) -> Condition:
    """The hidden states of known responses, padded on the right to the longest.

    Args:
        hidden, embedded: [b, L, D].
        positions: [b, 3, L].
        spans: as for `words_loss`.
    """
    starts, ends = torch.tensor(spans, device=hidden.device).T
    steps = torch.arange(max(end - start for start, end in spans), device=hidden.device)
    mask = steps < (ends - starts)[:, None]
    places = torch.where(mask, starts[:, None] + steps, 0)
    rows = torch.arange(len(spans), device=hidden.device)[:, None]
    where = positions.transpose(1, 2)[rows, places].transpose(1, 2)
    return Condition(hidden[rows, places], embedded[rows, places], where, mask)
