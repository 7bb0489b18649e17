"""The one-dimensional U-Net of Diffusion Policy: it predicts the noise of an action chunk under a
condition.

Module names inside are those of the authors' checkpoints.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.backbone.pi05 import initialise
from mme_vla.backbone.siglip import VisionTower
from mme_vla.errors import missing_extra, require
from mme_vla.extras.methods.diffusion_policy.config import DiffusionSizes
from mme_vla.speed import Recompute, run_layer

Schedule = Any
"""A `diffusers.DDPMParallelScheduler`, imported only where it is used."""


def noise_schedule(steps: int) -> Schedule:
    """A squared-cosine schedule of so many steps that predicts noise and clips its guesses of the
    chunk to ±1.

    It moves its own tables to where it is used: make a new one for each use.
    """
    from diffusers import DDPMParallelScheduler

    with torch.device("cpu"):  # also where a policy is built on meta
        return DDPMParallelScheduler(
            num_train_timesteps=steps,
            beta_schedule="squaredcos_cap_v2",
            variance_type="fixed_small",
            clip_sample=True,
            prediction_type="epsilon",
        )


def denoise_once(
    schedule: Schedule, predicted: Tensor, step: int, x: Tensor, fresh: Tensor | None
) -> Tensor:
    """One step of the way back, from the predicted noise and fresh noise of the same shape, which
    step 0 needs not.
    """
    steps = torch.full((len(x),), step, device=x.device)
    mean: Tensor = schedule.batch_step_no_noise(predicted, steps, x)
    if step == 0 or fresh is None:
        return mean
    variance: Tensor = schedule._get_variance(step)
    return mean + variance.to(x) ** 0.5 * fresh


def sample(
    schedule: Schedule, predict: Callable[[Tensor, Tensor], Tensor], start: Tensor, fresh: Tensor,
    steps: int | None = None,
) -> Tensor:  # fmt: skip
    """From noise to chunks.

    Args:
        predict: (noisy chunks [b, h, a], steps [b]) → their noise.
        start: [b, h, a].
        fresh: [b, steps − 1, h, a], what is added after each step but the last.
        steps: fewer than the schedule's.
    """
    total = int(schedule.config.num_train_timesteps)
    require(
        steps is None or 0 < steps <= total,
        f"flow_steps={steps}: Diffusion Policy samples in 1 to {total} steps.",
    )
    schedule.set_timesteps(steps or total)
    x = start
    for i, step in enumerate(schedule.timesteps.tolist()):
        predicted = predict(x, torch.full((len(x),), step, device=x.device))
        x = denoise_once(schedule, predicted, step, x, fresh[:, i] if step else None)
    return x


CHANNELS = 512
"""Of ResNet-18's last stage."""


def build_image_encoder() -> nn.Sequential:
    """ResNet-18 without pooling and classifier, fresh, a group norm of 16 channels a group for each
    batch norm.

    Images [n, 3, H, W] → [n, 512, ⌈H/32⌉, ⌈W/32⌉].
    """
    try:
        from torchvision.models import resnet18
    except ImportError:
        raise missing_extra("Diffusion Policy", "baselines") from None
    network = resnet18(
        weights=None, norm_layer=lambda channels: nn.GroupNorm(channels // 16, channels)
    )
    return nn.Sequential(*list(network.children())[:8])


def cell_centres(height: int, width: int, device: torch.device | None = None) -> Tensor:
    """(x, y) of each cell of a map in [−1, 1], row by row: [height·width, 2]."""
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height, device=device),
        torch.linspace(-1, 1, width, device=device),
        indexing="ij",
    )
    return torch.stack([x.flatten(), y.flatten()], dim=-1)


class SpatialSoftmax(nn.Module):
    """Maps [n, c, H, W] → the expected place (x, y) of each of k learned features, [n, k, 2] in
    [−1, 1].
    """

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.nets = nn.Conv2d(channels, keypoints, 1)

    def forward(self, features: Tensor) -> Tensor:
        maps = self.nets(features)
        weights = maps.flatten(2).softmax(-1)
        height, width = maps.shape[-2:]
        return weights @ cell_centres(height, width, maps.device).to(weights)


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
    """Two blocks with a shortcut; between them each channel is scaled and shifted by the condition
    (not 1 + scale).
    """

    def __init__(self, channels: int, out: int, condition: int, kernel: int, groups: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            [ConvBlock(channels, out, kernel, groups), ConvBlock(out, out, kernel, groups)]
        )
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
        self,
        action_dim: int,
        condition: int,
        step_width: int,
        widths: Sequence[int],
        kernel: int,
        groups: int,
    ) -> None:
        """Build the network.

        Args:
            condition: c.
            step_width: of the embedded diffusion step.
            widths: channels of each level, each with half the steps of the one before.
            kernel, groups: of all blocks.
        """
        super().__init__()
        self.diffusion_step_encoder = nn.Sequential(
            StepSinusoid(step_width),
            nn.Linear(step_width, 4 * step_width),
            nn.Mish(),
            nn.Linear(4 * step_width, step_width),
        )
        unit = partial(
            ConditionedUnit, condition=step_width + condition, kernel=kernel, groups=groups
        )
        last = widths[-1]
        self.mid_modules = nn.ModuleList([unit(last, last), unit(last, last)])
        levels = list(zip([action_dim, *widths[:-1]], widths, strict=True))
        self.down_modules = nn.ModuleList()
        for number, (before, width) in enumerate(levels):
            half: nn.Module = nn.Identity()
            if number < len(levels) - 1:
                half = Resample(nn.Conv1d(width, width, 3, 2, 1))
            self.down_modules.append(nn.ModuleList([unit(before, width), unit(width, width), half]))
        self.up_modules = nn.ModuleList()
        for before, width in reversed(levels[1:]):  # the first level's skip is never read
            twice = Resample(nn.ConvTranspose1d(before, before, 4, 2, 1))
            self.up_modules.append(
                nn.ModuleList([unit(2 * width, before), unit(before, before), twice])
            )
        first = widths[0]
        self.final_conv = nn.Sequential(
            ConvBlock(first, first, kernel, FINAL_GROUPS), nn.Conv1d(first, action_dim, 1)
        )

    def forward(self, chunk: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        condition = torch.cat([self.diffusion_step_encoder(step), condition], dim=-1)
        x = chunk.mT
        skips = []
        # lists of modules, whose own modules type checkers do not see
        down: Any = self.down_modules
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


class DiffusionNetwork(nn.Module):
    """What learns: one image encoder for all cameras, keypoints, a projection of the words, and the
    U-Net.

    With a memory, a frozen vision tower turns remembered frames into the tokens that memories
    store.
    """

    def __init__(
        self,
        sizes: DiffusionSizes,
        cameras: int,
        state_width: int,
        memory_feature: int = 0,
        tower: bool = False,
    ) -> None:
        """Build it.

        Args:
            memory_feature: numbers that a memory adds to the condition.
            tower: whether frames are to be remembered.
        """
        super().__init__()
        self.sizes = sizes
        self.recomputed: Recompute = False
        # The tower comes first: with one seed it is the same whatever else is built, and so is a
        # cache made by it.
        if tower:
            self.vision = VisionTower(sizes.memory_tower, sizes.memory_width)
            initialise(self.vision)
        self.image_encoder = build_image_encoder()
        # Keypoints x0, y0, x1, … As trained, a ReLU follows: what lies left or above has a 0 there.
        self.image_pool = nn.Sequential(
            SpatialSoftmax(CHANNELS, sizes.keypoints), nn.Flatten(), nn.ReLU()
        )
        self.text_proj = nn.Sequential(
            nn.LayerNorm(sizes.text_dim),
            nn.Linear(sizes.text_dim, sizes.text_hidden),
            nn.ReLU(),
            nn.Linear(sizes.text_hidden, sizes.text_width),
        )
        step = cameras * 2 * sizes.keypoints + state_width + sizes.text_width
        self.condition_width = sizes.window * step + memory_feature
        self.unet = ConditionalUnet1d(
            sizes.action_dim,
            self.condition_width,
            sizes.step_width,
            sizes.widths,
            sizes.kernel,
            sizes.groups,
        )

    def condition(
        self, images: Tensor, state: Tensor, text: Tensor, memory: Tensor | None = None
    ) -> Tensor:
        """The condition [b, c]: for each step keypoints of all cameras, state and words; then the
        memory's feature.

        Args:
            images: [b, t, v, 3, h, w] in [−1, 1], cropped.
            state: [b, t, s] normalised.
            text: [b, d] of unit length.
        """
        flat = images.flatten(0, 2)
        features = run_layer(self.image_encoder, flat, how=self.training and self.recomputed)
        points = self.image_pool(features).unflatten(0, images.shape[:3]).flatten(2)  # b t (v k 2)
        words = self.text_proj(text)[:, None].expand(-1, images.shape[1], -1)
        steps = torch.cat([points, state, words], dim=-1).flatten(1)
        return steps if memory is None else torch.cat([steps, memory], dim=-1)
