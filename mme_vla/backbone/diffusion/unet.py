"""The one-dimensional U-Net of Diffusion Policy: it predicts the noise of an action chunk under a condition.

Module names inside are those of the authors' checkpoints.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

FINAL_GROUPS = 8
"""Groups of the last block's norm, whatever the others have (as trained)."""


class StepSinusoid(nn.Module):
    """Diffusion steps [b] → [b, width]: sines, then cosines."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    def forward(self, step: Tensor) -> Tensor:
        half = self.width // 2
        rates = torch.exp(torch.arange(half, device=step.device) * (-math.log(10_000) / (half - 1)))
        angles = step[:, None].to(rates) * rates
        return torch.cat([angles.sin(), angles.cos()], dim=-1)


class ConvBlock(nn.Module):
    """Convolution over time, group norm, Mish: [b, c, n] → [b, c', n]."""

    def __init__(self, channels: int, out: int, kernel: int, groups: int) -> None:
        super().__init__()
        convolution = nn.Conv1d(channels, out, kernel, padding=kernel // 2)
        self.block = nn.Sequential(convolution, nn.GroupNorm(groups, out), nn.Mish())

    def forward(self, x: Tensor) -> Tensor:
        return self.block(x)


class ConditionedUnit(nn.Module):
    """Two blocks with a shortcut; between them each channel is scaled and shifted by the condition (not 1 + scale)."""

    def __init__(self, channels: int, out: int, condition: int, kernel: int, groups: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList([ConvBlock(channels, out, kernel, groups), ConvBlock(out, out, kernel, groups)])
        self.cond_encoder = nn.Sequential(nn.Mish(), nn.Linear(condition, 2 * out))
        self.residual_conv = nn.Conv1d(channels, out, 1) if channels != out else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Activations [b, c, n] under a condition [b, d] → [b, c', n]."""
        scale, shift = self.cond_encoder(condition)[..., None].chunk(2, dim=1)
        y = self.blocks[1](scale * self.blocks[0](x) + shift)
        return y + self.residual_conv(x)


class Resample(nn.Module):
    """Half as many steps, or twice as many."""

    def __init__(self, convolution: nn.Module) -> None:
        super().__init__()
        self.conv = convolution

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


class ConditionalUnet1d(nn.Module):
    """Noisy chunks [b, h, a], diffusion steps [b] and a condition [b, c] → the noise [b, h, a]."""

    def __init__(
        self, action_dim: int, condition: int, step_width: int, widths: Sequence[int], kernel: int, groups: int
    ) -> None:
        """Build the network.

        Args:
            condition: c. step_width: of the embedded diffusion step.
            widths: channels of each level, each with half the steps of the one before. kernel, groups: of all blocks.
        """
        super().__init__()
        self.diffusion_step_encoder = nn.Sequential(
            StepSinusoid(step_width),
            nn.Linear(step_width, 4 * step_width),
            nn.Mish(),
            nn.Linear(4 * step_width, step_width),
        )

        def unit(channels: int, out: int) -> ConditionedUnit:
            return ConditionedUnit(channels, out, step_width + condition, kernel, groups)

        last = widths[-1]
        self.mid_modules = nn.ModuleList([unit(last, last), unit(last, last)])
        levels = list(zip([action_dim, *widths[:-1]], widths, strict=True))
        self.down_modules = nn.ModuleList()
        for number, (before, width) in enumerate(levels):
            half = Resample(nn.Conv1d(width, width, 3, 2, 1)) if number < len(levels) - 1 else nn.Identity()
            self.down_modules.append(nn.ModuleList([unit(before, width), unit(width, width), half]))
        self.up_modules = nn.ModuleList()
        for before, width in reversed(levels[1:]):  # the first level's skip is never read
            twice = Resample(nn.ConvTranspose1d(before, before, 4, 2, 1))
            self.up_modules.append(nn.ModuleList([unit(2 * width, before), unit(before, before), twice]))
        first = widths[0]
        self.final_conv = nn.Sequential(ConvBlock(first, first, kernel, FINAL_GROUPS), nn.Conv1d(first, action_dim, 1))

    def forward(self, chunk: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        condition = torch.cat([self.diffusion_step_encoder(step), condition], dim=-1)
        x, skips = chunk.mT, []
        down: Any = self.down_modules  # lists of modules, whose own modules type checkers do not see
        up: Any = self.up_modules
        for first, second, half in down:
            skips.append(second(first(x, condition), condition))
            x = half(skips[-1])
        for unit in self.mid_modules:
            x = unit(x, condition)
        for first, second, twice in up:
            x = torch.cat([x, skips.pop()], dim=1)
            x = twice(second(first(x, condition), condition))
        return self.final_conv(x).mT
