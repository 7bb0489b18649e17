"""Moment: a few learned tokens ask every frame, and a small causal encoder puts their outputs in
context (HAMLET).

After "HAMLET: Switch your Vision-Language-Action Model into a History-Aware Policy" (arXiv
2510.00695): four moment tokens a time step, a memory module of two causal layers over the steps,
the four of the current step read by the action head. Three things are otherwise here, because a
memory stands before the language model and has no loss of its own: the tokens ask the frame's
stored vision tokens, not the language model; they begin at random, without the paper's
time-contrastive stage; and the outputs of the encoder for all steps are handed over, the current
ones last, so that an integration may look at a moment at its time. The paper looks back four steps;
this memory as far as its budget goes.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import FeatureEncoder
from mme_vla.memory.extensions.attending import (
    FrameMemory,
    ReadingBlock,
    by_frame,
    heads_of,
    not_later,
)
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import check_every, default_hidden, recurrent_frames
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens


@MEMORIES.register("moment")
class Moment(FrameMemory):
    """`moments` tokens of each of budget / moments frames, every token knowing the frames before
    its own.
    """

    pad_left = True
    timed = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 256,
        moments: int = 4,
        grid: int = 8,
        pooling: str = "mean",
        stride: int = 16,
        every: int = 1,
        *,
        layers: int = 2,
        hidden: int | None = None,
        heads: int | None = None,
        **encoder: Any,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            budget: most memory tokens; budget / moments frames are read.
            moments: learned tokens that ask every frame.
            grid, pooling: a frame that is read is grid×grid tokens.
            stride, every: frames between two that are read, and how they are counted
                (`recurrent_frames`; up to 5/8 of them from the video).
            layers, hidden, heads: of the causal encoder; its width is by default a quarter of
                `d_vision`, at least 64.
            encoder: `position_dim`, `position_hidden` and `positions` of the `FeatureEncoder`.
        """
        super().__init__()
        check_sizes("memory", moments=moments, stride=stride, layers=layers)
        check_every(every, stride)
        require(
            budget % moments == 0 < budget,
            f"memory.budget={budget} must be a multiple of memory.moments={moments}.",
        )
        hidden = default_hidden(d_vision, hidden)
        heads = heads_of(hidden, heads)
        self.budget, self.moments, self.steps = budget, moments, budget // moments
        self.stride, self.every = stride, every
        self.storage = StorageSpec(grid, pooling)
        self.capacity = self.steps * grid**2
        self.encoder = FeatureEncoder(d_vision, hidden, **encoder)
        self.questions = nn.Parameter(torch.randn(moments, hidden) * hidden**-0.5)
        self.ask = ReadingBlock(hidden, heads)
        self.layers = nn.ModuleList(ReadingBlock(hidden, heads) for _ in range(layers))
        self.norm, self.output = nn.LayerNorm(hidden), nn.Linear(hidden, width)

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        """The frames read at `step`, the last of them `step`."""
        return recurrent_frames(
            step, exec_start, self.steps, max(5 * self.steps // 8, 1), self.stride, self.every
        )

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        patches = self.storage.grid**2
        # b t p d
        x = by_frame(self.encoder(history.features, history.positions, history.mask), patches)
        valid = by_frame(history.mask, patches)[..., 0]  # b t
        rows, frames = valid.shape
        questions = self.questions.to(x.dtype).repeat(rows * frames, 1, 1)
        everything = torch.ones(
            rows * frames, self.moments, patches, dtype=torch.bool, device=x.device
        )
        tokens = (
            self.ask(questions, x.flatten(0, 1), everything)
            .unflatten(0, (rows, frames))
            .flatten(1, 2)
        )
        frame_mask = self._of_frames(valid)
        order = (
            torch.arange(frames, device=x.device)
            .repeat_interleave(self.moments)[None]
            .expand(rows, -1)
        )
        mask = not_later(order, order) & frame_mask[:, None, :]
        for layer in self.layers:
            tokens = layer(tokens, tokens, mask)
        ages = history.ages
        if ages is not None:
            ages = self._padded(self._of_frames(by_frame(ages, patches)[..., 0]))
        return MemoryTokens(
            self._padded(self.output(self.norm(tokens))), self._padded(frame_mask), ages=ages
        )

    def _of_frames(self, x: Tensor) -> Tensor:
        """What is known of frames [b, t], of their tokens [b, t·moments]."""
        return x.repeat_interleave(self.moments, 1)

    def _padded(self, x: Tensor) -> Tensor:
        """[b, n, …] with padding in front, as long as the budget."""
        return nn.functional.pad(x, (*[0, 0] * (x.ndim - 2), self.budget - x.shape[1], 0))
