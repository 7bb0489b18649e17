"""Remembered frames through a frozen vision tower: what every policy with a memory of tokens does alike."""

import hashlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.memory.base import StreamingMemory

if TYPE_CHECKING:
    from mme_vla.memory.base import Memory
    from mme_vla.policy.episode import Episode

Pooled = Callable[[Tensor, int, str], Tensor]
"""Images as the tower takes them, the side of the grid and the pooling → tokens [n, grid², d_vision]."""


class VisionEncoder(Protocol):
    """What is asked of such a policy."""

    history_dtype: torch.dtype
    memory: "Memory | None"

    @property
    def device(self) -> torch.device: ...

    def autocast(self) -> AbstractContextManager[Any]: ...

    def require_memory(self) -> "Memory": ...

    def require_processor(self) -> Any: ...


@torch.no_grad()
def encode_frames(
    policy: VisionEncoder, frames: np.ndarray | Tensor, pooled: Pooled, d_vision: int, batch_size: int
) -> Tensor:
    """Memory-view frames [n, H, W, 3] uint8, in batches → tokens [n, grid², d_vision] as the memory stores them."""
    storage, device = policy.require_memory().storage, policy.device
    empty = torch.zeros(0, storage.grid**2, d_vision, dtype=policy.history_dtype, device=device)
    encoded = [empty]
    for start in range(0, len(frames), batch_size):
        images = policy.require_processor().memory_images(frames[start : start + batch_size], device=device)
        with policy.autocast():
            encoded.append(pooled(images, storage.grid, storage.pooling).to(empty))
    return torch.cat(encoded)


def prepare(policy: VisionEncoder, episode: "Episode") -> bool:
    """`Policy.prepare` where the memory reads the episode's own history."""
    if not isinstance(policy.memory, StreamingMemory) or not episode.n_observed_frames:
        return False
    with policy.autocast():
        return policy.memory.prepare(episode.required_history(), episode.stream)


def tower_fingerprint(tower: nn.Module, dtype: torch.dtype, *beside: str) -> str:
    """A hash of what a cache of tokens depends on.

    Args:
        tower: whose weights count. dtype: that it runs in.
        beside: what else its images go through; nothing where it says nothing.
    """
    digest = hashlib.sha256(str(dtype).encode())
    for name, tensor in sorted(tower.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().float().cpu().contiguous().numpy().tobytes())
    for words in filter(None, beside):
        digest.update(words.encode())
    return digest.hexdigest()
