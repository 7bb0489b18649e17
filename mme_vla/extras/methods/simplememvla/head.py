"""The action head of SimpleMemVLA: a flow-matching transformer that reads the hidden states of the
sub-task's words.

Shapes: b batch · S words of a response · h actions of a chunk · d width of the head · D width of
the language model · n = S + 1 + h tokens of the head.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.backbone.flow import interpolate
from mme_vla.extras.methods.simplememvla.config import HeadSizes
from mme_vla.speed import fused_kernels
from mme_vla.types import TensorStruct

TIME_FREQUENCIES = 128


@dataclass
class Condition(TensorStruct):
    """What a chunk is sampled under: the words of the sub-task as the language model reads them.

    hidden: [b, S, D] after the final norm.
    tokens: [b, S, D] input embeddings; None for none.
    positions: [b, 3, S].
    mask: [b, S] bool, False on padding.
    """

    hidden: Tensor
    tokens: Tensor | None
    positions: Tensor
    mask: Tensor


def scaled_section(section: tuple[int, ...], half: int) -> list[int]:
    """Shares of the axes in `half` angles: rounded down, the remainder to the largest fractions,
    first ones first.
    """
    total = sum(section)
    exact = [half * share / total for share in section]
    counts = [math.floor(value) for value in exact]
    order = sorted(range(len(section)), key=lambda i: (-(exact[i] - counts[i]), i))
    for i in order[: half - sum(counts)]:
        counts[i] += 1
    return counts


class Rotary(nn.Module):
    """Rotary angles of three coordinates, in turn: time, row, column, time and so on."""

    def __init__(self, head_dim: int, sizes: HeadSizes) -> None:
        super().__init__()
        self.count = int(head_dim * sizes.rope_factor) // 2
        self.theta, self.section = sizes.rope_theta, scaled_section(sizes.rope_section, self.count)

    def forward(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Positions [b, 3, n] → cosines and sines [b, n, r] float32."""
        index = torch.arange(self.count, device=positions.device, dtype=torch.float32)
        frequencies = 1.0 / self.theta ** (index / self.count)
        angles = positions.float()[..., None] * frequencies  # b 3 n half
        mixed = angles[:, 0].clone()
        for axis in (1, 2):
            place = slice(axis, self.section[axis] * 3, 3)
            mixed[..., place] = angles[:, axis, :, place]
        both = torch.cat([mixed, mixed], -1)
        return both.cos(), both.sin()


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate the first numbers of each head [b, heads, n, k] by angles [b, n, r]; the
    others stay.
    """
    width = cos.shape[-1]
    rotary, remaining = x[..., :width], x[..., width:]
    first, second = rotary.chunk(2, -1)
    cos, sin = (value[:, None].to(x.dtype) for value in (cos, sin))
    return torch.cat([rotary * cos + torch.cat([-second, first], -1) * sin, remaining], -1)


class Attention(nn.Module):
    """Attention of every token to every valid one."""

    def __init__(self, sizes: HeadSizes) -> None:
        super().__init__()
        self.heads, self.dropout = sizes.heads, sizes.dropout
        self.qkv = nn.Linear(sizes.width, 3 * sizes.width)
        self.out_proj = nn.Linear(sizes.width, sizes.width)

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor], mask: Tensor) -> Tensor:
        """Tokens [b, n, d] → [b, n, d]; mask [b, n] bool of the keys."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = rotate(q, *rope), rotate(k, *rope)
        dropout = self.dropout if self.training else 0.0
        with fused_kernels(q):
            read = functional.scaled_dot_product_attention(
                q, k, v.to(q), mask[:, None, None], dropout
            )
        return self.out_proj(read.transpose(1, 2).flatten(2))


def modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """A layer norm without weights, then shift and scale [b, d] of every token of [b, n, d]."""
    normed = functional.layer_norm(x, x.shape[-1:], eps=1e-6)
    return normed * (1 + scale[:, None]) + shift[:, None]


class HeadBlock(nn.Module):
    """Attention and an MLP, each shifted, scaled and gated by the flow time."""

    def __init__(self, sizes: HeadSizes) -> None:
        super().__init__()
        width, inner = sizes.width, int(sizes.width * sizes.mlp_ratio)
        self.attn = Attention(sizes)
        dropout = sizes.dropout
        self.mlp = nn.Sequential(
            nn.Linear(width, inner),
            nn.GELU("tanh"),
            nn.Dropout(dropout),
            nn.Linear(inner, width),
            nn.Dropout(dropout),
        )
        self.adaLN = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(self, x: Tensor, time: Tensor, rope: tuple[Tensor, Tensor], mask: Tensor) -> Tensor:
        """Tokens [b, n, d] under time embeddings [b, d]."""
        shift, scale, gate, mlp_shift, mlp_scale, mlp_gate = self.adaLN(time).chunk(6, -1)
        x = x + gate[:, None] * self.attn(modulate(x, shift, scale), rope, mask)
        return x + mlp_gate[:, None] * self.mlp(modulate(x, mlp_shift, mlp_scale))


class TimeEmbedding(nn.Module):
    """Flow times [b] → [b, d]."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(2 * TIME_FREQUENCIES, width), nn.SiLU(), nn.Linear(width, width)
        )

    def forward(self, time: Tensor) -> Tensor:
        index = torch.arange(TIME_FREQUENCIES, device=time.device, dtype=torch.float32)
        frequencies = torch.exp(-math.log(10_000) * index / (TIME_FREQUENCIES - 1))
        angles = time.float()[:, None] * frequencies
        first: Any = self.mlp[0]
        embedded: Tensor = self.mlp(
            torch.cat([angles.cos(), angles.sin()], -1).to(first.weight.dtype)
        )
        return embedded


class FinalLayer(nn.Module):
    """The last modulation, and a linear layer to the actions."""

    def __init__(self, width: int, action_dim: int) -> None:
        super().__init__()
        self.adaLN = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * width))
        self.linear = nn.Linear(width, action_dim)

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        shift, scale = self.adaLN(time).chunk(2, -1)
        actions: Tensor = self.linear(modulate(x, shift, scale))
        return actions


class ActionHead(nn.Module):
    """Predicts the velocity of noisy chunks from words, a state and a flow time.

    Args:
        condition_dim: D.
        state_dim: numbers of the state; 0 for no state token.
    """

    def __init__(
        self, sizes: HeadSizes, condition_dim: int, action_dim: int, horizon: int, state_dim: int
    ) -> None:
        super().__init__()
        width = sizes.width
        self.sizes, self.horizon, self.action_dim = sizes, horizon, action_dim
        self.condition_proj = nn.Linear(condition_dim, width)
        self.condition_token_proj = nn.Linear(condition_dim, width)
        self.state_proj = nn.Linear(state_dim, width) if state_dim else None
        self.action_proj = nn.Sequential(
            nn.Linear(action_dim, width), nn.SiLU(), nn.Linear(width, width)
        )
        self.time_embed = TimeEmbedding(width)
        self.condition_type = nn.Parameter(torch.empty(1, 1, width))
        if state_dim:
            self.state_type = nn.Parameter(torch.empty(1, 1, width))
        self.action_type = nn.Parameter(torch.empty(1, 1, width))
        self.action_pos = nn.Parameter(torch.empty(1, horizon, width))
        self.rotary = Rotary(width // sizes.heads, sizes)
        self.blocks = nn.ModuleList(HeadBlock(sizes) for _ in range(sizes.depth))
        self.final_layer = FinalLayer(width, action_dim)
        # Modulations and output begin at zero, types and positions at a deviation of 0.02.
        for name, parameter in self.named_parameters():
            if name.endswith("_type") or name == "action_pos":
                nn.init.normal_(parameter, std=0.02)
            elif ".adaLN." in name or name.startswith("final_layer.linear."):
                nn.init.zeros_(parameter)

    def tokens(
        self, condition: Condition, state: Tensor | None, x: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens [b, n, d], positions [b, 3, n] and mask [b, n] for noisy chunks x [b, h, a]."""
        words = (
            functional.normalize(self.condition_proj(condition.hidden), dim=-1)
            + self.condition_type
        )
        if condition.tokens is not None:
            words = words + self.condition_token_proj(condition.tokens)
        end = condition.positions.masked_fill(~condition.mask[:, None], 0).amax((1, 2))
        parts, masks, positions = [words], [condition.mask], [condition.positions]
        count = 0
        if self.state_proj is not None and state is not None:
            parts.append(self.state_proj(state.to(words.dtype))[:, None] + self.state_type)
            is_read = torch.ones(len(state), 1, dtype=torch.bool, device=state.device)
            if self.training and self.sizes.state_dropout:
                chances = torch.rand(len(state), 1, device=state.device)
                is_read = chances >= self.sizes.state_dropout
            masks.append(is_read)
            positions.append((end + 1)[:, None, None].expand(-1, 3, 1))
            count = 1
        steps = torch.arange(x.shape[1], device=x.device)
        actions = (
            self.action_proj(x.to(words.dtype))
            + self.action_type
            + self.action_pos[:, : x.shape[1]]
        )
        positions.append((end[:, None] + 1 + count + steps)[:, None].expand(-1, 3, -1))
        masks.append(torch.ones(x.shape[:2], dtype=torch.bool, device=x.device))
        return torch.cat([*parts, actions], 1), torch.cat(positions, 2), torch.cat(masks, 1)

    def forward(
        self, x: Tensor, time: Tensor, condition: Condition, state: Tensor | None
    ) -> Tensor:
        """The velocity [b, h, a] at noisy chunks x [b, h, a] and flow times [b], 1 = noise.

        Args:
            state: [b, s] normalised.
        """
        tokens, positions, mask = self.tokens(condition, state, x)
        rope, embedded = self.rotary(positions), self.time_embed(time)
        for block in self.blocks:
            tokens = block(tokens, embedded, rope, mask)
        velocity: Tensor = self.final_layer(tokens[:, -x.shape[1] :], embedded)
        return velocity

    def sample(
        self, noise: Tensor, condition: Condition, state: Tensor | None, steps: int
    ) -> Tensor:
        """Integrate from noise [b, h, a] to chunks in Euler steps."""
        x = noise.float()
        for i in range(steps):
            time = torch.full((len(x),), 1 - i / steps, device=x.device)
            x = x - self(x, time, condition, state).float() / steps
        return x

    def loss(
        self,
        actions: Tensor,
        condition: Condition,
        state: Tensor | None,
        noise: Tensor,
        time: Tensor,
        mask: Tensor | None = None,
    ) -> Tensor:
        """The flow-matching loss of chunks [b, h, a]; arguments as for `forward` and
        `channel_loss`.
        """
        x, target = interpolate(actions.float(), noise, time)
        return channel_loss(self(x, time, condition, state), target, mask)


def channel_loss(velocity: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Squared error averaged over a channel's counted steps, over the channels that have one, and
    over samples.

    Args:
        velocity, target: [b, h, a].
        mask: bool [b, h] or [b, h, a], False on steps that do not count.
    """
    errors = (velocity.float() - target.float()).square()
    if mask is None:
        return errors.mean()
    counted = (mask[..., None] if mask.ndim == 2 else mask).expand_as(errors).float()
    steps = counted.sum(1)  # b a
    of_channels = (errors * counted).sum(1) / steps.clamp(min=1)
    has_steps = (steps > 0).float()
    return ((of_channels * has_steps).sum(1) / has_steps.sum(1).clamp(min=1)).mean()
