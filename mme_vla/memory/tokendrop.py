"""TokenDrop: the first frame whole, then the patches that changed most (paper, section 4.2)."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mme_vla.errors import UserError, check_sizes, require
from mme_vla.memory.base import PerceptualMemory
from mme_vla.memory.history import (
    FORMER_KEYS,
    FrameScorer,
    FrameScores,
    History,
    StorageSpec,
    on_interval,
)
from mme_vla.registry import MEMORIES

FIRST_FRAME_SCORE = np.inf  # above any score, so that the first frame always stays
THRESHOLD = 1e-4  # patches whose score is lower are never candidates


@dataclass
class ChangeScorer(FrameScorer):
    """Mean |ΔRGB| per patch, in units of [−1, 1], between every `stride`-th frame and the one
    scored before it. The memory `events` reads the same scores.

    Frames stride−1, 2·stride−1, … are scored; the first of them against frame 0, as released.
    """

    grid: int
    stride: int

    def __post_init__(self) -> None:
        self._reference: np.ndarray | None = None

    def frames_scored(self, length: int) -> np.ndarray:
        frames = np.arange(length)
        return frames[on_interval(frames, self.stride)]

    def __call__(self, frame_index: int, frame: np.ndarray) -> np.ndarray | None:
        """Score one frame [H, W, 3] uint8, or keep it as a reference."""
        # The first frame is refused already, scored or not: an episode has images of one size.
        height, width, _ = frame.shape
        if height % self.grid or width % self.grid:
            raise UserError(
                f"A {height}×{width} frame does not divide into {self.grid}×{self.grid} patches."
            )
        if not on_interval(frame_index, self.stride):
            return None
        image = frame.astype(np.float32) / 255 * 2 - 1
        reference = self._reference
        self._reference = image
        if reference is None or frame_index == 0:
            # A stride of 1 scores frame 0 too, against itself: no patch passes the threshold.
            return None
        change = np.abs(image - reference)
        cells = change.reshape(self.grid, height // self.grid, self.grid, width // self.grid, 3)
        return cells.mean(axis=(1, 3, 4), dtype=np.float32).reshape(-1)


# The digest of `ChangeScorer` as it stands, and the key of caches from before keys had digests.
# Another scorer has a key of its own, and its caches are built anew.
FORMER_KEYS["73ce2c9e"] = "change{grid}x{grid}-every{stride}"


@MEMORIES.register("tokendrop")
class TokenDrop(PerceptualMemory):
    """The `budget` highest-scored patches up to now, the first frame's among them, in
    time order.

    Scorer: scores the patches, made from (grid, stride). A subclass names another here, or ranks
        the same scores in a `select` of its own (docs/extend/add-a-memory.md).
    """

    Scorer: ClassVar[type[Any]] = ChangeScorer

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 512,
        grid: int = 8,
        pooling: str = "mean",
        stride: int = 8,
        candidates: int = 2048,
        causal: bool = True,
        **encoder: Any,
    ) -> None:
        """See `PerceptualMemory`.

        Args:
            grid: side of a frame's token grid.
            stride: frames between two scored ones.
            candidates: how many of the best patches compete for the budget. With `causal` it has no
                effect, except that it is at least the budget.
            causal: only frames up to the current one compete. False lets the whole episode compete,
                as the released offline preprocessing does; it needs a finished episode.
        """
        check_sizes("memory", stride=stride)
        require(
            grid**2 <= budget <= candidates,
            f"memory.budget={budget} must lie between {grid**2} (the first frame, always kept) and "
            f"memory.candidates={candidates} (the patches that compete).",
        )
        scorer = self.Scorer(grid, stride)
        storage = StorageSpec(grid, pooling, keep_every=stride, scorer=scorer.key)
        super().__init__(d_vision, width, budget, storage, **encoder)
        self.stride, self.candidates, self.causal = stride, candidates, causal

    def make_scorer(self) -> FrameScorer:
        scorer: FrameScorer = self.Scorer(self.storage.grid, self.stride)
        return scorer

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        patches = self.storage.grid**2
        if self.causal:
            # No candidate is later than `step`: the best `budget` are among any more of them.
            ranked = ranked_patches(history.scores.until(step), patches, self.budget)
        else:
            ranked = ranked_patches(history.scores, patches, self.candidates)
        return most_changed(ranked, step, self.budget)


def ranked_patches(scores: FrameScores, patches: int, limit: int) -> np.ndarray:
    """The best `limit` candidates as (frame, patch) [n, 2], best last: ascending by (score, frame,
    patch). The first frame's patches rank highest.
    """
    # The first frame's patches are added below, also where a scorer scores that frame.
    is_later = scores.frames > 0
    frames = scores.frames[is_later]
    values = scores.values[is_later]
    is_candidate = values >= THRESHOLD
    # Sort no more patches than can stay beside the first frame's, however long the episode is.
    # Where none can, the last line of this function leaves them all out.
    n_others = max(limit - patches, 0)
    if np.count_nonzero(is_candidate) > n_others > 0:
        nth = values.size - n_others
        is_candidate &= values >= np.partition(values.reshape(-1), nth)[nth]
    row, patch = np.nonzero(is_candidate)
    first_frame_scores = np.full(patches, FIRST_FRAME_SCORE, np.float32)
    frame = np.concatenate([np.zeros(patches, np.int64), frames[row]])
    patch = np.concatenate([np.arange(patches), patch])
    score = np.concatenate([first_frame_scores, values[is_candidate]])
    order = np.lexsort((patch, frame, score))[-limit:]
    return np.stack([frame[order], patch[order]], axis=1)


def most_changed(ranked: np.ndarray, step: int, budget: int) -> np.ndarray:
    """The last `budget` of the ranked patches that lie no later than `step`, in time order; the
    first frame's, which rank highest, are among them.
    """
    selected = ranked[ranked[:, 0] <= step][-budget:]
    return selected[np.lexsort((selected[:, 1], selected[:, 0]))]
