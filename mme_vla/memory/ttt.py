"""TTT: memory as the weights of a small linear model that learns from every frame as it comes
(paper, section 4.2).
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from mme_vla.errors import check_sizes, require
from mme_vla.memory.recurrent import (
    RecurrentLayer,
    RecurrentMemory,
    State,
    Statistics,
    default_hidden,
    full_precision,
    layer_norm,
    linear,
)
from mme_vla.registry import MEMORIES

EPS = 1e-6
INNER_EPS = 1e-8

Weights = tuple[Tensor, Tensor]
"""W [b, h, w, w] and b [b, h, w] of the inner models."""


class InnerOutput(NamedTuple):
    """The inner model's output at some tokens, and intermediate values that the gradient needs."""

    output: Tensor
    unit: Tensor  # z / rms(z)
    inverse_rms: Tensor  # 1 / rms(z)


class TTTLayer(RecurrentLayer):
    """Per head, a linear model W, b with an RMS norm N, trained to map keys to (value − key) by one
    step a frame.

    The loss of a frame is Σ ½‖N(kW + b) − (v − k)‖², each token weighted by a learned rate;
    gradients of W and of b are clipped by norm, each for itself. A frame's output, N(qW + b) + q,
    uses the weights it has just updated. N is trained with the network and does not change inside.

    State: W [b, h, d/h, d/h], b [b, h, d/h], the outputs of the last frames [b, r, p, d] and which
    of these were real [b, r]. W and b are carried in the dtype their initial values are stored in.
    """

    window: int

    def __init__(
        self,
        hidden: int,
        heads: int,
        budget: int,
        patches: int,
        base_rate: float,
        max_rate: float,
        max_grad_norm: float,
    ) -> None:
        super().__init__()
        require(
            hidden % heads == 0,
            f"memory.hidden={hidden} must be a multiple of memory.heads={heads}.",
        )
        positive = min(base_rate, max_rate, max_grad_norm) > 0
        require(
            positive, "memory.base_rate, memory.max_rate and memory.max_grad_norm must be above 0."
        )
        width = hidden // heads
        self.heads = heads
        self.budget = budget
        self.patches = patches
        self.window = -(-budget // patches)
        self.base_rate = base_rate
        self.max_rate = max_rate
        self.max_grad_norm = max_grad_norm
        self.q, self.k, self.v, self.out = (nn.Linear(hidden, hidden, bias=False) for _ in range(4))
        self.q_norm, self.k_norm, self.v_norm = (nn.LayerNorm(width, eps=EPS) for _ in range(3))
        self.out_norm = nn.LayerNorm(hidden, eps=EPS)
        self.rate = nn.Linear(hidden, heads)
        self.weight = nn.Parameter(torch.randn(heads, width, width) * width**-0.5)
        self.bias = nn.Parameter(torch.zeros(heads, width))
        self.inner_norm = nn.Parameter(torch.zeros(heads, 2, width))  # N's scale and shift
        for layer in (self.q, self.k, self.rate):
            nn.init.normal_(layer.weight, std=0.02)
        for layer in (self.v, self.out):
            nn.init.normal_(layer.weight, std=0.01)
        nn.init.zeros_(self.rate.bias)

    @property
    def rate_constant(self) -> float:
        """What softplus maps to the base rate: log(exp(base_rate) − 1)."""
        return math.log(math.expm1(self.base_rate))

    def initial(self, batch: int) -> State:
        outputs = self.weight.new_zeros(
            batch, self.window, self.patches, self.out.out_features, dtype=torch.float32
        )
        window_valid = torch.zeros(batch, self.window, dtype=torch.bool, device=outputs.device)
        weight = self.weight.expand(batch, *self.weight.shape)
        bias = self.bias.expand(batch, *self.bias.shape)
        return weight, bias, outputs, window_valid

    def advance(
        self, state: State, x: Tensor, valid: Tensor, following: int = 0, statistics: bool = False
    ) -> tuple[State, Statistics]:
        with full_precision(x):
            weight, bias, outputs, window_valid = state
            steps, window = x.shape[1], outputs.shape[1]
            x = x.float()
            k = layer_norm(self.k_norm, self._by_head(linear(self.k, x)))  # b t h p w
            v = layer_norm(self.v_norm, self._by_head(linear(self.v, x)))
            raw = nn.functional.softplus(linear(self.rate, x) + self.rate_constant)  # b t p h
            rate = raw.clamp(0, self.max_rate).transpose(2, 3)[..., None]  # b t h p 1
            # Only the outputs of the last frames are still in the window at the end.
            n_read = min(steps, max(window - following, 0))
            first_read = steps - n_read
            q = layer_norm(self.q_norm, self._by_head(linear(self.q, x[:, first_read:])))
            # Unbound and not indexed: the gradient of each index would fill all frames.
            keys, values, rates, queries = (each.unbind(1) for each in (k, v, rate, q))
            head_outputs = []
            numbers: list[Statistics] = []
            for t in range(steps):
                real = valid[:, t, None, None]
                before = (weight, bias)
                new_weight, new_bias, norms = self.learn(weight, bias, keys[t], values[t], rates[t])
                weight = torch.where(real[..., None], new_weight, weight)
                bias = torch.where(real, new_bias, bias)
                if t >= first_read:
                    query = queries[t - first_read]
                    output = self.inner(weight, bias, query).output + query
                    head_outputs.append(torch.where(real[..., None], output, 0))
                if statistics:
                    after = (weight, bias)
                    numbers.append(self._statistics(before, after, keys[t], values[t], norms))
            if n_read:
                mixed = torch.stack(head_outputs, 1).transpose(2, 3).flatten(3)  # b t p d
                y = x[:, first_read:] + linear(self.out, layer_norm(self.out_norm, mixed))
                outputs = torch.cat([outputs, y], 1)[:, -window:]
                window_valid = torch.cat([window_valid, valid[:, first_read:]], 1)[:, -window:]
            per_step: Statistics = {}
            if statistics:
                for name in numbers[0]:
                    per_step[name] = torch.stack([frame[name] for frame in numbers], 1)
                per_step["step_size"] = rate.detach().mean((2, 3, 4))
                per_step["clipped_rates"] = (raw.detach() > self.max_rate).float().mean((2, 3))
            return (weight, bias, outputs, window_valid), per_step

    def read(self, state: State) -> tuple[Tensor, Tensor]:
        _, _, outputs, window_valid = state
        mask = window_valid[..., None].expand(*window_valid.shape, self.patches)
        return outputs.flatten(1, 2)[:, -self.budget :], mask.flatten(1)[:, -self.budget :]

    def summary(self, start: State, end: State) -> dict[str, Tensor]:
        before, after = start[0].detach().float(), end[0].detach().float()
        change = (after - before).flatten(1).norm(dim=1) / before.flatten(1).norm(dim=1)
        return {"weight_change": change.mean()}

    def inner(self, weight: Tensor, bias: Tensor, at: Tensor) -> InnerOutput:
        """The inner model at tokens [b, h, p, w]."""
        z = at @ weight.float() + bias.float()[:, :, None]
        inverse_rms = torch.rsqrt(z.square().mean(-1, keepdim=True) + INNER_EPS)
        unit = z * inverse_rms
        scale, shift = self.inner_norm.float().unbind(1)
        return InnerOutput(unit * (1 + scale[:, None]) + shift[:, None], unit, inverse_rms)

    def learn(
        self, weight: Tensor, bias: Tensor, k: Tensor, v: Tensor, rate: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One gradient step on one frame: new W, new b, and the norms of both gradients [b, h, 2]
        before clipping.
        """
        output, unit, inverse_rms = self.inner(weight, bias, k)
        # The gradient of the loss with respect to kW + b, through the norm.
        error = (output - (v - k)) * (1 + self.inner_norm[:, 0, None].float())
        centred = error - unit * (error * unit).mean(-1, keepdim=True)
        delta = rate * inverse_rms * centred  # b h p w
        weight_gradient = k.transpose(-1, -2) @ delta
        bias_gradient = delta.sum(-2)
        weight_norm = torch.linalg.vector_norm(weight_gradient, dim=(-2, -1))
        bias_norm = torch.linalg.vector_norm(bias_gradient, dim=-1)
        norms = torch.stack([weight_norm, bias_norm], -1)
        limit = self.max_grad_norm
        factor = torch.where(norms > limit, limit / (norms + INNER_EPS), 1.0)
        new_weight = weight.float() - weight_gradient * factor[..., :1, None]
        new_bias = bias.float() - bias_gradient * factor[..., 1:]
        return new_weight.to(weight.dtype), new_bias.to(bias.dtype), norms

    @torch.no_grad()
    def _statistics(
        self, before: Weights, after: Weights, k: Tensor, v: Tensor, norms: Tensor
    ) -> Statistics:
        def loss(weights: Weights) -> Tensor:
            return (self.inner(*weights, k).output - (v - k)).square().mean((1, 2, 3))

        return {
            "inner_loss_before": loss(before),
            "inner_loss_after": loss(after),
            "clipped_gradients": (norms > self.max_grad_norm).float().mean((1, 2)),
        }

    def _by_head(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.heads, -1)).transpose(-2, -3)


@MEMORIES.register("ttt")
class TTT(RecurrentMemory):
    """The outputs of the last budget / grid² frames, from weights that have learned from all frames
    before them.
    """

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 512,
        grid: int = 8,
        hidden: int | None = None,
        heads: int = 2,
        base_rate: float = 0.01,
        max_rate: float = 0.1,
        max_grad_norm: float = 5.0,
        max_steps: int = 64,
        **options: Any,
    ) -> None:
        """See `RecurrentMemory` and `TTTLayer`.

        Args:
            hidden: width of the recurrence; None is a quarter of `d_vision`, at least 64.
            heads: inner models.
            base_rate: inner learning rate at the start.
            max_rate: its ceiling, per token and head.
            max_grad_norm: ceiling of an inner gradient's norm.
        """
        require(
            0 < budget <= max_steps * grid**2,
            f"memory.budget={budget} must lie between 1 and memory.max_steps × grid² ="
            f" {max_steps * grid**2}: TTT returns one token for each that it reads.",
        )
        check_sizes("memory", budget=budget, heads=heads)
        hidden = default_hidden(d_vision, hidden)
        layer = TTTLayer(hidden, heads, budget, grid**2, base_rate, max_rate, max_grad_norm)
        super().__init__(
            d_vision, width, layer, hidden, budget, grid, max_steps=max_steps, **options
        )
