"""A history that encodes a frame when its tokens are first read, for memories that read few of those they may."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from mme_vla.memory.history import FrameScorer, OnlineHistory, StorageSpec


class LazyHistory(OnlineHistory):
    """Frames wait as pictures in the CPU's memory; their tokens stay on the device that encoded them.

    A recurrent memory reads one frame in sixteen: the vision tower then runs sixteen times less. A picture of 256×256
    takes 192 KiB, less than its 8×8 tokens at full width would on the GPU.

    Args:
        encode: frames [n, H, W, 3] uint8 → tokens [n, patches, d_vision].
    """

    def __init__(
        self,
        spec: StorageSpec,
        encode: Callable[[np.ndarray], Tensor],
        scorer: FrameScorer | None = None,
        exec_start: int = 0,
    ) -> None:
        super().__init__(spec, scorer, exec_start)
        self._encode = encode
        self._waiting: dict[int, np.ndarray] = {}
        self._encoded: dict[int, Tensor] = {}

    def take(
        self,
        frames: np.ndarray,
        encode: Callable[[np.ndarray], Tensor],
        drawn: np.ndarray | None = None,
        count: int | None = None,
    ) -> None:
        """Add frames in order, without encoding any."""
        count = len(frames) if count is None else count
        wanted = self.wanted(count, drawn)
        places = wanted if drawn is None else np.searchsorted(drawn, wanted)
        # Copies: a view would keep the whole message alive that a frame came in.
        new = {int(frame): frames[at].copy() for frame, at in zip(wanted + self._length, places, strict=True)}
        self._score(frames, np.arange(count) if drawn is None else drawn)
        self._waiting |= new
        self._kept += new
        self._length += count

    def append(
        self,
        frames: Sequence[np.ndarray] | np.ndarray,
        tokens: Tensor,
        drawn: np.ndarray | None = None,
        count: int | None = None,
    ) -> None:
        """Add frames whose tokens are there already."""
        raise TypeError("A LazyHistory encodes its frames itself: give them to take().")

    def gather(self, indices: np.ndarray) -> Tensor:
        """Return tokens [n, d_vision] at `indices` [n, 2] of (frame, patch), encoding the frames that wait."""
        frames, rows = np.unique(indices[:, 0], return_inverse=True)
        self._row_of(frames, np.asarray(self._kept, np.int64))  # says which frames are missing
        new = [int(frame) for frame in frames if int(frame) in self._waiting]
        if new:
            tokens = self._encode(np.stack([self._waiting[frame] for frame in new]))
            for frame, row in zip(new, tokens, strict=True):
                self._encoded[frame] = row
                del self._waiting[frame]
        read = torch.stack([self._encoded[int(frame)] for frame in frames])
        places = (torch.as_tensor(part, device=read.device) for part in (rows, indices[:, 1]))
        return read[tuple(places)]
