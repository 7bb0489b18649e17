"""Diffusion of action chunks: the cosine schedule, its noising, and DDIM's way back."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

STEPS = 100
LARGEST_BETA = 0.999


@dataclass(frozen=True)
class Schedule:
    """How much of a chunk is left after each step: alphas_cumprod [t], products in float64."""

    betas: np.ndarray
    alphas_cumprod: np.ndarray

    @classmethod
    def cosine(cls, steps: int = STEPS) -> "Schedule":
        """Nichol and Dhariwal's: β_i = 1 − ā((i+1)/n) / ā(i/n), capped; ā(u) = cos²((u + 0.008)/1.008 · π/2)."""
        u = np.arange(steps + 1) / steps
        left = np.cos((u + 0.008) / 1.008 * np.pi / 2) ** 2
        betas = np.minimum(1 - left[1:] / left[:-1], LARGEST_BETA)
        return cls(betas, np.cumprod(1 - betas))

    def __len__(self) -> int:
        return len(self.betas)

    def noised(self, actions: Tensor, noise: Tensor, steps: Tensor) -> Tensor:
        """Chunks [b, h, a] after `steps` [b] of noising: √ā·actions + √(1 − ā)·noise."""
        left = torch.from_numpy(self.alphas_cumprod).to(actions.device)[steps.to(actions.device)][:, None, None]
        return left.sqrt().to(actions) * actions + (1 - left).sqrt().to(actions) * noise

    def ddim_steps(self, count: int) -> np.ndarray:
        """The steps that DDIM visits, ascending: every k-th from 0, with the smallest k that gives exactly `count`.

        Raises:
            ValueError: no k does.
        """
        for stride in range(1, len(self) + 1):
            visited = np.arange(0, len(self), stride)
            if len(visited) == count:
                return visited
        raise ValueError(f"No whole stride visits {count} of {len(self)} diffusion steps; choose another number.")

    def ddim(self, noise: Tensor, count: int, predict: Callable[[Tensor, int], Tensor]) -> list[Tensor]:
        """Go back from noise [b, h, a] in `count` steps without new noise (η = 0).

        Args:
            predict: (x, step) → the noise in x.

        Returns:
            x after every step; the last is the chunk. Nothing is clipped.
        """
        visited = self.ddim_steps(count)
        left = self.alphas_cumprod[visited]
        before = np.concatenate([[1.0], left[:-1]])
        x, path = noise, []
        for i in reversed(range(count)):
            found = predict(x, int(visited[i]))
            clean = float(np.sqrt(1 / left[i])) * x - float(np.sqrt(1 / left[i] - 1)) * found
            x = float(np.sqrt(before[i])) * clean + float(np.sqrt(1 - before[i])) * found
            path.append(x)
        return path
