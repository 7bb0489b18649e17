"""Banked: MemoryVLA's bank of perceptual tokens as a memory of any backbone: past moments written, asked, fused.

After "MemoryVLA" (arXiv 2508.19236), whose own network is `policy/memoryvla`. A moment is a frame's pooled vision
tokens, brought to the bank's width; past moments are written without gradients, and of a moment too many the two most
alike neighbours become one. The current frame's tokens ask the bank and are fused with its answer: these are the memory
tokens. Ours is what the bank is joined to: there an action head reads it, here an integration; the moments are those of
the recurrent memories, and a selection of stored tokens stands for what an episode would have written, so that training
sees the same bank as acting.
"""

import numpy as np
import torch
from torch import nn

from mme_vla.errors import UserError
from mme_vla.memory.attending import by_frame
from mme_vla.memory.bank import MemoryBank
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import default_hidden
from mme_vla.memory.sampling import recurrent_frames
from mme_vla.memory.whole import WholeFrames
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens


@MEMORIES.register("bank")
class Banked(WholeFrames):
    """grid×grid tokens of the current frame, each fused with what the bank answers to it."""

    pad_left = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 64,
        grid: int = 8,
        pooling: str = "mean",
        stride: int = 16,
        moments: int = 32,
        video: int = 16,
        hidden: int | None = None,
        length: int = 16,
        retrieval_layers: int = 2,
        time_code: bool = True,
        fusion: str = "gate",
        consolidation: str = "tome",
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            budget: most memory tokens; grid×grid of them are made.
            grid, pooling: a moment is grid×grid tokens.
            stride, moments, video: which frames are moments (`recurrent_frames`), the current one among them.
            hidden: width of the bank; by default a quarter of `d_vision`, at least 64.
            length, retrieval_layers, time_code, fusion, consolidation: as for `MemoryBank`.

        Raises:
            UserError: sizes that do not fit together, or an unknown choice.
        """
        super().__init__()
        for key, value in {"grid": grid, "stride": stride, "video": video}.items():
            if value < 1:
                raise UserError(f"memory.{key}={value} must be at least 1.")
        if moments < 2 or video >= moments:
            raise UserError(f"memory.moments={moments} must be at least 2, and more than memory.video={video}.")
        if budget < grid**2:
            raise UserError(f"memory.budget={budget} does not hold the {grid}×{grid} tokens of a frame: {grid**2}.")
        hidden = default_hidden(d_vision, hidden)
        self.budget, self.stride, self.moments, self.video = grid**2, stride, moments, video
        self.storage = StorageSpec(grid, pooling)
        self.capacity = moments * grid**2
        self.reduce, self.output = nn.Linear(d_vision, hidden), nn.Linear(hidden, width)
        self.bank = MemoryBank(hidden, length, retrieval_layers, time_code, fusion, consolidation)

    def chosen(self, step: int, exec_start: int) -> np.ndarray:
        """The moments at `step`, the last of them `step` itself."""
        return recurrent_frames(step, exec_start, self.moments, self.video, self.stride)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        patches = self.storage.grid**2
        features = by_frame(history.features, patches).to(self.reduce.weight.dtype)
        moments = self.reduce(features)  # b t p d
        times = by_frame(history.positions, patches)[:, :, 0, 0].round().long()
        valid = by_frame(history.mask, patches)[..., 0]
        held = self.bank.held(moments[:, :-1], times[:, :-1], valid[:, :-1])
        current = moments[:, -1]
        tokens = self.output(self.bank.fuse(current, self.bank.ask(current, *held)))
        return MemoryTokens(tokens, torch.ones(tokens.shape[:2], dtype=torch.bool, device=tokens.device))
