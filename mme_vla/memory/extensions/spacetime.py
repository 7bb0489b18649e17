"""Spacetime: past images enter the vision tower itself, and past states are tokens (MEM, LeRobot's
option of π0.5).

After MEM's short-horizon memory (arXiv 2603.03596) as LeRobot's π0.5 has it (`use_visual_memory`,
`use_proprioceptive_memory`; huggingface/lerobot#4076, read and not copied): six frames a second
apart. In every fourth layer of the tower each patch attends to the same patch of the frames before
it, with the layer's own weights. Past frames are dropped above the last such layer. So the prefix
is no longer than before, and no weight is added. Each frame's state, normalised and padded with
zeros, becomes one token through one linear layer.

LeRobot takes the state out of the prompt where states are tokens. Here prompts hold none unless
their format has one. There the tokens are between images and words. Here the integration places
them, and `integration.mutual=true` of `context` puts them there. Frames of the conditioning video
are past frames as any other.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import UserError, check_sizes, require
from mme_vla.memory.base import NEVER, MemoryModule, PastViewSpec, union_frames
from mme_vla.memory.extensions.actions import MotionRows
from mme_vla.memory.history import History, StorageSpec
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens


@MEMORIES.register("spacetime")
class SpaceTime(MemoryModule):
    """Views of `frames` frames for the tower, and their states as so many tokens; `select` names
    the frames.

    It has no cache, which would have to store the features of every frame of every camera in each
    layer that attends over time, where others store one pooled grid of one camera. So images are
    read anew, in training too.
    """

    timed = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        frames: int = 6,
        stride: int = 10,
        every: int = 4,
        views: bool = True,
        states: bool = True,
        state_dim: int = 32,
        budget: int | None = None,
    ) -> None:
        """Configure the frames, and what is read of them.

        Args:
            d_vision: width of a vision token, to which a state is padded on its way.
            width: of a memory token.
            frames: how many, the current one among them.
            stride: frames between two.
            every: interval of the tower's layers that attend over time, at least the last one.
            views: give the tower past images.
            states: hand over past states as tokens.
            state_dim: numbers a state is padded to before its layer.
            budget: maximum number of memory tokens, at least `frames`; None for `frames`.
        """
        super().__init__()
        check_sizes("memory", frames=frames, stride=stride, every=every, state_dim=state_dim)
        require(
            views or states,
            "memory.views=false and memory.states=false leave nothing to remember: set one of"
            " them.",
        )
        is_enough = budget is None or not states or budget >= frames
        require(
            is_enough,
            f"memory.budget={budget}: the states of memory.frames={frames} are as many tokens.",
        )
        require(
            not states or state_dim <= d_vision,
            f"memory.state_dim={state_dim}: tokens {d_vision} wide carry the states.",
        )
        self.frames = frames
        self.stride = stride
        self.every = every
        self.width = width
        self.state_dim = state_dim
        self.d_vision = d_vision
        self.past_view_spec = PastViewSpec(frames, stride, every) if views else None
        self.uses_proprio = states
        self.budget = self.capacity = frames if states else 0
        self.storage = StorageSpec(1, "mean", NEVER)
        self.states = nn.Linear(state_dim, width) if states else None

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        if self.past_view_spec is None:
            return np.zeros(0, np.int64)
        read = union_frames([self.past_view_spec.at(int(step)) for step in steps])
        return read[read >= 0]

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        if not self.budget:  # views alone
            return np.zeros((0, 2), np.int64)
        frames: np.ndarray = step - self.stride * np.arange(self.frames - 1, -1, -1)
        frames = frames[frames >= 0]
        return np.stack([frames, np.zeros_like(frames)], 1)

    def gather_selection(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> HistoryTokens:
        def proprio(frames: np.ndarray) -> Tensor:
            """The robot's states of frames [n]; zeros where none are read."""
            if self.states is None:
                return torch.zeros(len(frames), self.d_vision)
            states = history.motion_rows(frames)[:, : history.state_width]
            if states.shape[1] > self.state_dim:
                raise UserError(
                    f"memory.state_dim={self.state_dim}: a state of this robot has"
                    f" {states.shape[1]} numbers."
                )
            return states

        rows = MotionRows(history, proprio, self.d_vision, "spacetime")
        return super().gather_selection(rows, step, rng)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        if self.states is None:
            tokens = history.features.new_zeros(*history.mask.shape, self.width)
            return MemoryTokens(tokens, history.mask, ages=history.ages)
        # An episode's states are on the CPU.
        weight = self.states.weight
        tokens = self.states(history.features[..., : self.state_dim].to(weight))
        ages = None if history.ages is None else history.ages.to(weight.device)
        return MemoryTokens(tokens, history.mask.to(weight.device), ages=ages)
