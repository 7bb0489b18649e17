"""Layers that all experts share: float32 layers, rotary embedding, RMS norms, and attention by a
visibility table.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.errors import UserError, check_choice, listed
from mme_vla.speed import fused_kernels
from mme_vla.types import check_mask

Visibility = Mapping[str, frozenset[str] | set[str]]
"""For each block of queries: the blocks whose keys it may attend to."""

PI05_VISIBILITY: Visibility = {
    "images": {"images", "prompt"},
    "prompt": {"images", "prompt"},
    "action": {"images", "prompt", "action"},
}
"""Images and prompt are one bidirectional block. Actions attend to everything and nothing attends
to them.
"""


def autocast(device: torch.device, dtype: torch.dtype) -> torch.autocast:
    """The context in which network code on a device runs its matrix products in `dtype`."""
    kind = "cpu" if device.type == "meta" else device.type
    return torch.autocast(kind, dtype, enabled=dtype != torch.float32)


def compute_dtype(x: Tensor) -> torch.dtype:
    """The dtype matmuls run in where `x` lives: autocast's when it is on, else the tensor's own."""
    kind = x.device.type
    if kind != "meta" and torch.is_autocast_enabled(kind):
        return torch.get_autocast_dtype(kind)
    return x.dtype


def float32_linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a linear layer in float32 whatever autocast or the stored weights say."""
    with torch.autocast(x.device.type if x.device.type != "meta" else "cpu", enabled=False):
        bias = None if layer.bias is None else layer.bias.float()
        return nn.functional.linear(x.float(), layer.weight.float(), bias)


BASE = 10_000.0


def rounded(operation: Callable[..., Tensor], *operands: Tensor, dtype: torch.dtype) -> Tensor:
    """`operation` of float32 operands, rounded to `dtype`. While eager layers sample, rounding is
    no kernel of its own.

    operation: of PyTorch, with an argument `out`.
    """
    is_traced = torch.is_grad_enabled() or torch.compiler.is_compiling()
    if is_traced or dtype == torch.float32:
        return operation(*operands).to(dtype)
    shape = torch.broadcast_shapes(*(operand.shape for operand in operands))
    return operation(*operands, out=operands[0].new_empty(shape, dtype=dtype))


class Rotation(NamedTuple):
    """cos and ±sin of every position's angles, float32 [b, n, 1, e]: both halves turn by the same
    angles, and the sine of the first half is negative.
    """

    cos: Tensor
    sin: Tensor

    def rows(self, keep: slice) -> "Rotation":
        """Return the rotation of some of the tokens."""
        return Rotation(self.cos[:, keep], self.sin[:, keep])


def rotation(positions: Tensor, head_dim: int) -> Rotation:
    """Angles p·10000^(−2i/h) for positions [b, n], whole numbers or not.

    Of positions [b, n, k] the angles use the coordinates in turn.
    """
    pairs = torch.arange(head_dim // 2, device=positions.device)
    exponent = pairs.float() * (2 / head_dim)
    if positions.ndim == 3:
        coordinates = positions[..., pairs % positions.shape[-1]]
    else:
        coordinates = positions[..., None]
    angles = (coordinates[:, :, None].float() / BASE**exponent).repeat(1, 1, 1, 2)
    sin = angles.sin()
    sin[..., : head_dim // 2].neg_()
    return Rotation(angles.cos(), sin)


def rotate(x: Tensor, rope: Rotation) -> Tensor:
    """Rotate queries or keys [b, n, heads, e] of halves a and b: (a cos − b sin, b cos + a sin).
    The result keeps the dtype of x.
    """
    # Gradients add up in float32. Without them the products read x as it is, in the same precision.
    exact = x.float() if torch.is_grad_enabled() else x
    a, b = exact.chunk(2, dim=-1)
    swapped = torch.cat([b, a], dim=-1)
    return rounded(torch.addcmul, exact * rope.cos, swapped, rope.sin, dtype=x.dtype)


EPS = 1e-6


def rms_normalise(x: Tensor, factor: Tensor | None = None) -> Tensor:
    """Return x / √(mean(x²) + ε) over the last axis, times a factor [d], in float32."""
    return functional.rms_norm(x.float(), x.shape[-1:], factor, EPS)


class RMSNorm(nn.Module):
    """x/rms(x)·(1 + scale); the scale starts at 0."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor, condition: None = None) -> tuple[Tensor, None]:
        """Normalise [b, n, d]; the second value is the missing gate, so that both
        norms read alike.
        """
        return rms_normalise(x, self.factor).to(x.dtype), None

    @property
    def factor(self) -> Tensor:
        """1 + scale [d], float32."""
        return 1 + self.scale.float()


class Modulation(NamedTuple):
    """What a condition does to one normalised sublayer: each [b or 1, 1, d].

    factor: 1 + scale(c).
    """

    factor: Tensor
    shift: Tensor
    gate: Tensor


class AdaRMSNorm(nn.Module):
    """x/rms(x)·(1 + scale(c)) + shift(c), and a gate(c) for the sublayer's output. Starts as
    identity with gate 0.
    """

    keeps_float32 = True
    """Its weights are never gathered in bfloat16 (`shard_groups`)."""

    def __init__(self, width: int, condition_width: int) -> None:
        super().__init__()
        self.dense = nn.Linear(condition_width, 3 * width)
        nn.init.zeros_(self.dense.weight)
        nn.init.zeros_(self.dense.bias)

    def modulation(self, condition: Tensor) -> Modulation:
        """Map the condition [b, c] to what it does, in float32 as the condition is."""
        scale, shift, gate = float32_linear(self.dense, condition).unsqueeze(1).chunk(3, dim=-1)
        return Modulation(1 + scale, shift, gate)

    def forward(self, x: Tensor, condition: Tensor | Modulation) -> tuple[Tensor, Tensor]:
        """Normalise [b, n, d]; the second value is the gate, in its own dtype: compiled layers pass
        it on to the next one as it is, without a kernel that casts it.

        `condition` is the raw [b, c] or, when sampling, a modulation made beforehand.
        """
        m = condition if isinstance(condition, Modulation) else self.modulation(condition)
        normed = rms_normalise(x)
        return rounded(torch.addcmul, m.shift, normed, m.factor, dtype=x.dtype), m.gate


@dataclass
class Block:
    """A run of tokens that share a name, hence a row of the table, and an expert whose weights
    process them.

    tokens: [b, n, d] at the expert's width.
    mask: [b, n] bool, False on padding.
    positions: [b, n] custom rotary positions, on the same axis as those of the other blocks; [b, n,
        k] where a token has k coordinates (time, row, column), which rotate interleaved angles;
        None counts its tokens.
    """

    name: str
    tokens: Tensor
    mask: Tensor
    expert: str
    positions: Tensor | None = None

    def __post_init__(self) -> None:
        check_mask(f"The mask of block {self.name!r}", self.mask, self.tokens.shape[:-1])

    def __len__(self) -> int:
        return self.tokens.shape[1]


class Span(NamedTuple):
    """A block's name and length: what a key-value cache keeps of it."""

    name: str
    length: int


def rotary_positions(mask: Tensor, past_mask: Tensor | None = None) -> Tensor:
    """Rotary positions [b, n]: valid tokens are counted, padding repeats the number before it (−1
    first).
    """
    positions = mask.long().cumsum(1) - 1
    if past_mask is None:
        return positions
    return positions + past_mask.long().sum(1, keepdim=True)


def apply_custom_positions(numbered: Tensor, blocks: Sequence[Block]) -> Tensor:
    """Rotary positions [b, n] of blocks in sequence order, with the custom positions of blocks that
    have them.

    [b, n, k] if a block has k coordinates: those of tokens with one number are equal.
    """
    if all(block.positions is None for block in blocks):
        return numbered
    parts = numbered.float().split([len(block) for block in blocks], 1)
    positions = []
    counts = set()
    for counted, block in zip(parts, blocks, strict=True):
        part = counted if block.positions is None else block.positions
        positions.append(part)
        if part.ndim == 3:
            counts.add(part.shape[-1])
    if len(counts) > 1:
        raise ValueError(
            f"Blocks have positions of {sorted(counts)} coordinates: all need as many, or one"
            " number."
        )
    for count in counts:
        for i, part in enumerate(positions):
            if part.ndim == 2:
                positions[i] = part[..., None].expand(-1, -1, count)
    return torch.cat(positions, 1)


class MaskLayout(NamedTuple):
    """The visibility table applied to the valid keys of a batch.

    Padding queries get the same mask as valid ones of their block; their output is ignored. This
    avoids fully masked rows, which produce NaN.

    lengths: of the runs of queries, in sequence order.
    visible: [b, runs, k] bool.
    """

    lengths: tuple[int, ...]
    visible: Tensor

    @classmethod
    def of(
        cls, queries: Sequence[Span], keys: Sequence[Span], valid: Tensor, table: Visibility
    ) -> Self:
        """The layout of blocks; neighbours with equal rows are one run.

        Args:
            queries, keys: blocks in sequence order.
            valid: [b, k] bool, of the keys.
            table: the visibility table.
        """
        runs: list[tuple[int, list[bool]]] = []
        # A name without a row is no block of any pass, but a misspelt one.
        names = {query.name for query in queries}.union(*table.values())
        if not names <= table.keys():
            raise UserError(
                f"No row of the visibility table belongs to {listed(sorted(names - table.keys()))};"
                f" it has rows {sorted(table)}."
            )
        for query in queries:
            sees = [key.name in table[query.name] for key in keys]
            if runs and runs[-1][1] == sees:
                runs[-1] = (runs[-1][0] + query.length, sees)
            else:
                runs.append((query.length, sees))
        parts = valid.split([key.length for key in keys], 1)
        hidden = [torch.zeros_like(part) for part in parts]
        rows = []
        for _, sees in runs:
            if all(sees):
                rows.append(valid)
                continue
            row = list(hidden)
            for i, is_visible in enumerate(sees):
                if is_visible:
                    row[i] = parts[i]
            rows.append(torch.cat(row, 1))
        return cls(tuple(length for length, _ in runs), torch.stack(rows, 1))

    def part(self, rows: Sequence[slice]) -> "MaskLayout":
        """The layout of some of the queries, ranges of their indices in order."""
        lengths, runs = [], []
        start = 0
        for run, length in enumerate(self.lengths):
            count = 0
            for at in rows:
                count += max(min(at.stop, start + length) - max(at.start, start), 0)
            if count:
                lengths.append(count)
                runs.append(run)
            start += length
        visible = self.visible
        if len(runs) < len(self.lengths):
            visible = torch.stack([visible[:, run] for run in runs], 1)
        return MaskLayout(tuple(lengths), visible)

    def expand(self, rows: Tensor) -> Tensor:
        """Values of each run [b, runs, k] for each query [b, n, k]: a view if there is one run."""
        parts = []
        for run, length in enumerate(self.lengths):
            parts.append(rows[:, run, None].expand(-1, length, -1))
        return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def attention_mask(
    queries: Sequence[Span],
    keys: Sequence[Span],
    query_mask: Tensor,
    key_mask: Tensor,
    table: Visibility,
) -> Tensor:
    """Query q attends to key k iff q's row of the table names k's block and both tokens are valid.

    Args:
        queries, keys: blocks in sequence order.
        query_mask: [b, q] bool.
        key_mask: [b, k] bool.
        table: the visibility table.

    Returns:
        [b, q, k] bool.
    """
    layout = MaskLayout.of(queries, keys, key_mask, table)
    return layout.expand(layout.visible) & query_mask[:, :, None]


BACKENDS = ("auto", "sdpa", "flex", "varlen")
"""`sdpa`: fused kernels with an additive mask, the reference. `flex`: compiled from the layout,
skips hidden keys. `varlen`: flash attention over keys packed for each run of queries. `auto`: see
`build_mask`.
"""


class SparseMask(Protocol):
    """A mask in the form of another backend (mme_vla/speed/sparse_attention.py)."""

    @property
    def layout(self) -> MaskLayout: ...

    def attend(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """See `attend`."""
        ...


AttentionMask = Tensor | SparseMask | None
"""The mask of `attend`: additive [b, 1, q, k], the form of another backend, or None (all keys are
visible).
"""

BIG_NEGATIVE = -1e30
"""Far below any logit, and still finite where kernels count in base 2 (times 1.44): no row becomes
NaN.
"""

ALIGNMENT = 8
"""Keys a row of the mask is padded to, as fused kernels want it: otherwise they copy the mask in
every layer.
"""


def additive_mask(mask: Tensor, dtype: torch.dtype) -> Tensor:
    """[b, q, k] bool → [b, 1, q, k] of 0 and `BIG_NEGATIVE`, made once per forward and shared by
    all layers.

    Added to finite logits in float32 it absorbs them, so this equals replacing them.
    """
    return _padded(mask, dtype)[..., : mask.shape[-1]].unsqueeze(1)


def layout_mask(layout: MaskLayout, dtype: torch.dtype) -> Tensor:
    """The additive mask [b, 1, n, k] of a layout."""
    keys = layout.visible.shape[-1]
    mask = layout.expand(_padded(layout.visible, dtype))
    return mask[..., :keys].unsqueeze(1)


def _padded(visible: Tensor, dtype: torch.dtype) -> Tensor:
    if dtype == torch.float16:
        raise UserError(
            "torch.float16 is too narrow for this network, its masks and large activations: keep"
            " float32, or call bfloat16()."
        )
    *rows, keys = visible.shape
    mask = torch.zeros(*rows, -(-keys // ALIGNMENT) * ALIGNMENT, dtype=dtype, device=visible.device)
    mask[..., :keys].masked_fill_(~visible, BIG_NEGATIVE)
    return mask


def check_backend(name: str) -> str:
    """The name of a backend."""
    check_choice("policy.attention", name, BACKENDS)
    return name


def build_mask(
    layout: MaskLayout, dtype: torch.dtype, backend: str, compiled: bool
) -> AttentionMask:
    """The mask of one backend, built once per forward and shared by all layers.

    `auto` is `flex` for training on a GPU where layers are `compiled`, so that it is part of their
    code; else `sdpa`.
    """
    if backend == "auto":
        is_training = layout.visible.is_cuda and torch.is_grad_enabled()
        backend = "flex" if compiled and is_training else "sdpa"
    if backend == "sdpa":
        return layout_mask(layout, dtype)
    from mme_vla.speed.sparse_attention import FlexMask, PackedMask

    if backend == "flex":
        return FlexMask.of(layout)
    return PackedMask.of(layout)


def select_rows(mask: AttentionMask, rows: Sequence[slice], dtype: torch.dtype) -> Tensor:
    """The additive mask of some of the queries, for the last layer: they are few, whatever the
    backend.
    """
    if isinstance(mask, Tensor):
        return torch.cat([mask[:, :, at] for at in rows], 2)
    assert mask is not None
    return layout_mask(mask.layout.part(rows), dtype)


def attend(q: Tensor, k: Tensor, v: Tensor, mask: AttentionMask) -> Tensor:
    """Scaled dot-product attention with grouped queries: query head n reads key head n // (N/K).

    Args:
        q: [b, q, N, e].
        k, v: [b, k, K, e].
        mask: of `build_mask`; or additive [b, 1, q, k] in q's dtype; or bool with a key in every
            row; or None.

    Returns:
        [b, q, N·e].
    """
    if mask is not None and not isinstance(mask, Tensor):
        return mask.attend(q, k, v)
    groups = q.shape[2] // k.shape[2]
    q, k, v = (x.transpose(1, 2) for x in (q, k, v))
    if groups > 1 and k.shape[1] == 1:  # one shared key head broadcasts without a copy
        k = k.expand(-1, groups, -1, -1)
        v = v.expand(-1, groups, -1, -1)
    elif groups > 1:
        k = k.repeat_interleave(groups, 1)
        v = v.repeat_interleave(groups, 1)
    with fused_kernels(q):
        output = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    return output.transpose(1, 2).flatten(2)
