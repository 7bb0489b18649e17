"""Gist: the first frames and the last ones whole, and a few learned tokens of every frame between
(MemoryWAM).

After "Efficient World Action Modeling with Persistent Memory" (arXiv 2606.20562), whose code is not
public; what is taken from the paper: two whole anchor frames at the task's onset, four whole recent
frames, eight gist tokens of every frame, which read their own frame and the gists of earlier ones,
and older frames that are seen through their gists alone. There the gists are keys and values inside
a video model; here they are memory tokens. Ours are the number of layers, the spacing of frames,
and that an episode with more frames than the budget holds keeps evenly spaced ones.
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
    rows_at,
)
from mme_vla.memory.framesamp import evenly_spaced_frames
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import check_every, default_hidden, recurrent_frames
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens


@MEMORIES.register("gist")
class Gist(FrameMemory):
    """[anchors, whole | gists of the frames between | recent frames, whole], in the
    order of time.
    """

    pad_left = True
    timed = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 512,
        *,
        anchors: int = 2,
        recent: int = 4,
        gists: int = 8,
        grid: int = 4,
        pooling: str = "mean",
        stride: int = 16,
        every: int = 1,
        layers: int = 2,
        hidden: int | None = None,
        heads: int | None = None,
        **encoder: Any,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            budget: most memory tokens; what whole frames leave of it holds gists.
            anchors, recent: whole frames at the beginning and at the end. gists: tokens of each
                frame between.
            grid, pooling: a frame that is read is grid×grid tokens.
            stride, every: frames between two that are read, and how they are counted
                (`recurrent_frames`); the first is always read.
            layers, hidden, heads: of the gists' encoder; its width is by default a quarter of
                `d_vision`, at least 64.
            encoder: `position_dim`, `position_hidden` and `positions` of both `FeatureEncoder`s.
        """
        super().__init__()
        check_sizes(
            "memory", anchors=anchors, recent=recent, gists=gists, stride=stride, layers=layers
        )
        check_every(every, stride)
        full_tokens = (anchors + recent) * grid**2
        require(
            budget >= full_tokens + gists,
            f"memory.budget={budget} does not hold {anchors + recent} whole frames of {grid}×{grid}"
            f" tokens and the gists of one more: choose at least {full_tokens + gists}, or fewer"
            " memory.anchors or memory.recent.",
        )
        hidden = default_hidden(d_vision, hidden)
        heads = heads_of(hidden, heads)
        self.anchors, self.recent, self.gists, self.stride, self.every = (
            anchors,
            recent,
            gists,
            stride,
            every,
        )
        self.between = (budget - full_tokens) // gists
        self.budget = full_tokens + self.between * gists
        self.storage = StorageSpec(grid, pooling)
        self.capacity = (anchors + self.between + recent) * grid**2
        self.encoder = FeatureEncoder(d_vision, width, **encoder)
        self.reader = FeatureEncoder(d_vision, hidden, **encoder)
        self.questions = nn.Parameter(torch.randn(gists, hidden) * hidden**-0.5)
        self.layers = nn.ModuleList(ReadingBlock(hidden, heads) for _ in range(layers))
        self.norm, self.output = nn.LayerNorm(hidden), nn.Linear(hidden, width)

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        """The frames read at `step`, ascending, the first frame and `step` among them."""
        everything = recurrent_frames(step, exec_start, step + 2, step + 2, self.stride, self.every)
        frames = np.union1d([0], everything)
        first, last = frames[: self.anchors], frames[self.anchors :][-self.recent :]
        between = frames[len(first) : len(frames) - len(last)]
        if len(between) > self.between:
            between = between[evenly_spaced_frames(len(between) - 1, self.between)]
        return np.concatenate([first, between, last])

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        patches = self.storage.grid**2
        places = by_frame(
            torch.arange(history.mask.shape[1], device=history.mask.device)[None], patches
        )[0]  # t p
        valid = by_frame(history.mask, patches)[..., 0]  # b t
        first, between, last = self._parts(valid)
        gists = self.output(self.norm(self._gists(history, valid)))
        full = rows_at(
            by_frame(history.features, patches), torch.cat([first[0], last[0]], 1)
        ).flatten(1, 2)
        where = rows_at(
            by_frame(history.positions, patches), torch.cat([first[0], last[0]], 1)
        ).flatten(1, 2)
        there = torch.cat([first[1], last[1]], 1).repeat_interleave(patches, 1)
        encoded = self.encoder(full, where, there)
        split = [self.anchors * patches, self.recent * patches]
        (anchors, recent), (anchor_mask, recent_mask) = (
            encoded.split(split, 1),
            there.split(split, 1),
        )
        summaries = rows_at(gists.unflatten(1, (-1, self.gists)), between[0]).flatten(1, 2)
        summary_mask = between[1].repeat_interleave(self.gists, 1)
        ages = None
        if history.ages is not None:
            of_frame = history.ages[:, places[:, 0]]
            counts = zip((first, between, last), (patches, self.gists, patches), strict=True)
            ages = torch.cat(
                [rows_at(of_frame, at).repeat_interleave(n, 1) for (at, _), n in counts], 1
            )
        tokens = torch.cat([anchors, summaries.to(anchors.dtype), recent], 1)
        return MemoryTokens(
            tokens, torch.cat([anchor_mask, summary_mask, recent_mask], 1), ages=ages
        )

    def _parts(self, valid: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Which frames of [b, t], padded in front, fill the places of anchors, gists and recent
        frames.

        Returns:
            For each of the three (frames [b, k], whether there is such a frame [b, k]).
        """
        frames, begin = valid.shape[1], valid.shape[1] - valid.sum(1, keepdim=True)
        end = (begin + self.anchors).clamp(min=frames - self.recent)  # where the recent ones begin
        counts = (self.anchors, self.between, self.recent)
        starts = (begin, begin + self.anchors, end)
        stops = ((begin + self.anchors).clamp(max=frames), end, torch.full_like(begin, frames))
        parts = []
        for start, stop, count in zip(starts, stops, counts, strict=True):
            at = start + torch.arange(count, device=valid.device)
            parts.append((at.clamp(max=frames - 1), at < stop))
        return parts

    def _gists(self, history: HistoryTokens, valid: Tensor) -> Tensor:
        """Gists [b, t·gists, hidden] of all frames: each reads its own frame and the gists up to
        its own.
        """
        rows, frames = valid.shape
        x = self.reader(history.features, history.positions, history.mask)
        gists = self.questions.to(x.dtype).repeat(frames, 1).expand(rows, -1, -1)
        of_gist = torch.arange(frames, device=x.device).repeat_interleave(self.gists)[None]
        of_token = torch.arange(frames, device=x.device).repeat_interleave(self.storage.grid**2)[
            None
        ]
        attends = (of_gist[:, :, None] == of_token[:, None, :]) & history.mask[:, None, :]
        earlier = not_later(of_gist, of_gist) & valid.repeat_interleave(self.gists, 1)[:, None, :]
        mask = torch.cat([attends, earlier], 2)
        for layer in self.layers:
            gists = layer(gists, torch.cat([x, gists], 1), mask)
        return gists
