"""A history whose tokens are rows of what the robot felt and did, for memories that read these instead of pictures."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import UserError
from mme_vla.memory.history import History

NEVER = 1_000_000
"""Frames between two whose pictures are kept: the first alone."""


class OwnRows(History):
    """A history as such a memory sees it: its tokens are rows, padded with zeros to the width of a token.

    Args:
        whole: what is there. read: frames [n] → rows [n, w] float32. width: of a token.
        memory: its name, for what is said where a row is too long. device: where rows are wanted; None leaves them.
    """

    def __init__(
        self,
        whole: History,
        read: Callable[[np.ndarray], Tensor],
        width: int,
        memory: str,
        device: torch.device | None = None,
    ) -> None:
        super().__init__(whole.spec, whole.exec_start)
        self._whole, self._read, self._width, self._memory, self._device = whole, read, width, memory, device

    def __len__(self) -> int:
        return len(self._whole)

    def gather(self, indices: np.ndarray) -> Tensor:
        rows = self._read(indices[:, 0])
        if rows.shape[1] > self._width:
            raise UserError(
                f"The memory `{self._memory}` reads {rows.shape[1]} numbers a frame of this robot, and what carries "
                f"them, most often this backbone's vision tokens, is {self._width} wide."
            )
        return nn.functional.pad(rows, (0, self._width - rows.shape[1])).to(self._device)
