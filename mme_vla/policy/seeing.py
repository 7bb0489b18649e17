"""Remembered frames through a frozen vision tower: what every policy with a memory of tokens does alike."""

import hashlib
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

Pooled = Callable[[np.ndarray | Tensor], Tensor]
"""Some frames [n, H, W, 3] uint8 → their pooled tokens [n, grid², d_vision]."""


@torch.no_grad()
def encode_frames(frames: np.ndarray | Tensor, pooled: Pooled, empty: Tensor, batch_size: int) -> Tensor:
    """Frames [n, H, W, 3] uint8 in batches; `empty` [0, grid², d_vision] says dtype and device of the result."""
    encoded = [pooled(frames[start : start + batch_size]).to(empty) for start in range(0, len(frames), batch_size)]
    return torch.cat(encoded) if encoded else empty


def tower_fingerprint(tower: nn.Module, dtype: torch.dtype) -> str:
    """A hash of a tower's weights and the dtype it runs in: what a cache of its tokens depends on."""
    digest = hashlib.sha256(str(dtype).encode())
    for name, tensor in sorted(tower.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
