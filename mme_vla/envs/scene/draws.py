"""Random numbers of one scene: the same seed draws the same layout as the official benchmark.

All layout randomness comes from CPU torch generators seeded with the episode's seed, never from the simulator's own
random numbers, and the order of the draws is part of the benchmark's definition.
"""

import torch
from torch import Tensor


class Draws:
    """One generator, with the few kinds of draws that scenes are made of.

    Args:
        seed: the episode's seed.
    """

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def uniform(self) -> float:
        """One number in [0, 1)."""
        return torch.rand(1, generator=self._generator).item()

    def uniforms(self, n: int) -> Tensor:
        """`n` numbers in [0, 1) drawn in one call, float32 [n]; not the same stream as `n` single draws."""
        return torch.rand(n, generator=self._generator)

    def between(self, low: float, high: float) -> float:
        """One number in [low, high), as torch's in-place `uniform_` draws it."""
        return torch.empty(1).uniform_(low, high, generator=self._generator).item()

    def integer(self, low: int, high: int) -> int:
        """One integer in low … high - 1."""
        return int(torch.randint(low, high, (1,), generator=self._generator).item())

    def permutation(self, n: int) -> list[int]:
        """The numbers 0 … n - 1 in random order."""
        return torch.randperm(n, generator=self._generator).tolist()

    def coin(self) -> bool:
        """True in half of the cases: one uniform below 0.5."""
        return self.uniform() < 0.5

    def state(self) -> Tensor:
        """Where the stream stands, for `restore`."""
        return self._generator.get_state()

    def restore(self, state: Tensor) -> None:
        """Go back to where the stream stood when `state` was taken."""
        self._generator.set_state(state)
