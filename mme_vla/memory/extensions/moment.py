"""Moment: a few learned queries read every frame, and a small causal encoder puts their outputs in
context (HAMLET).

After "HAMLET: Switch your Vision-Language-Action Model into a History-Aware Policy" (arXiv
2510.00695): four moment tokens a time step, a memory module of two causal layers over the steps,
the four of the current step read by the action head. Three things differ here, because a memory is
computed before the language model and has no loss of its own. The queries read the frame's stored
vision tokens, not the language model. They begin at random, without the paper's time-contrastive
stage. And the outputs of the encoder for all steps are returned, the current ones last, so that an
integration may read a moment at its time. The paper uses the last four steps, this memory as many
as its budget holds.
"""

from typing import Any, ClassVar

import torch
from torch import nn

from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import FeatureEncoder, take_options
from mme_vla.memory.extensions.attending import (
    ReaderOptions,
    ReadingBlock,
    by_frame,
    not_later,
)
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import FrameSchedule, ScheduledMemory
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens


@MEMORIES.register("moment")
class Moment(ScheduledMemory):
    """`moments` tokens of each of budget / moments frames, every token knowing the frames before
    its own.
    """

    option_types: ClassVar[tuple[type, ...]] = (ReaderOptions, FeatureEncoder)
    pad_left = 1
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
        **options: Any,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token.
            width: of a memory token, given by the integration.
            budget: most memory tokens; budget / moments frames are read.
            moments: learned queries that read every frame.
            grid, pooling: a frame that is read is grid×grid tokens.
            stride, every: frames between two that are read, and how they are counted
                (`recurrent_frames`; up to 5/8 of them from the video).
            options: `ReaderOptions` of the causal encoder; `position_dim`, `position_hidden` and
                `positions` of the `FeatureEncoder`.
        """
        super().__init__()
        check_sizes("memory", moments=moments)
        require(
            budget % moments == 0 < budget,
            f"memory.budget={budget} must be a multiple of memory.moments={moments}.",
        )
        causal = take_options(ReaderOptions, options)
        hidden, heads = causal.sizes(d_vision)
        self.budget = budget
        self.moments = moments
        steps = budget // moments
        self.schedule = FrameSchedule(steps, max(5 * steps // 8, 1), stride, every)
        self.storage = StorageSpec(grid, pooling)
        self.capacity = steps * grid**2
        self.encoder = FeatureEncoder(d_vision, hidden, **options)
        self.questions = nn.Parameter(torch.randn(moments, hidden) * hidden**-0.5)
        self.ask = ReadingBlock(hidden, heads)
        self.layers = nn.ModuleList(ReadingBlock(hidden, heads) for _ in range(causal.layers))
        self.norm = nn.LayerNorm(hidden)
        self.output = nn.Linear(hidden, width)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        patches = self.storage.grid**2
        x = self.encoder(history.features, history.positions, history.mask)
        x = by_frame(x, patches)  # b t p d
        valid = by_frame(history.mask, patches)[..., 0]  # b t
        rows, frames = valid.shape
        # The queries read each frame by itself.
        queries = self.questions.to(x.dtype).repeat(rows * frames, 1, 1)
        reads_all = torch.ones(
            rows * frames, self.moments, patches, dtype=torch.bool, device=x.device
        )
        moments = self.ask(queries, x.flatten(0, 1), reads_all)
        tokens = moments.unflatten(0, (rows, frames)).flatten(1, 2)  # b t·m d
        # Each token reads those of its frame and of earlier ones.
        token_mask = valid.repeat_interleave(self.moments, 1)
        order = torch.arange(frames, device=x.device).repeat_interleave(self.moments)
        order = order[None].expand(rows, -1)
        mask = not_later(order, order) & token_mask[:, None, :]
        for layer in self.layers:
            tokens = layer(tokens, tokens, mask)
        tokens = self.output(self.norm(tokens))
        # Padding in front, up to the budget.
        missing = self.budget - tokens.shape[1]
        ages = None
        if history.ages is not None:
            frame_ages = by_frame(history.ages, patches)[..., 0]
            ages = frame_ages.repeat_interleave(self.moments, 1)
            ages = nn.functional.pad(ages, (missing, 0))
        return MemoryTokens(
            tokens=nn.functional.pad(tokens, (0, 0, missing, 0)),
            mask=nn.functional.pad(token_mask, (missing, 0)),
            ages=ages,
        )
