"""SAM2's image encoder with LoRA (transformers' `Sam2VisionModel`), and its memory of keyframes."""

import itertools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.errors import missing_extra
from mme_vla.extras.methods.sam2act.config import LEVELS, SAM2ActSizes

_REDUCTION = 16
"""Pixels of the encoder's images to a patch of its third map."""


class LoraProjection(nn.Module):
    """A fused projection to queries, keys and values, with low-rank changes of the queries and the
    values.

    Each change reaches as many numbers as the input has: the first ones and the last ones of the
    output. In the blocks that double the width that is half of the queries and half of the values,
    as released.
    """

    def __init__(self, qkv: nn.Linear, rank: int) -> None:
        super().__init__()
        width = qkv.in_features
        self.qkv = qkv
        self.linear_a_q = nn.Linear(width, rank, bias=False)
        self.linear_b_q = nn.Linear(rank, width, bias=False)
        self.linear_a_v = nn.Linear(width, rank, bias=False)
        self.linear_b_v = nn.Linear(rank, width, bias=False)
        for first, second in (
            (self.linear_a_q, self.linear_b_q),
            (self.linear_a_v, self.linear_b_v),
        ):
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
        try:
            import transformers
        except ImportError as error:
            raise missing_extra("SAM2's image encoder", "baselines") from error
        self.side = sizes.grid * _REDUCTION
        encoder = sizes.encoder
        hiera: dict[str, Any] = {
            "hidden_size": encoder.width,
            "num_attention_heads": encoder.heads,
            "image_size": [self.side, self.side],
            "window_positional_embedding_background_size": [encoder.background] * 2,
            "blocks_per_stage": list(encoder.blocks),
            "embed_dim_per_stage": encoder.widths,
            "num_attention_heads_per_stage": [encoder.heads * 2**stage for stage in range(LEVELS)],
            "window_size_per_stage": list(encoder.windows),
            "global_attention_blocks": list(encoder.global_blocks),
        }
        fine = self.side // 4
        options: dict[str, Any] = {
            "backbone_config": transformers.Sam2HieraDetConfig(**hiera),
            "backbone_channel_list": encoder.widths[::-1],
            "backbone_feature_sizes": [[fine >> level, fine >> level] for level in range(3)],
            "fpn_hidden_size": encoder.neck,
        }
        vision: Any = transformers.Sam2VisionModel(transformers.Sam2VisionConfig(**options))
        self.vision = vision
        for block in self.vision.backbone.blocks:
            block.attn.qkv = LoraProjection(block.attn.qkv, sizes.encoder.lora)
        self.fine = nn.Conv2d(sizes.encoder.neck, sizes.token // 4, 1)
        self.middle = nn.Conv2d(sizes.encoder.neck, sizes.token // 2, 1)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Maps [n, token/4, 4g, 4g], [n, token/2, 2g, 2g], [n, neck, g, g] of colours [n, 3, s, s]
        in [0, 1].

        Colours go in as they are: the released code neither subtracts a mean nor divides by a
        deviation.
        """
        size = (self.side, self.side)
        scaled = nn.functional.interpolate(images, size, mode="bilinear", align_corners=True)
        fine, middle, coarse = self.vision(scaled).fpn_hidden_states
        return self.fine(fine), self.middle(middle), coarse


_GROWTH = 4  # of the channels, each time a mask's side is halved
_WIDER = 4
_KERNEL = 7
_EPSILON = 1e-6


class MaskShrinker(nn.Module):
    """A mask [n, 1, s, s] at the grid's size, [n, width, s / 2^stages, …]."""

    def __init__(self, width: int, stages: int) -> None:
        super().__init__()
        channels = [_GROWTH**i for i in range(stages + 1)]
        pairs = list(itertools.pairwise(channels))
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, 3, 2, padding=1) for a, b in pairs)
        self.norms = nn.ModuleList(nn.LayerNorm(b, _EPSILON) for _, b in pairs)
        self.out = nn.Conv2d(channels[-1], width, 1)

    def forward(self, mask: Tensor) -> Tensor:
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            mask = nn.functional.gelu(norm(convolution(mask).movedim(1, -1)).movedim(-1, 1))
        out: Tensor = self.out(mask)
        return out


class FuserLayer(nn.Module):
    """A ConvNeXt block."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(width, width, _KERNEL, padding=_KERNEL // 2, groups=width)
        self.norm = nn.LayerNorm(width, _EPSILON)
        self.into, self.back = nn.Linear(width, _WIDER * width), nn.Linear(_WIDER * width, width)
        self.scale = nn.Parameter(torch.full((width,), 1e-6))

    def forward(self, x: Tensor) -> Tensor:
        """[n, d, g, g] → the same shape."""
        inner = self.norm(self.depthwise(x).movedim(1, -1))
        inner = self.scale * self.back(nn.functional.gelu(self.into(inner)))
        return x + inner.movedim(-1, 1)


class MemoryEncoder(nn.Module):
    """Tokens and a mask → what is remembered of them."""

    def __init__(self, width: int, memory: int, mask_stages: int, layers: int = 2) -> None:
        super().__init__()
        self.mask = MaskShrinker(width, mask_stages)
        self.tokens = nn.Conv2d(width, width, 1)
        self.fuser = nn.ModuleList(FuserLayer(width) for _ in range(layers))
        self.out = nn.Conv2d(width, memory, 1)

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """[n, memory, g, g] of tokens [n, width, g, g] and a mask [n, 1, g·2^stages, …]."""
        x = self.tokens(tokens) + self.mask(mask)
        for layer in self.fuser:
            x = layer(x)
        out: Tensor = self.out(x)
        return out


def sine_positions(side: int, width: int, device: torch.device | None = None) -> Tensor:
    """Positions [width, side, side] of a grid: the first half of the numbers by row, the second by
    column.
    """
    half = width // 2
    line = torch.arange(1, side + 1, device=device).float() / (side + 1e-6) * (2 * math.pi)
    rates = 10_000 ** (-2 * (torch.arange(half, device=device) // 2).float() / half)
    angles = line[:, None] * rates
    # half side
    codes = torch.stack([angles[:, 0::2].sin(), angles[:, 1::2].cos()], -1).flatten(1).T
    rows, columns = codes[:, :, None].expand(-1, -1, side), codes[:, None].expand(-1, side, -1)
    return torch.cat([rows, columns])


_POSITION_SCALE = 0.1  # of the tokens' own positions, as released
_DROPOUT = 0.1
_BASE = 10_000.0


class RotaryAttention(nn.Module):
    """One head; queries and keys are turned by where they stand on the grid."""

    def __init__(self, width: int, source: int) -> None:
        super().__init__()
        self.queries = nn.Linear(width, width)
        self.keys, self.values = nn.Linear(source, width), nn.Linear(source, width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, angles: Tensor) -> Tensor:
        """[b, n, d] from keys and values [b, t·n, s].

        Args:
            angles: [n, d/2]; those of the n places, the same for every remembered moment.
        """
        queries = apply_rope(self.queries(x), angles)
        offered = apply_rope(self.keys(keys), angles.repeat(keys.shape[1] // len(angles), 1))
        drop = _DROPOUT if self.training else 0.0
        mixed = nn.functional.scaled_dot_product_attention(
            queries[:, None], offered[:, None], self.values(values)[:, None], dropout_p=drop
        )
        out: Tensor = self.out(mixed[:, 0])
        return out


class MemoryLayer(nn.Module):
    """Self-attention, attention over memories, feed-forward; each behind a norm."""

    def __init__(self, width: int, memory: int, inner: int) -> None:
        super().__init__()
        self.self_norm, self.self_attention = nn.LayerNorm(width), RotaryAttention(width, width)
        self.memory_norm = nn.LayerNorm(width)
        self.memory_attention = RotaryAttention(width, memory)
        self.feed_norm = nn.LayerNorm(width)
        self.into, self.back = nn.Linear(width, inner), nn.Linear(inner, width)

    def forward(self, x: Tensor, memory: Tensor, places: Tensor, angles: Tensor) -> Tensor:
        """[b, n, d] with memories and their positions [b, t·n, m]."""
        normed = self.self_norm(x)
        x = x + self._drop(self.self_attention(normed, normed, normed, angles))
        x = x + self._drop(
            self.memory_attention(self.memory_norm(x), memory + places, memory, angles)
        )
        return x + self._drop(self.back(self._drop(self.into(self.feed_norm(x)).relu())))

    def _drop(self, x: Tensor) -> Tensor:
        return nn.functional.dropout(x, _DROPOUT, self.training)


class MemoryAttention(nn.Module):
    """Tokens of an image, enriched with what is remembered."""

    def __init__(self, width: int, memory: int, inner: int, layers: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(MemoryLayer(width, memory, inner) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor, positions: Tensor, memory: Tensor, places: Tensor) -> Tensor:
        """Enriched tokens [b, n, d].

        Args:
            x, positions: [b, n, d]; n is a square's area.
            memory, places: [b, t·n, m], moment by moment.
        """
        # Angles [n, d/2] of the places of the square, row by row: the first half by column, the
        # second by row.
        side, width = round(x.shape[1] ** 0.5), x.shape[-1]
        steps = torch.arange(0, width, 4, device=x.device)[: width // 4]
        rates = _BASE ** (-steps.float() / width)
        line = torch.arange(side, device=x.device).float()
        rows, columns = line.repeat_interleave(side), line.repeat(side)
        angles = torch.cat([columns[:, None] * rates, rows[:, None] * rates], -1)
        x = x + _POSITION_SCALE * positions
        for layer in self.layers:
            x = layer(x, memory, places, angles)
        out: Tensor = self.norm(x)
        return out


def apply_rope(x: Tensor, angles: Tensor) -> Tensor:
    """Turn each pair of neighbouring numbers of x [b, n, d] by its angle [n, d/2]."""
    even, odd = x[..., 0::2], x[..., 1::2]
    cos, sin = angles.cos(), angles.sin()
    return torch.stack([even * cos - odd * sin, even * sin + odd * cos], -1).flatten(-2)


_SHARPNESS, _SHIFT = 20.0, 10.0  # a heatmap's logits become a mask of −10 to 10, as in SAM2


@dataclass(frozen=True)
class BankState:
    """What an episode remembers: maps [n, g², m] of its latest keyframes, n views, the oldest
    first.
    """

    maps: tuple[Tensor, ...] = ()

    def __len__(self) -> int:
        return len(self.maps)


class KeyframeBank(nn.Module):
    """Reads and writes the states; keeps none itself.

    Views are in the batch axis n and do not attend to each other: n is 3 for one episode, 3·b for b
    in step.
    """

    def __init__(
        self,
        *,
        grid: int,
        token: int,
        memory: int,
        layers: int,
        feedforward: int,
        mask_stages: int,
        remembered: int,
    ) -> None:
        """Build encoder and attention.

        Args:
            grid: side of a view's grid of tokens.
            token: their width.
            memory: width of what is kept of each.
            layers, feedforward: of the attention.
            mask_stages: halvings from a heatmap's image to the grid.
            remembered: most keyframes that are read.
        """
        super().__init__()
        self.grid, self.mask_stages, self.remembered = grid, mask_stages, remembered
        self.encoder = MemoryEncoder(token, memory, mask_stages)
        self.attention = MemoryAttention(token, memory, feedforward, layers)
        self.ages = nn.Parameter(torch.randn(remembered, memory) * 0.02)

    def init_state(self) -> BankState:
        """The state of an episode that has seen nothing."""
        return BankState()

    def read(self, state: BankState, tokens: Tensor, positions: Tensor) -> Tensor:
        """Tokens [n, d, g, g] with what is remembered; unchanged where nothing is.

        Args:
            positions: [n, g², d], the tokens' own.
        """
        recent = state.maps[::-1][: self.remembered]
        if not recent:
            return tokens
        places = self.positions().to(tokens)  # g² m
        aged = [(places + self.ages[age]).expand_as(entry) for age, entry in enumerate(recent)]
        x = tokens.flatten(2).transpose(1, 2)
        x = self.attention(x, positions, torch.cat(recent, 1), torch.cat(aged, 1))
        return x.transpose(1, 2).view_as(tokens)

    def update(self, state: BankState, tokens: Tensor, logits: Tensor) -> BankState:
        """The state after a keyframe.

        Args:
            tokens: [n, d, g, g], as they were before `read`.
            logits: [n, 1, s, s], its heatmaps.
        """
        side = self.grid * 2**self.mask_stages
        mask = nn.functional.interpolate(logits.float(), (side, side), mode="bilinear")
        encoded = (
            self.encoder(tokens, mask.sigmoid() * _SHARPNESS - _SHIFT).flatten(2).transpose(1, 2)
        )
        return BankState((*state.maps, encoded)[-self.remembered :])

    def positions(self) -> Tensor:
        """Where remembered places stand, [g², m]."""
        return sine_positions(self.grid, self.ages.shape[1], self.ages.device).flatten(1).T


def released_positions(table: Tensor, batch: int) -> Tensor:
    """The positions [b·3, g², d] under which tokens read the bank, of the transformer's table [1,
    3·g², d].

    The released code reshapes where it should have transposed, batch and all: place p of view i of
    sample s gets row (3·b·p + 3·s + i) of the table repeated b times. Weights trained so need the
    same.
    """
    rows, width = table.shape[1:]
    places = rows // 3
    mixed = table.repeat(batch, 1, 1).reshape(places, 3 * batch, width)
    return mixed.transpose(0, 1)
