"""The multi-view transformer: three virtual images, the goal and the robot's state → a token for
every patch.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from mme_vla.extras.methods.sam2act.config import SAM2ActSizes
from mme_vla.extras.methods.sam2act.geometry import VIEWS, project, read_maps
from mme_vla.extras.methods.sam2act.sam2 import (
    BankState,
    ImageEncoder,
    KeyframeBank,
    released_positions,
)
from mme_vla.speed import Recompute, run_layer

_NEIGHBOURS = 9
_MASK_SCALE = 0.1  # as released


class ConvexUp(nn.Module):
    """[b, in, h, w] → [b, out, 2h, 2w]."""

    RATIO = 2

    def __init__(self, wide: int, narrow: int) -> None:
        super().__init__()
        inner = 2 * wide
        self.net_out = nn.Sequential(
            nn.Conv2d(wide, inner, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(inner, inner, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(inner, narrow, 3, padding=1),
        )
        self.net_mask = nn.Sequential(
            nn.Conv2d(wide, inner, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(inner, _NEIGHBOURS * self.RATIO**2, 1),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Upsample."""
        coarse = self.net_out(x)
        batch, channels, height, width = coarse.shape
        mask = _MASK_SCALE * self.net_mask(x)
        weights = mask.view(batch, 1, _NEIGHBOURS, self.RATIO, self.RATIO, height, width).softmax(2)
        around = nn.functional.unfold(coarse, 3, padding=1).view(
            batch, channels, _NEIGHBOURS, 1, 1, height, width
        )
        fine = (weights * around).sum(2)  # b c ratio ratio h w
        return fine.permute(0, 1, 4, 2, 5, 3).reshape(
            batch, channels, self.RATIO * height, self.RATIO * width
        )


class ChannelNorm(nn.LayerNorm):
    """A layer norm over the channels of [b, c, h, w]."""

    def __init__(self, channels: int, eps: float = 1e-6) -> None:
        super().__init__(channels, eps)

    def forward(self, x: Tensor) -> Tensor:
        """Normalise."""
        return torch.movedim(super().forward(torch.movedim(x, 1, -1)), -1, 1)


SLOPE = 0.02
"""Of every leaky ReLU here."""
GROUPS = 4
_DROPOUT = 0.1
_WIDER = 4  # feed-forward layers, inside


@dataclass(frozen=True)
class EncodedViews:
    """The network's encoding of one view of the scene.

    images: [b, 3, 10, s, s] of `virtual_images`.
    maps: of the image encoder for all views, finest first: [b·3, token/4, 4g, 4g], [b·3, token/2,
        2g, 2g], [b·3, neck, g, g].
    state: [b, p].
    language: [b, l, w].
    """

    images: Tensor
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
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for part in (self.to_q(x), *self.to_kv(x).chunk(2, -1))
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
    """From a look to the tokens of all patches: first each view by itself, then all views and the
    goal together.
    """

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.positions = nn.Parameter(torch.randn(1, VIEWS * sizes.grid**2, sizes.token))
        self.state = Normed(nn.Linear(sizes.state_dim, sizes.state), sizes.state)
        self.patches = Normed(
            nn.Conv2d(10, sizes.pictures, sizes.patch, sizes.patch), sizes.pictures
        )
        self.language = Normed(nn.Linear(sizes.language, sizes.token), sizes.token)
        self.sam = nn.Conv2d(sizes.encoder.neck, sizes.sam, 1)
        # in every released checkpoint; nothing reads it
        self.unused_sam = nn.Conv2d(sizes.encoder.neck, sizes.sam, 1)
        self.wide = nn.Linear(sizes.token, sizes.width)
        self.narrow = nn.Linear(sizes.width, sizes.token)
        self.layers = nn.ModuleList(Layer(sizes.width, sizes.heads) for _ in range(sizes.depth))
        self.recomputed: Recompute = False
        """Whether layers keep no activations in training."""

    def forward(self, inputs: EncodedViews) -> Tensor:
        """Tokens [b·3, token, g, g], view by view."""
        batch, grid = len(inputs.images), self.sizes.grid
        patches = self.patches(inputs.images.flatten(0, 1))  # (b v) c g g
        sam = nn.functional.leaky_relu(self.sam(inputs.maps[2]), SLOPE)
        state = (
            self.state(inputs.state)[:, None, :, None, None]
            .expand(batch, VIEWS, -1, grid, grid)
            .flatten(0, 1)
        )
        tokens = torch.cat([sam, patches, state], 1).flatten(2).transpose(1, 2)
        tokens = tokens.reshape(batch, VIEWS * grid**2, -1) + self.positions
        words = inputs.language.shape[1]
        language = self.language(inputs.language.flatten(0, 1)).view(batch, words, -1)
        x = self.wide(torch.cat([language, tokens], 1))
        language, views = x[:, :words], x[:, words:]
        alone = len(self.layers) // 2
        views = views.reshape(batch * VIEWS, grid**2, -1)
        for layer in self.layers[:alone]:
            views = run_layer(layer, views, how=self.recomputed)
        x = torch.cat([language, views.reshape(batch, VIEWS * grid**2, -1)], 1)
        for layer in self.layers[alone:]:
            x = run_layer(layer, x, how=self.recomputed)
        tokens = self.narrow(x[:, words:]).reshape(batch * VIEWS, grid**2, -1)
        return tokens.transpose(1, 2).unflatten(-1, (grid, grid))


class HeatmapDecoder(nn.Module):
    """Patch tokens and the encoder's finer maps → heatmap logits at the images' size."""

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        half, quarter = sizes.token // 2, sizes.token // 4
        self.side = sizes.side
        self.first, self.first_norm = ConvexUp(sizes.token, half), ChannelNorm(half)
        self.second, self.second_norm = ConvexUp(half, quarter), ChannelNorm(quarter)
        self.last = ConvexUp(quarter, 1)

    def forward(self, tokens: Tensor, fine: Tensor, middle: Tensor) -> Tensor:
        """Logits [n, 1, s, s] of tokens [n, token, g, g].

        Args:
            fine, middle: maps of the encoder, [n, token/4, 4g, 4g] and [n, token/2, 2g, 2g].
        """
        x = nn.functional.leaky_relu(self.first_norm(self.first(tokens) + middle), SLOPE)
        x = nn.functional.leaky_relu(self.second_norm(self.second(x) + fine), SLOPE)
        half = self.side // ConvexUp.RATIO
        x = nn.functional.interpolate(x, (half, half), mode="bilinear")
        logits: Tensor = self.last(x)
        return logits.float()


class Heads(nn.Module):
    """Rotation, gripper and collision from the closer look's tokens at the waypoint."""

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        width, self.bins, self.patch = sizes.feature, sizes.rotation_bins, sizes.patch
        self.gripper = _mlp(width, sizes.head, 4)
        self.norm = nn.BatchNorm1d(width)
        self.x, self.y, self.z = (_mlp(width, sizes.head, sizes.rotation_bins) for _ in range(3))
        self.rates: Tensor
        self.register_buffer("rates", code_rates(width), persistent=False)

    def reset_buffers(self) -> None:
        """Compute the codes' rates, if the module was built on meta."""
        self.rates = code_rates(2 * len(self.rates)).to(self.norm.weight.device)

    def features(self, tokens: Tensor, waypoints: Tensor) -> Tensor:
        """What the heads read [b, f] of tokens [b·3, token, g, g] at waypoints [b, 3] of the closer
        look's cube.
        """
        batch, (token, grid) = len(waypoints), tokens.shape[1:3]
        by_view = tokens.view(batch, VIEWS, token, grid, grid)
        pooled = by_view.amax((-2, -1)).transpose(1, 2).flatten(1)  # channel by channel
        pixels = project(waypoints, grid * self.patch) / self.patch  # b v 2
        there = read_maps(tokens, pixels.flatten(0, 1)[:, None]).view(batch, -1)  # view by view
        return torch.cat([pooled, there], -1)

    def forward(self, features: Tensor, rotation: Tensor | None = None) -> dict[str, Tensor]:
        """Logits `gripper` [b, 2], `collision` [b, 2], and of each rotation bin `x`, `y`, `z` [b,
        bins].

        The bin about y is conditioned on the one about x, the one about z on both.

        Args:
            features: [b, f].
            rotation: [b, 3] bins to tell; the most likely ones by default.
        """
        gripper, collision = self.gripper(features).chunk(2, -1)
        normed = self.norm(features)
        x = self.x(normed)
        conditioned = normed + self.code(x.argmax(-1) if rotation is None else rotation[:, 0])
        y = self.y(conditioned)
        conditioned = conditioned + self.code(y.argmax(-1) if rotation is None else rotation[:, 1])
        return {
            "gripper": gripper,
            "collision": collision,
            "x": x,
            "y": y,
            "z": self.z(conditioned),
        }

    def code(self, bins: Tensor) -> Tensor:
        """Sines and cosines [b, f] of bins [b]."""
        angles = bins[:, None] * self.rates
        return torch.cat([angles.sin(), angles.cos()], -1)


class Branch(nn.Module):
    """A look: the transformer and the decoder; of the closer look the heads as well."""

    def __init__(self, sizes: SAM2ActSizes, with_heads: bool = False) -> None:
        super().__init__()
        self.transformer = MultiViewTransformer(sizes)
        self.decoder = HeatmapDecoder(sizes)
        self.heads = Heads(sizes) if with_heads else None


def _mlp(width: int, inner: int, out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(width, inner),
        nn.ReLU(),
        nn.Linear(inner, inner // 2),
        nn.ReLU(),
        nn.Linear(inner // 2, out),
    )


def code_rates(width: int) -> Tensor:
    """Rates [width/2] of the sines and cosines that tell a bin."""
    return torch.exp(torch.arange(0, width, 2) * (-math.log(10_000) / width))


COLOURS = slice(3, 6)
"""The channels of a virtual image that the encoder sees."""


class SAM2ActNetwork(nn.Module):
    """Encoder, bank and both branches. What an episode remembers goes in and comes out; nothing of
    it stays here.
    """

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.encoder = ImageEncoder(sizes)
        self.memory = KeyframeBank(
            grid=sizes.grid,
            token=sizes.token,
            memory=sizes.memory,
            layers=sizes.memory_layers,
            feedforward=sizes.memory_feedforward,
            mask_stages=sizes.mask_stages,
            remembered=sizes.remembered,
        )
        self.coarse = Branch(sizes)
        self.fine = Branch(sizes, with_heads=True)

    def recompute(self, mode: Recompute) -> None:
        """Compute the transformer layers' activations again in the backward pass, or keep them."""
        self.coarse.transformer.recomputed = self.fine.transformer.recomputed = mode

    def encode_views(self, images: Tensor, state: Tensor, language: Tensor) -> EncodedViews:
        """What a branch reads: virtual images [b, 3, 10, s, s], the state [b, p], the goal's tokens
        [b, l, w].
        """
        return EncodedViews(
            images, self.encoder(images[:, :, COLOURS].flatten(0, 1)), state, language
        )

    def coarse_step(self, views: EncodedViews, remembered: BankState) -> tuple[Tensor, BankState]:
        """Heatmap logits [b, 3, 1, s, s] of the coarse views, and what is remembered after it."""
        tokens = self.coarse.transformer(views)
        positions = released_positions(self.coarse.transformer.positions, len(views.images))
        return self._store_and_decode(views, tokens, positions, remembered)

    def coarse_alone(self, views: EncodedViews) -> Tensor:
        """Heatmap logits [b, 3, 1, s, s] of the coarse look of episodes that remember nothing."""
        logits: Tensor = self.coarse.decoder(self.coarse.transformer(views), *views.maps[:2])
        return logits.unflatten(0, (-1, VIEWS))

    def coarse_sequences(self, views: EncodedViews, length: int) -> Tensor:
        """Heatmap logits [b, 3, 1, s, s] of sequences of keyframes, each with a bank of its own
        that begins empty.

        Gradients flow through everything that is remembered.

        Args:
            views: of b = n · length keyframes, sequence by sequence.
        """
        batch = len(views.images)
        tokens = self.coarse.transformer(views)
        positions = released_positions(self.coarse.transformer.positions, batch)
        rows = torch.arange(batch * VIEWS, device=tokens.device).view(-1, length, VIEWS)
        remembered = self.memory.init_state()
        decoded = []
        for step in range(length):
            now = rows[:, step].flatten()
            maps = (views.maps[0][now], views.maps[1][now], views.maps[2][now])
            here = replace(views, maps=maps)
            logits, remembered = self._store_and_decode(
                here, tokens[now], positions[now], remembered
            )
            decoded.append(logits)
        return torch.stack(decoded, 1).flatten(0, 1)

    def _store_and_decode(
        self, views: EncodedViews, tokens: Tensor, positions: Tensor, remembered: BankState
    ) -> tuple[Tensor, BankState]:
        enriched = self.memory.read(remembered, tokens, positions)
        logits = self.coarse.decoder(enriched, *views.maps[:2])
        return logits.unflatten(0, (-1, VIEWS)), self.memory.update(remembered, tokens, logits)

    def fine_step(self, views: EncodedViews) -> tuple[Tensor, Tensor]:
        """Heatmap logits [b, 3, 1, s, s] of the closer views, and its tokens [b·3, token, g, g] for
        the heads.
        """
        tokens = self.fine.transformer(views)
        logits: Tensor = self.fine.decoder(tokens, *views.maps[:2])
        return logits.unflatten(0, (-1, VIEWS)), tokens

    def heads(
        self, tokens: Tensor, waypoints: Tensor, rotation: Tensor | None = None
    ) -> dict[str, Tensor]:
        """What to do at waypoints [b, 3] of the closer look's cube: see `Heads.forward`."""
        heads = self.fine.heads
        assert heads is not None
        outputs: dict[str, Tensor] = heads(heads.features(tokens, waypoints), rotation)
        return outputs
