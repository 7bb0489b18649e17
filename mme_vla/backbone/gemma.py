"""Gemma experts under joint attention: every expert has its own weights, all share one attention.

b batch · n tokens · d an expert's width · N query heads · K key heads · e head width
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from mme_vla.backbone.base import BackboneConfig, ExpertConfig, Hook, bind_hook
from mme_vla.backbone.layers import (
    AdaRMSNorm,
    AttentionMask,
    Block,
    MaskLayout,
    Modulation,
    RMSNorm,
    Rotation,
    Span,
    Visibility,
    apply_custom_positions,
    attend,
    build_mask,
    compute_dtype,
    rotary_positions,
    rotate,
    rotation,
    select_rows,
)
from mme_vla.errors import UserError
from mme_vla.speed import Recompute, run_layer

KeyValue = tuple[Tensor, Tensor]


class StaticKV(NamedTuple):
    """Space for the keys and values of one layer [b, tokens, K, e], of which the first `start`
    tokens are the past's.
    """

    k: Tensor
    v: Tensor
    start: int

    def filled(self, k: Tensor, v: Tensor) -> KeyValue:
        """The past's keys and values, and this pass's [b, n, K, e] written behind them."""
        stop = self.start + k.shape[1]
        for buffer, new in ((self.k, k), (self.v, v)):
            buffer[:, self.start : stop].copy_(new)
        return self.k[:, :stop], self.v[:, :stop]

    def past(self) -> KeyValue:
        """The past's keys and values."""
        return self.k[:, : self.start], self.v[:, : self.start]


class LayerTimeModulation(NamedTuple):
    """What one layer's two norms are conditioned on: time modulations, made beforehand for a
    sampling step, or in training the embedded time.
    """

    attention: Modulation | Tensor | None
    mlp: Modulation | Tensor | None


class Segment(NamedTuple):
    """Neighbouring blocks of one expert, run as one matrix.

    tokens: [b, n, d].
    update, gate: of the sublayer before, still to be added. None once the tokens have it.
    """

    expert: str
    tokens: Tensor
    update: Tensor | None = None
    gate: Tensor | None = None

    def summed(self) -> Tensor:
        """The tokens, with the update added [b, n, d]."""
        if self.update is None:
            return self.tokens
        return _residual(self.tokens, self.update, self.gate)


class GatedMLP(nn.Module):
    """GeGLU: (gelu(x W₀) ⊙ x W₁) W₂, with W₀ and W₁ in one matrix."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.gate_up = nn.Linear(width, 2 * hidden, bias=False)
        self.down = nn.Linear(hidden, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        gate, up = self.gate_up(x).chunk(2, dim=-1)
        # Compiled code has one kernel that writes the product alone. In place it would need two.
        if torch.is_grad_enabled() or torch.compiler.is_compiling():
            return self.down(nn.functional.gelu(gate, approximate="tanh") * up)
        # in place: a chunk's largest tensors
        return self.down(torch.ops.aten.gelu_(gate, approximate="tanh").mul_(up))


class ExpertLayer(nn.Module):
    """One expert's weights in one layer.

    In the last layer only the action expert is read further: of the others that layer needs keys
    and values alone (`keys_only`), and has no other weights.
    """

    def __init__(
        self,
        config: BackboneConfig,
        expert: ExpertConfig,
        condition_width: int | None,
        keys_only: bool,
    ):
        super().__init__()
        self.heads = config.num_heads
        self.kv_heads = config.num_kv_heads
        self.head_dim = config.head_dim
        self.keys_only = keys_only

        def norm() -> nn.Module:
            if condition_width:
                return AdaRMSNorm(expert.width, condition_width)
            return RMSNorm(expert.width)

        self.attention_norm = norm()
        kv_width = 2 * self.kv_heads * self.head_dim
        if keys_only:
            self.kv = nn.Linear(expert.width, kv_width, bias=False)
            return
        q_width = self.heads * self.head_dim
        self.qkv = nn.Linear(expert.width, q_width + kv_width, bias=False)
        self.out = nn.Linear(q_width, expert.width, bias=False)
        self.mlp_norm = norm()
        self.mlp = GatedMLP(expert.width, expert.mlp_dim)

    def project(
        self, x: Tensor, rope: Rotation, condition: Tensor | Modulation | None
    ) -> tuple[Tensor | None, Tensor, Tensor, Tensor | None]:
        """Normalise [b, n, d] and return q [b, n, N, e] (None if `keys_only`), k, v [b, n, K, e]
        and the gate.

        Queries and keys come back rotated, by `rope` at their positions.
        """
        x, gate = self.attention_norm(x, condition)
        heads = (self.kv if self.keys_only else self.qkv)(x).unflatten(-1, (-1, self.head_dim))
        # Split and not sliced: the gradient of each slice would fill a whole matrix.
        queries = 0 if self.keys_only else self.heads
        if torch.compiler.is_compiling() and not torch.is_grad_enabled():
            # Each by itself: compiled code then rotates keys straight into the cache.
            q, k, v = heads.split([queries, self.kv_heads, self.kv_heads], dim=-2)
            return None if self.keys_only else rotate(q, rope), rotate(k, rope), v, gate
        queries_and_keys, v = heads.split([queries + self.kv_heads, self.kv_heads], dim=-2)
        # In one go: queries first, keys last.
        q, k = rotate(queries_and_keys, rope).split([queries, self.kv_heads], dim=-2)
        return None if self.keys_only else q, k, v, gate

    def feed_forward(
        self,
        x: Tensor,
        attended: Tensor,
        gate: Tensor | None,
        condition: Tensor | Modulation | None,
        hook: Callable[[Tensor], Tensor] | None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Add the attention's output and run the MLP; the hook changes only what that reads.

        Returns:
            The sum [b, n, d], and the MLP's output and gate, which are to be added to it.
        """
        x = _residual(x, self.out(attended), gate)
        normed, gate = self.mlp_norm(x if hook is None else hook(x), condition)
        return x, self.mlp(normed), gate


def _residual(x: Tensor, update: Tensor, gate: Tensor | None) -> Tensor:
    return x + update if gate is None else torch.addcmul(x, update, gate.to(x.dtype))


class Querying(NamedTuple):
    """A segment with queries, between its projection and the end of its layer.

    layer: its expert's. A second lookup by name would make compiled code depend on the length.
    rows: its place in the sequence.
    x: its tokens [b, n, d].
    gate: of the attention's output.
    """

    expert: str
    layer: ExpertLayer
    rows: slice
    x: Tensor
    gate: Tensor | None


class JointBlock(nn.Module):
    """One layer of all experts: a real module, so that sharding, checkpointing and compilation wrap
    it whole.
    """

    def __init__(
        self,
        config: BackboneConfig,
        experts: dict[str, ExpertConfig],
        action_expert: str,
        last: bool,
    ) -> None:
        super().__init__()
        self.action_expert = action_expert
        self.experts = nn.ModuleDict()
        for name, expert in experts.items():
            if name == action_expert:  # its norms are conditioned on the flow time
                layer = ExpertLayer(config, expert, expert.width, keys_only=False)
            else:
                layer = ExpertLayer(config, expert, None, keys_only=last)
            self.experts[name] = layer

    def forward(
        self,
        segments: Sequence[Segment],
        rope: Rotation,
        mask: AttentionMask,
        condition: Tensor | LayerTimeModulation | None,
        hook: Callable[[Tensor], Tensor] | None = None,
        past: StaticKV | None = None,
    ) -> list[Segment]:
        """Run one layer.

        Args:
            segments: this pass's tokens in sequence order.
            rope: their rotation.
            mask: additive [b, 1, n, past + n], or what another backend of attention reads.
            condition: what the action expert's norms are conditioned on: the time embedding [b, c]
                or a modulation.
            hook: see `Hook`, layer already bound.
            past: keys and values [b, past, K, e] of earlier passes, rotated, with space for this
                pass's own.

        Returns:
            The updated segments, of those that have queries.
        """
        # While compiled layers sample, the sum that ends a layer is deferred: the next one adds it
        # in one kernel with its first norm. All segments of the pass then come with an update.
        defers_sum = segments[0].update is not None
        if not isinstance(condition, LayerTimeModulation):
            condition = LayerTimeModulation(condition, condition)

        # Every expert projects its own tokens. Only the action expert's norms have a condition.
        querying: list[Querying] = []
        queries, keys, values = [], [], []
        row = 0
        for segment in segments:
            layer: ExpertLayer = self.experts[segment.expert]  # type: ignore[assignment]
            rows = slice(row, row + segment.tokens.shape[1])
            row = rows.stop
            x = segment.summed()
            of_norm = condition.attention if segment.expert == self.action_expert else None
            q, k, v, gate = layer.project(x, rope.rows(rows), of_norm)
            keys.append(k)
            values.append(v)
            if q is not None:
                queries.append(q)
                querying.append(Querying(segment.expert, layer, rows, x, gate))

        # All queries read all keys, those of earlier passes first.
        k, v = _join(keys), _join(values)
        # A cache is filled even where nothing reads it yet.
        if past is not None:
            k, v = past.filled(k, v)
        if not querying:
            return []
        if len(querying) < len(segments):
            mask = select_rows(mask, [each.rows for each in querying], k.dtype)
        attended = attend(_join(queries), k, v, mask)

        # Every expert continues with its own tokens. Only the action expert has a hook.
        lengths = [each.rows.stop - each.rows.start for each in querying]
        updated = []
        for each, piece in zip(querying, attended.split(lengths, dim=1), strict=True):
            if each.expert == self.action_expert:
                finished = each.layer.feed_forward(each.x, piece, each.gate, condition.mlp, hook)
            else:
                finished = each.layer.feed_forward(each.x, piece, each.gate, None, None)
            following = Segment(each.expert, *finished)
            if not defers_sum:
                following = Segment(each.expert, following.summed())
            updated.append(following)
        return updated


class Layout(NamedTuple):
    """What attention needs to know of a pass beside its tokens; the same for every Euler step of a
    chunk.
    """

    spans: list[Span]  # of this pass and the cached ones before it
    valid: Tensor  # [b, past + n] bool
    mask: AttentionMask  # additive [b, 1, n, past + n], or what another backend of attention reads
    rope: Rotation
    mask_layout: MaskLayout
    dtype: torch.dtype  # of the tokens in all layers


@dataclass
class KVCache:
    """Keys and values of every layer, and what is needed to see them: their blocks and which tokens
    are valid.
    """

    layers: Sequence[StaticKV]
    spans: list[Span]
    mask: Tensor  # [b, past] bool

    def after(self, layout: Layout) -> "KVCache":
        """The cache behind a pass with this layout, which has written its keys and values."""
        tokens = layout.valid.shape[1] - self.mask.shape[1]
        layers = [layer._replace(start=layer.start + tokens) for layer in self.layers]
        return KVCache(layers, layout.spans, layout.valid)


@dataclass
class TimeModulations:
    """Time modulations of all layers, made once for the fixed times of a sampler
    (`JointTransformer.time_modulations`).
    """

    layers: list[LayerTimeModulation]
    final: Modulation

    def at(self, index: int, rows: int = 1) -> "TimeModulations":
        """Return the modulations of one time, which has `rows`: one for the whole batch, or one a
        sample.
        """
        at_time = slice(index * rows, (index + 1) * rows)

        def pick(m: Any) -> Modulation:
            return Modulation(m.factor[at_time], m.shift[at_time], m.gate[at_time])

        layers = [LayerTimeModulation(pick(m.attention), pick(m.mlp)) for m in self.layers]
        return TimeModulations(layers, pick(self.final))


class JointTransformer(nn.Module):
    """All layers and the final norm of the action expert, and nothing that no action reads."""

    def __init__(
        self,
        config: BackboneConfig,
        experts: dict[str, ExpertConfig],
        action_expert: str = "action",
    ) -> None:
        super().__init__()
        self.head_dim = config.head_dim
        self.kv_heads = config.num_kv_heads
        self.action_expert = action_expert
        self.experts = experts
        self.gradient_checkpointing: Recompute = False
        self.attention = "auto"
        self.read_out: Callable[..., Tensor] = read_out
        self.layers = nn.ModuleList(
            JointBlock(config, experts, action_expert, last=i == config.depth - 1)
            for i in range(config.depth)
        )
        width = experts[action_expert].width
        self.final_norm = AdaRMSNorm(width, width)

    @property
    def _compiled(self) -> bool:
        return self.layers[0]._compiled_call_impl is not None

    def layout(
        self, blocks: Sequence[Block], table: Visibility, past: KVCache | None = None
    ) -> Layout:
        """Mask and rotary angles of `blocks` in sequence order, after those of `past`, under a
        visibility table.
        """
        for block in blocks:
            expert = self.experts.get(block.expert)
            if expert is None or block.tokens.shape[2:] != (expert.width,):
                widths = {name: each.width for name, each in self.experts.items()}
                raise UserError(
                    f"Block {block.name!r} has tokens {list(block.tokens.shape)} for the expert"
                    f" {block.expert!r}: the backbone has experts of these widths: {widths}. It is"
                    " constructed with integration.extra_experts()."
                )
        spans = [Span(block.name, len(block)) for block in blocks]
        query_mask = torch.cat([block.mask for block in blocks], 1)
        past_mask = None if past is None else past.mask
        positions = apply_custom_positions(rotary_positions(query_mask, past_mask), blocks)
        all_spans = spans
        valid = query_mask
        dtype = compute_dtype(blocks[0].tokens)
        if past is not None:
            all_spans = past.spans + spans
            valid = torch.cat([past.mask, query_mask], 1)
            dtype = past.layers[0].k.dtype
        mask_layout = MaskLayout.of(spans, all_spans, valid, table)
        mask = build_mask(mask_layout, dtype, self.attention, self._compiled)
        rope = rotation(positions, self.head_dim)
        return Layout(all_spans, valid, mask, rope, mask_layout, dtype)

    def forward(
        self,
        blocks: Sequence[Block],
        layout: Layout,
        condition: Tensor | TimeModulations | None = None,
        hook: Hook | None = None,
        past: KVCache | None = None,
    ) -> Tensor | None:
        """Run blocks, after those of `past`.

        Args:
            blocks: in sequence order.
            layout: of these blocks after this past.
            condition: time condition [b, c] of the action expert, or its modulations; unread
                without that expert.
            hook: the per-layer hook.
            past: `cache_space`, or what an earlier pass left in it (`KVCache.after`). This pass
                writes its keys and values behind those.

        Returns:
            The output [b, n, d] of the action expert's last block; None if it is not among
            `blocks`.
        """
        segments = _segments(blocks, layout.dtype, self._compiled)
        is_compiled = self._compiled and not torch.is_grad_enabled()
        if is_compiled and not isinstance(condition, Tensor):  # while sampling
            self._defer_sums(segments, condition)
        for i, block in enumerate(self.layers):
            of_layer = condition.layers[i] if isinstance(condition, TimeModulations) else condition
            segments = run_layer(
                block,
                segments,
                layout.rope,
                layout.mask,
                of_layer,
                bind_hook(hook, i),
                None if past is None else past.layers[i],
                how=self.gradient_checkpointing,
            )
        if not segments:
            return None
        final = condition.final if isinstance(condition, TimeModulations) else condition
        return self.read_out(self.final_norm, segments[-1], final)

    # Sampling

    def _defer_sums(self, segments: list[Segment], condition: TimeModulations | None) -> None:
        """Let the layers defer their sums (`JointBlock.forward`).

        With updates of zeros, the first layer shares the compiled code of the others.
        """
        for i, segment in enumerate(segments):
            gate = None
            if segment.expert == self.action_expert and condition is not None:
                gate = condition.final.gate  # of any value; this is no other input of the layer
            zeros = torch.zeros_like(segment.tokens)
            segments[i] = segment._replace(update=zeros, gate=gate)

    def cache_space(self, blocks: Sequence[Block], following: int) -> KVCache:
        """An empty cache with space for a pass over `blocks`, and behind them for every one of many
        passes of `following` tokens.

        The space behind them is for one pass at a time: each overwrites the last.
        """
        tokens = sum(len(block) for block in blocks) + following
        first = blocks[0].tokens
        size = (len(first), tokens, self.kv_heads, self.head_dim)
        layers = []
        for _ in self.layers:
            keys = first.new_empty(size, dtype=compute_dtype(first))
            layers.append(StaticKV(keys, torch.empty_like(keys), 0))
        return KVCache(layers, [], blocks[0].mask[:, :0])

    def time_modulations(self, condition: Tensor, dtype: torch.dtype) -> TimeModulations:
        """Compute every layer's modulation for conditions [m, c] at once: the weights are read
        once, not m times. Gates are in `dtype`, that of the tokens.
        """
        modulations = []
        for norm in self.time_norms():
            modulation = norm.modulation(condition)
            modulations.append(modulation._replace(gate=modulation.gate.to(dtype)))
        *of_layers, final = modulations
        layers = map(LayerTimeModulation, of_layers[::2], of_layers[1::2])
        return TimeModulations(list(layers), final)

    def time_norms(self) -> list[AdaRMSNorm]:
        """The norms that a condition modulates: two of every layer, and the final one."""
        norms = []
        for block in self.layers:
            expert: Any = block.experts[self.action_expert]  # type: ignore[index]
            norms += [expert.attention_norm, expert.mlp_norm]
        return [*norms, self.final_norm]


def read_out(norm: AdaRMSNorm, segment: Segment, condition: Tensor | Modulation) -> Tensor:
    """The output [b, n, d] of the last layer behind the final norm."""
    output, _ = norm(segment.summed(), condition)
    return output


def _join(parts: list[Tensor]) -> Tensor:
    """Concatenate along the sequence, without a copy where there is one part."""
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def _segments(blocks: Sequence[Block], dtype: torch.dtype, compiled: bool) -> list[Segment]:
    """Join neighbouring blocks of one expert, in the compute dtype, for layers that are compiled or
    are not.
    """
    runs: list[tuple[str, list[Tensor]]] = []
    for block in blocks:
        if not runs or runs[-1][0] != block.expert:
            runs.append((block.expert, []))
        # Not a view of something else, as no later layer's tokens are: the first layer then shares
        # their compiled code.
        runs[-1][1].append(block.tokens.to(dtype, copy=compiled and block.tokens._is_view()))
    return [Segment(expert, _join(tokens)) for expert, tokens in runs]
