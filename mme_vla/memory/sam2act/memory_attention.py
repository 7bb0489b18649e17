"""Attention of a picture's tokens over remembered places: SAM2's memory attention, one head, with axial rotations."""

import torch
from torch import Tensor, nn

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
        asked = turn(self.queries(x), angles)
        offered = turn(self.keys(keys), angles.repeat(keys.shape[1] // len(angles), 1))
        drop = _DROPOUT if self.training else 0.0
        mixed = nn.functional.scaled_dot_product_attention(
            asked[:, None], offered[:, None], self.values(values)[:, None], dropout_p=drop
        )
        out: Tensor = self.out(mixed[:, 0])
        return out


class MemoryLayer(nn.Module):
    """Self-attention, attention over memories, feed-forward; each behind a norm."""

    def __init__(self, width: int, memory: int, inner: int) -> None:
        super().__init__()
        self.self_norm, self.self_attention = nn.LayerNorm(width), RotaryAttention(width, width)
        self.memory_norm, self.memory_attention = nn.LayerNorm(width), RotaryAttention(width, memory)
        self.feed_norm = nn.LayerNorm(width)
        self.into, self.back = nn.Linear(width, inner), nn.Linear(inner, width)

    def forward(self, x: Tensor, memory: Tensor, places: Tensor, angles: Tensor) -> Tensor:
        """[b, n, d] with memories and their positions [b, t·n, m]."""
        normed = self.self_norm(x)
        x = x + self._drop(self.self_attention(normed, normed, normed, angles))
        x = x + self._drop(self.memory_attention(self.memory_norm(x), memory + places, memory, angles))
        return x + self._drop(self.back(self._drop(self.into(self.feed_norm(x)).relu())))

    def _drop(self, x: Tensor) -> Tensor:
        return nn.functional.dropout(x, _DROPOUT, self.training)


class MemoryAttention(nn.Module):
    """Tokens of a picture, enriched with what is remembered."""

    def __init__(self, width: int, memory: int, inner: int, layers: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(MemoryLayer(width, memory, inner) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor, positions: Tensor, memory: Tensor, places: Tensor) -> Tensor:
        """Enriched tokens [b, n, d].

        Args:
            x, positions: [b, n, d]; n is a square's area. memory, places: [b, t·n, m], moment by moment.
        """
        angles = grid_angles(round(x.shape[1] ** 0.5), x.shape[-1], x.device)
        x = x + _POSITION_SCALE * positions
        for layer in self.layers:
            x = layer(x, memory, places, angles)
        out: Tensor = self.norm(x)
        return out


def grid_angles(side: int, width: int, device: torch.device | None = None) -> Tensor:
    """Angles [side², width/2] of the places of a grid, row by row: the first half by column, the second by row."""
    rates = _BASE ** (-torch.arange(0, width, 4, device=device)[: width // 4].float() / width)
    line = torch.arange(side, device=device).float()
    rows, columns = line.repeat_interleave(side), line.repeat(side)
    return torch.cat([columns[:, None] * rates, rows[:, None] * rates], -1)


def turn(x: Tensor, angles: Tensor) -> Tensor:
    """Turn each pair of neighbouring numbers of x [b, n, d] by its angle [n, d/2]."""
    even, odd = x[..., 0::2], x[..., 1::2]
    cos, sin = angles.cos(), angles.sin()
    return torch.stack([even * cos - odd * sin, even * sin + odd * cos], -1).flatten(-2)
