"""MemoryVLA's action head: a diffusion transformer over a chunk, conditioned on cognition and
perceptual tokens.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.backbone.base import check_positive
from mme_vla.errors import check_choice, check_multiple, require

STEPS = 100
LARGEST_BETA = 0.999


@dataclass(frozen=True)
class Schedule:
    """How much of a chunk is left after each step: alphas_cumprod [t], products in float64."""

    betas: np.ndarray
    alphas_cumprod: np.ndarray

    @classmethod
    def cosine(cls, steps: int = STEPS) -> "Schedule":
        """Nichol and Dhariwal's: β_i = 1 − ā((i+1)/n) / ā(i/n), capped; ā(u) = cos²((u +
        0.008)/1.008 · π/2).
        """
        u = np.arange(steps + 1) / steps
        left = np.cos((u + 0.008) / 1.008 * np.pi / 2) ** 2
        betas = np.minimum(1 - left[1:] / left[:-1], LARGEST_BETA)
        return cls(betas, np.cumprod(1 - betas))

    def __len__(self) -> int:
        return len(self.betas)

    def noised(self, actions: Tensor, noise: Tensor, steps: Tensor) -> Tensor:
        """Chunks [b, h, a] after `steps` [b] of noising: √ā·actions + √(1 − ā)·noise."""
        left = torch.from_numpy(self.alphas_cumprod).to(actions.device)[steps.to(actions.device)][
            :, None, None
        ]
        return left.sqrt().to(actions) * actions + (1 - left).sqrt().to(actions) * noise

    def ddim_steps(self, count: int) -> np.ndarray:
        """The steps that DDIM visits, ascending: every k-th from 0, with the smallest k that gives
        exactly `count`.

        Raises:
            UserError: no k does.
        """
        strides = {math.ceil(len(self) / stride): stride for stride in range(len(self), 0, -1)}
        require(
            count in strides,
            f"flow_steps={count}: MemoryVLA visits every k-th of {len(self)} diffusion steps, so it"
            f" samples in {', '.join(map(str, sorted(strides)))}.",
        )
        return np.arange(0, len(self), strides[count])

    def ddim(
        self, noise: Tensor, count: int, predict: Callable[[Tensor, int], Tensor]
    ) -> list[Tensor]:
        """Go back from noise [b, h, a] in `count` steps without new noise (η = 0).

        Args:
            predict: (x, step) → the noise in x.

        Returns:
            x after every step; the last is the chunk. Nothing is clipped.
        """
        visited = self.ddim_steps(count)
        left = self.alphas_cumprod[visited]
        before = np.concatenate([[1.0], left[:-1]])
        x = noise
        path = []
        for i in reversed(range(count)):
            predicted = predict(x, int(visited[i]))
            clean = float(np.sqrt(1 / left[i])) * x - float(np.sqrt(1 / left[i] - 1)) * predicted
            x = float(np.sqrt(before[i])) * clean + float(np.sqrt(1 - before[i])) * predicted
            path.append(x)
        return path


TIME_FEATURES = 256
EPS = 1e-6
INITS = ("zero", "xavier")


@dataclass(frozen=True)
class DitConfig:
    """DiT-L by default; S is 384 × 6 layers × 4 heads, B 768 × 12 × 12.

    perceptual_init: how the attention to perceptual tokens begins: `zero`, as released (it begins
        silent), or `xavier`.
    """

    width: int = 1024
    depth: int = 24
    num_heads: int = 16
    perceptual_init: str = "zero"

    def __post_init__(self) -> None:
        check_positive(self, "backbone.head.")
        check_multiple("backbone.head.", "width", self.width, "num_heads", self.num_heads)
        check_choice("backbone.head.perceptual_init", self.perceptual_init, INITS)


class DitBlock(nn.Module):
    """Self-attention over the chunk, attention to the perceptual tokens, an MLP; norms
    before each.
    """

    def __init__(self, width: int, heads: int) -> None:
        from timm.layers import Attention, GELUTanh, Mlp

        super().__init__()
        norm = partial(nn.LayerNorm, width, eps=EPS, elementwise_affine=False)
        self.norm, self.mlp_norm = norm(), norm()
        self.attention = Attention(width, num_heads=heads, qkv_bias=True)
        self.cross_norm = nn.LayerNorm(width, eps=EPS)
        self.cross = nn.MultiheadAttention(width, heads, batch_first=True)
        self.mlp = Mlp(width, 4 * width, act_layer=GELUTanh)

    def forward(self, x: Tensor, perceptual: Tensor) -> Tensor:
        x = x + self.attention(self.norm(x))
        x = x + self.cross(self.cross_norm(x), perceptual, perceptual, need_weights=False)[0]
        return x + self.mlp(self.mlp_norm(x))


class Dit(nn.Module):
    """Predicts the noise in a chunk.

    The time and the cognition token make one token in front of the chunk's. In training the
    cognition token of some samples gives way to a learned empty one, which guidance uses later;
    perceptual tokens always stay.
    """

    def __init__(
        self, config: DitConfig, action_dim: int, horizon: int, d_cognition: int, d_perceptual: int
    ) -> None:
        super().__init__()
        width = config.width
        self.action = nn.Linear(action_dim, width)
        self.time_in, self.time_out = nn.Linear(TIME_FEATURES, width), nn.Linear(width, width)
        self.nothing = nn.Parameter(torch.empty(1, d_cognition))
        self.cognition = nn.Linear(d_cognition, width)
        self.perceptual = nn.Linear(d_perceptual, width)
        self.positions = nn.Parameter(torch.empty(horizon + 1, width))
        self.blocks = nn.ModuleList(DitBlock(width, config.num_heads) for _ in range(config.depth))
        self.norm = nn.LayerNorm(width, eps=EPS, elementwise_affine=False)
        self.output = nn.Linear(width, action_dim)

        # Fresh weights
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)
        for weight in (self.action, self.cognition, self.perceptual, self.time_in, self.time_out):
            nn.init.normal_(weight.weight, std=0.02)
        nn.init.normal_(self.nothing, std=0.02)
        nn.init.normal_(self.positions, std=self.positions.shape[1] ** -0.5)
        nn.init.zeros_(self.output.weight)
        for block in self.blocks:
            cross: nn.MultiheadAttention = block.cross  # type: ignore[assignment]
            assert cross.in_proj_weight is not None and cross.in_proj_bias is not None
            nn.init.zeros_(cross.in_proj_bias)
            if config.perceptual_init == "zero":
                nn.init.zeros_(cross.in_proj_weight)

    def tokens(
        self, x: Tensor, steps: Tensor, cognition: Tensor, drop: Tensor | None = None
    ) -> Tensor:
        """What the first block reads [b, h + 1, d].

        Args:
            x: noised chunks [b, h, a].
            steps: [b].
            cognition: [b, 1, d_cognition].
            drop: [b] bool; whose cognition token gives way.
        """
        if drop is not None:
            cognition = torch.where(drop[:, None, None], self.nothing, cognition)
        # [cos(t f) | sin(t f)], f_j = 10000^(−j/half): [b, TIME_FEATURES].
        half = TIME_FEATURES // 2
        ramp = torch.arange(half, device=steps.device, dtype=torch.float32) / half
        angles = steps.float()[:, None] * 10_000.0**-ramp
        time = torch.cat([angles.cos(), angles.sin()], -1).to(self.time_in.weight.dtype)
        time = self.time_out(nn.functional.silu(self.time_in(time)))
        first = time[:, None] + self.cognition(cognition)
        return torch.cat([first, self.action(x)], 1) + self.positions

    def forward(
        self,
        x: Tensor,
        steps: Tensor,
        cognition: Tensor,
        perceptual: Tensor,
        drop: Tensor | None = None,
    ) -> Tensor:
        """The noise [b, h, a] in x [b, h, a] at `steps` [b]; perceptual tokens [b, p,
        d_perceptual].
        """
        read = self.perceptual(perceptual)
        tokens = self.tokens(x, steps, cognition, drop)
        for block in self.blocks:
            tokens = block(tokens, read)
        return self.output(self.norm(tokens))[:, 1:]

    def guided(
        self, x: Tensor, steps: Tensor, cognition: Tensor, perceptual: Tensor, scale: float
    ) -> Tensor:
        """The noise, pushed away from what it would be without a cognition token; a scale of 1
        pushes nothing.
        """
        if scale == 1:
            return self(x, steps, cognition, perceptual)
        drop = torch.arange(2, device=x.device).bool().repeat_interleave(len(x))
        twice = (torch.cat([part, part]) for part in (x, steps, cognition, perceptual))
        conditional, unasked = self(*twice, drop=drop).chunk(2)
        return unasked + scale * (conditional - unasked)
