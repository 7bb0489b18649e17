"""Gist: the first frames and the last ones whole, and a few learned tokens of every frame between
(MemoryWAM).

After "Efficient World Action Modeling with Persistent Memory" (arXiv 2606.20562), whose code is not
public. From the paper come two whole anchor frames at the task's onset, four whole recent frames,
and eight gist tokens of every frame, which read their own frame and the gists of earlier ones.
Older frames are present through their gists alone. In the paper the gists are keys and values
inside a video model; here they are memory tokens. Our own choices are the number of layers, the
spacing of frames, and that an episode with more frames than the budget holds keeps evenly spaced
ones.
"""

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import FeatureEncoder, FrameMemory, take_options
from mme_vla.memory.extensions.attending import (
    ReaderOptions,
    ReadingBlock,
    by_frame,
    not_later,
    rows_at,
)
from mme_vla.memory.framesamp import evenly_spaced_frames
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import check_every, recurrent_frames
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens


class FramePlaces(NamedTuple):
    """Frames that fill the places of one part of the memory."""

    frames: Tensor  # [b, k], indices of a window's frames
    mask: Tensor  # [b, k] bool: whether there is such a frame


@MEMORIES.register("gist")
class Gist(FrameMemory):
    """[anchors, whole | gists of the frames between | recent frames, whole], in the
    order of time.
    """

    option_types: ClassVar[tuple[type, ...]] = (ReaderOptions, FeatureEncoder)
    pad_left = 1
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
        **options: Any,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token.
            width: of a memory token, given by the integration.
            budget: most memory tokens; what whole frames leave of it holds gists.
            anchors, recent: whole frames at the beginning and at the end.
            gists: tokens of each frame between.
            grid, pooling: a frame that is read is grid×grid tokens.
            stride, every: frames between two that are read, and how they are counted
                (`recurrent_frames`); the first is always read.
            options: `ReaderOptions` of the gists' encoder; `position_dim`, `position_hidden` and
                `positions` of both `FeatureEncoder`s.
        """
        super().__init__()
        check_sizes("memory", anchors=anchors, recent=recent, gists=gists, stride=stride)
        check_every(every, stride)
        full_tokens = (anchors + recent) * grid**2
        require(
            budget >= full_tokens + gists,
            f"memory.budget={budget} does not hold {anchors + recent} whole frames of {grid}×{grid}"
            f" tokens and the gists of one more: choose at least {full_tokens + gists}, or fewer"
            " memory.anchors or memory.recent.",
        )
        reader = take_options(ReaderOptions, options)
        hidden, heads = reader.sizes(d_vision)
        self.anchors = anchors
        self.recent = recent
        self.gists = gists
        self.stride = stride
        self.every = every
        self.between = (budget - full_tokens) // gists
        self.budget = full_tokens + self.between * gists
        self.storage = StorageSpec(grid, pooling)
        self.capacity = (anchors + self.between + recent) * grid**2
        self.encoder = FeatureEncoder(d_vision, width, **options)
        self.reader = FeatureEncoder(d_vision, hidden, **options)
        self.questions = nn.Parameter(torch.randn(gists, hidden) * hidden**-0.5)
        self.layers = nn.ModuleList(ReadingBlock(hidden, heads) for _ in range(reader.layers))
        self.norm = nn.LayerNorm(hidden)
        self.output = nn.Linear(hidden, width)

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        """The frames read at `step`, ascending, the first frame and `step` among them."""
        no_limit = step + 2
        candidates = recurrent_frames(step, exec_start, no_limit, no_limit, self.stride, self.every)
        frames = np.union1d([0], candidates)
        first = frames[: self.anchors]
        last = frames[self.anchors :][-self.recent :]
        between = frames[len(first) : len(frames) - len(last)]
        if len(between) > self.between:
            between = between[evenly_spaced_frames(len(between) - 1, self.between)]
        return np.concatenate([first, between, last])

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        patches = self.storage.grid**2
        valid = by_frame(history.mask, patches)[..., 0]  # b t
        anchors, between, recent = self._parts(valid)
        # Anchors and recent frames: all their tokens, encoded one by one.
        full_frames = torch.cat([anchors.frames, recent.frames], 1)  # b k
        features = rows_at(by_frame(history.features, patches), full_frames).flatten(1, 2)
        positions = rows_at(by_frame(history.positions, patches), full_frames).flatten(1, 2)
        full_mask = torch.cat([anchors.mask, recent.mask], 1).repeat_interleave(patches, 1)
        encoded = self.encoder(features, positions, full_mask)
        # Frames between: their gists.
        gists = self.output(self.norm(self._gists(history, valid)))
        gists = rows_at(gists.unflatten(1, (-1, self.gists)), between.frames).flatten(1, 2)
        gist_mask = between.mask.repeat_interleave(self.gists, 1)
        # In the order of time.
        n_anchors = self.anchors * patches
        tokens = torch.cat(
            [encoded[:, :n_anchors], gists.to(encoded.dtype), encoded[:, n_anchors:]], 1
        )
        mask = torch.cat([full_mask[:, :n_anchors], gist_mask, full_mask[:, n_anchors:]], 1)
        ages = None
        if history.ages is not None:
            frame_ages = by_frame(history.ages, patches)[..., 0]  # b t
            part_ages = []
            for part, count in ((anchors, patches), (between, self.gists), (recent, patches)):
                part_ages.append(rows_at(frame_ages, part.frames).repeat_interleave(count, 1))
            ages = torch.cat(part_ages, 1)
        return MemoryTokens(tokens, mask, ages=ages)

    def _parts(self, valid: Tensor) -> tuple[FramePlaces, FramePlaces, FramePlaces]:
        """Which frames of [b, t], padded in front, are anchors, give gists, and are recent."""
        n_frames = valid.shape[1]
        first = n_frames - valid.sum(1, keepdim=True)
        after_anchors = first + self.anchors
        first_recent = after_anchors.clamp(min=n_frames - self.recent)

        def places(start: Tensor, stop: Tensor, count: int) -> FramePlaces:
            frames = start + torch.arange(count, device=valid.device)
            return FramePlaces(frames.clamp(max=n_frames - 1), frames < stop)

        return (
            places(first, after_anchors.clamp(max=n_frames), self.anchors),
            places(after_anchors, first_recent, self.between),
            places(first_recent, torch.full_like(first, n_frames), self.recent),
        )

    def _gists(self, history: HistoryTokens, valid: Tensor) -> Tensor:
        """Gists [b, t·gists, hidden] of all frames: each reads its own frame and the gists up to
        its own.
        """
        rows, frames = valid.shape
        x = self.reader(history.features, history.positions, history.mask)
        gists = self.questions.to(x.dtype).repeat(frames, 1).expand(rows, -1, -1)
        # The frame of each gist and of each token.
        order = torch.arange(frames, device=x.device)
        gist_frames = order.repeat_interleave(self.gists)[None]
        token_frames = order.repeat_interleave(self.storage.grid**2)[None]
        same_frame = gist_frames[:, :, None] == token_frames[:, None, :]
        reads_tokens = same_frame & history.mask[:, None, :]
        gist_mask = valid.repeat_interleave(self.gists, 1)
        reads_gists = not_later(gist_frames, gist_frames) & gist_mask[:, None, :]
        mask = torch.cat([reads_tokens, reads_gists], 2)
        for layer in self.layers:
            gists = layer(gists, torch.cat([x, gists], 1), mask)
        return gists
