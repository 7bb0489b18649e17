"""Retrieval: the stretches of the past that look most like the current view, found before any frame
is sampled.

After the retrieval step of SoumilRathi/robomme-interference (at 48d62faa, read and not copied): a
history is cut where the cosine between neighbouring frames falls below a threshold, the score of a
chunk is its highest cosine with the current frame, and the best chunk's span is passed to the
policy's own sampler. There frames were embedded by SigLIP anew. Here a frame is the mean of its
stored tokens, so their threshold of 0.923 does not carry over.

Choices of ours: a chunk ends with the conditioning video and has at most `longest` frames. The
chunk of the current frame always looks like it, so it is not scored but fills what is left over. As
many chunks are taken, in the order of likeness, as the budget holds, and of the chunk that does not
fit whole, evenly spaced frames.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import PerceptualMemory, all_patches
from mme_vla.memory.framesamp import evenly_spaced_frames
from mme_vla.memory.history import History, StorageSpec
from mme_vla.memory.sizes import LEAST_FRAMES, budget_frames
from mme_vla.registry import MEMORIES


@MEMORIES.register("retrieval")
class Retrieval(PerceptualMemory):
    """budget / grid² frames: of the chunks most like the newest stored frame, and that frame
    itself.
    """

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 512,
        grid: int = 4,
        pooling: str = "mean",
        every: int = 4,
        cut: float = 0.95,
        longest: int = 8,
        **encoder: Any,
    ) -> None:
        """See `PerceptualMemory`.

        Args:
            grid, pooling: a remembered frame is grid×grid tokens.
            every: frames 0 and k·every − 1 are stored, compared and remembered; 1: all. The newest
                of them is the query.
            cut: a new chunk begins where two neighbouring stored frames have a cosine below it. −1
                never cuts.
            longest: most stored frames of a chunk.
        """
        frames = budget_frames(budget, grid, LEAST_FRAMES["retrieval"])
        require(
            -1 <= cut <= 1,
            f"memory.cut={cut} is a cosine: it lies between -1 (never cut) and 1 (cut everywhere).",
        )
        check_sizes("memory", longest=longest)
        super().__init__(d_vision, width, budget, StorageSpec(grid, pooling, every), **encoder)
        self.frames = frames
        self.cut = cut
        self.longest = longest

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        frames = self.storage.stored_frames(step + 1)
        if len(frames) > self.frames:
            # A frame's feature is the mean of its tokens as they are stored, of length 1.
            tokens = history.stored(all_patches(frames, self.storage.grid)).float()
            means = tokens.unflatten(0, (len(frames), -1)).mean(1)
            features = torch.nn.functional.normalize(means, dim=-1)
            frames = frames[self.alike(features, frames >= history.exec_start)]
        return all_patches(frames, self.storage.grid)

    def alike(self, features: Tensor, execution: np.ndarray) -> np.ndarray:
        """Which frames are remembered.

        Args:
            features: of the stored frames, [n, d], of length 1.
            execution: bool [n], False in the video.

        Returns:
            int64 [`frames`], ascending, the newest last.
        """
        neighbours = (features[1:] * features[:-1]).sum(1).cpu().numpy()
        likeness = (features @ features[-1]).cpu().numpy()
        chunks = chunks_of(neighbours < self.cut, execution, self.longest)
        ranked = sorted(chunks[:-1], key=lambda chunk: -likeness[chunk].max())
        # The current frame first, and the other frames of its chunk last.
        taken = [np.array([len(features) - 1])]
        remaining = self.frames - 1
        for chunk in [*ranked, chunks[-1][:-1]]:
            if not remaining or not len(chunk):
                continue
            if len(chunk) > remaining:
                chunk = chunk[evenly_spaced_frames(len(chunk) - 1, remaining)]
            taken.append(chunk)
            remaining -= len(chunk)
        return np.sort(np.concatenate(taken))


def chunks_of(cuts: np.ndarray, execution: np.ndarray, longest: int) -> list[np.ndarray]:
    """Split n frames where `cuts` [n − 1] is True, where the video ends, and into pieces of at most
    `longest`.
    """
    ends = cuts | (np.diff(execution.astype(int)) != 0)
    chunks = []
    for run in np.split(np.arange(len(execution)), np.flatnonzero(ends) + 1):
        for start in range(0, len(run), longest):
            chunks.append(run[start : start + longest])
    return chunks
