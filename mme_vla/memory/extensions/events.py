"""Events: keyframes by rule, where the gripper acts, the arm comes to rest, or the image changes
(KEMO, EventVLA).

After "KEMO" (arXiv 2606.23589), whose code is not public: keyframes where a kinematic event takes
place, filtered by what is seen. The rules here are ours, and none has a threshold on how fast a
robot is or how much an image changes:

- the gripper opens or closes by at least `gripper` of its normalised range between two stored
  frames
- the speed of the arm has a minimum: it is lower than before, and not higher than after
- the image's change, as TokenDrop scores it, has a maximum: it is higher than before, and not lower
  than after

An event counts one for each of the first two, and for the last the change as a share of the
greatest so far. The greatest are kept, with the first frame and the newest. A minimum and a maximum
are known one stored frame later.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from mme_vla.errors import check_sizes, require
from mme_vla.memory.base import PerceptualMemory, all_patches
from mme_vla.memory.history import History, StorageSpec
from mme_vla.memory.sizes import LEAST_FRAMES, budget_frames
from mme_vla.memory.tokendrop import ChangeScorer
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens


@MEMORIES.register("events")
class Events(PerceptualMemory):
    """The first frame, the newest stored one, and at most `budget / grid² − 2` frames of events."""

    uses_proprio = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 512,
        *,
        grid: int = 4,
        pooling: str = "mean",
        stride: int = 8,
        gripper: float = 0.5,
        gripper_state: int = -1,
        **encoder: Any,
    ) -> None:
        """See `PerceptualMemory`.

        Args:
            grid, pooling: a frame is grid×grid tokens.
            stride: frames 0 and k·stride − 1 are stored and compared.
            gripper: least change of the gripper that is an event; its normalised range is 2.
            gripper_state: which number of the robot's state is its gripper. The others are the
                arm's.
        """
        check_sizes("memory", stride=stride)
        require(gripper > 0, f"memory.gripper={gripper}: must be greater than 0.")
        frames = budget_frames(budget, grid, LEAST_FRAMES["events"])
        storage = StorageSpec(grid, pooling, stride, ChangeScorer(grid, stride).key)
        super().__init__(d_vision, width, budget, storage, **encoder)
        self.frames = frames
        self.gripper = gripper
        self.gripper_state = gripper_state

    def make_scorer(self) -> ChangeScorer:
        return ChangeScorer(self.storage.grid, self.storage.keep_every)

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        frames = self.storage.stored_frames(step + 1)
        if len(frames) > self.frames:
            frames = frames[self.top_frames(history, frames)]
        return all_patches(frames, self.storage.grid)

    def top_frames(self, history: History, frames: np.ndarray) -> np.ndarray:
        """Which of the stored frames [n] up to now are kept: ascending indices, no
        more than fit.
        """
        states = history.proprio(frames).numpy().astype(np.float64)
        count = states.shape[1]
        require(
            -count <= self.gripper_state < count,
            f"memory.gripper_state={self.gripper_state}: the robot's state has {count} numbers."
            " Name the gripper's, from 0.",
        )
        # The gripper opens or closes.
        gripper = states[:, self.gripper_state]
        moves_gripper = np.abs(np.diff(gripper, prepend=gripper[:1])) >= self.gripper
        # The arm comes to rest.
        arm = np.delete(states, self.gripper_state, 1)
        speed = np.linalg.norm(np.diff(arm, axis=0, prepend=arm[:1]), axis=1)
        # The image changes, as a share of the greatest change.
        scores = history.scores.until(int(frames[-1]))
        change = np.zeros(len(frames))
        change[np.searchsorted(frames, scores.frames)] = scores.values.mean(1, dtype=np.float64)
        change[0] = change[min(1, len(change) - 1)]  # no frame comes before the first
        greatest = max(change.max(), np.finfo(float).tiny)
        novelty = np.where(peaks(change), change / greatest, 0)
        value = moves_gripper + peaks(-speed) + novelty
        value[[0, -1]] = np.inf
        best = np.argsort(-value, kind="stable")[: self.frames]
        return np.sort(best[value[best] > 0])

    def condition_on_prompt(
        self, history: HistoryTokens, with_prompt: Callable[[Tensor], Tensor]
    ) -> HistoryTokens:
        # States choose the frames; the features are vision tokens.
        return replace(history, features=with_prompt(history.features))


def peaks(values: np.ndarray) -> np.ndarray:
    """Where values [n] are higher than the one before and not lower than the one after; bool [n],
    False at the ends.
    """
    inside = (values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])
    return np.pad(inside, 1)
