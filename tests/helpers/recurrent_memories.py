"""Small recurrent memories and an episode of random tokens."""

from typing import Any

import numpy as np
import torch

from mme_vla.memory.base import stack_history
from mme_vla.memory.history import History, StorageSpec
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.memory.rmt import RMT
from mme_vla.memory.ttt import TTT
from mme_vla.types import HistoryTokens

GRID = 2
D_VISION = 24
TOLERANCE = 1e-5
MEMORIES = {
    "ttt": lambda **o: TTT(
        D_VISION, 16, **{"budget": 12, "hidden": 16, "grid": GRID, "chunk": 4, **o}
    ),
    "rmt": lambda **o: RMT(
        D_VISION,
        16,
        **{"budget": 12, "hidden": 16, "grid": GRID, "chunk": 4, "attention_dtype": "float32", **o},
    ),
}


def small_memory(name: str, **options: Any) -> RecurrentMemory:
    """A small memory with large random weights, the same at every call."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        memory = MEMORIES[name](**options).eval()
        for parameter in memory.parameters():
            torch.nn.init.normal_(parameter, std=0.5)
    return memory


class RandomHistory(History):
    """An endless episode of random tokens; counts the tokens that are asked for."""

    def __init__(self, length: int, exec_start: int = 0) -> None:
        super().__init__(StorageSpec(GRID), exec_start)
        self.length, self.gathered = length, 0

    def __len__(self) -> int:
        return self.length

    def gather(self, indices: np.ndarray) -> torch.Tensor:
        self.gathered += len(indices)
        rows = [np.random.default_rng([int(f), int(p)]).normal(size=D_VISION) for f, p in indices]
        return torch.from_numpy(np.stack(rows)).float()


def window(memory: RecurrentMemory, length: int, exec_start: int = 0) -> HistoryTokens:
    return stack_history([memory.gather_selection(RandomHistory(length, exec_start), length - 1)])


def same_memory(a, b) -> bool:
    return torch.equal(a.mask, b.mask) and torch.allclose(
        a.tokens[a.mask], b.tokens[b.mask], atol=TOLERANCE
    )
