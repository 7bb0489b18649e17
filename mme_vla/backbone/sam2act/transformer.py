"""The multi-view transformer: three virtual pictures, the goal and the robot's state → a token for every patch."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mme_vla.backbone.layers.recomputing import Recompute, run_layer
from mme_vla.backbone.sam2act.sizes import SAM2ActSizes
from mme_vla.backbone.sam2act.views import VIEWS

SLOPE = 0.02
"""Of every leaky ReLU here."""
GROUPS = 4
_DROPOUT = 0.1
_WIDER = 4  # feed-forward layers, inside


@dataclass(frozen=True)
class Look:
    """What one look at the scene gives the network.

    pictures: [b, 3, 10, s, s] of `virtual_pictures`. maps: of the picture encoder for all views, finest first:
    [b·3, token/4, 4g, 4g], [b·3, token/2, 2g, 2g], [b·3, neck, g, g]. state: [b, p]. language: [b, l, w].
    """

    pictures: Tensor
    maps: tuple[Tensor, Tensor, Tensor]
    state: Tensor
    language: Tensor


class Attention(nn.Module):
    """Multi-head attention with keys and values of one matrix, as released."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_q = nn.Linear(width, width, bias=False)
        self.to_kv = nn.Linear(width, 2 * width, bias=False)
        self.to_out = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[b, n, d] → [b, n, d]."""
        queries, keys, values = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in (self.to_q(x), *self.to_kv(x).chunk(2, -1))
        )
        drop = _DROPOUT if self.training else 0.0
        mixed = nn.functional.scaled_dot_product_attention(queries, keys, values, dropout_p=drop)
        out: Tensor = self.to_out(mixed.transpose(1, 2).flatten(2))
        return out


class FeedForward(nn.Module):
    """A gated feed-forward layer (GEGLU)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.into = nn.Linear(width, 2 * _WIDER * width)
        self.out = nn.Linear(_WIDER * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[b, n, d] → [b, n, d]."""
        value, gate = self.into(x).chunk(2, -1)
        out: Tensor = self.out(value * nn.functional.gelu(gate))
        return out


class Layer(nn.Module):
    """One pre-norm layer."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attention_norm, self.attention = nn.LayerNorm(width), Attention(width, heads)
        self.feed_norm, self.feed = nn.LayerNorm(width), FeedForward(width)

    def forward(self, x: Tensor) -> Tensor:
        """[b, n, d] → [b, n, d]."""
        x = x + self.attention(self.attention_norm(x))
        out: Tensor = x + self.feed(self.feed_norm(x))
        return out


class Normed(nn.Module):
    """A linear layer or convolution, a group norm, a leaky ReLU."""

    def __init__(self, layer: nn.Linear | nn.Conv2d, width: int) -> None:
        super().__init__()
        self.layer, self.norm = layer, nn.GroupNorm(GROUPS, width)

    def forward(self, x: Tensor) -> Tensor:
        """Apply all three."""
        return nn.functional.leaky_relu(self.norm(self.layer(x)), SLOPE)


class MultiViewTransformer(nn.Module):
    """From a look to the tokens of all patches: first each view by itself, then all views and the goal together."""

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.positions = nn.Parameter(torch.randn(1, VIEWS * sizes.grid**2, sizes.token))
        self.state = Normed(nn.Linear(sizes.state_dim, sizes.state), sizes.state)
        self.patches = Normed(nn.Conv2d(10, sizes.pictures, sizes.patch, sizes.patch), sizes.pictures)
        self.language = Normed(nn.Linear(sizes.language, sizes.token), sizes.token)
        self.sam = nn.Conv2d(sizes.encoder.neck, sizes.sam, 1)
        self.unused_sam = nn.Conv2d(sizes.encoder.neck, sizes.sam, 1)  # in every released checkpoint; nothing reads it
        self.wide = nn.Linear(sizes.token, sizes.width)
        self.narrow = nn.Linear(sizes.width, sizes.token)
        self.layers = nn.ModuleList(Layer(sizes.width, sizes.heads) for _ in range(sizes.depth))
        self.recomputed: Recompute = False
        """Whether layers keep no activations in training."""

    def forward(self, look: Look) -> Tensor:
        """Tokens [b·3, token, g, g], view by view."""
        batch, grid = len(look.pictures), self.sizes.grid
        patches = self.patches(look.pictures.flatten(0, 1))  # (b v) c g g
        sam = nn.functional.leaky_relu(self.sam(look.maps[2]), SLOPE)
        state = self.state(look.state)[:, None, :, None, None].expand(batch, VIEWS, -1, grid, grid).flatten(0, 1)
        tokens = torch.cat([sam, patches, state], 1).flatten(2).transpose(1, 2)
        tokens = tokens.reshape(batch, VIEWS * grid**2, -1) + self.positions
        words = look.language.shape[1]
        language = self.language(look.language.flatten(0, 1)).view(batch, words, -1)
        x = self.wide(torch.cat([language, tokens], 1))
        language, views = x[:, :words], x[:, words:]
        alone = len(self.layers) // 2
        views = views.reshape(batch * VIEWS, grid**2, -1)
        for layer in self.layers[:alone]:
            views = self._run(layer, views)
        x = torch.cat([language, views.reshape(batch, VIEWS * grid**2, -1)], 1)
        for layer in self.layers[alone:]:
            x = self._run(layer, x)
        tokens = self.narrow(x[:, words:]).reshape(batch * VIEWS, grid**2, -1)
        return tokens.transpose(1, 2).unflatten(-1, (grid, grid))

    def _run(self, layer: nn.Module, x: Tensor) -> Tensor:
        out: Tensor = run_layer(layer, x, how=self.recomputed)
        return out
