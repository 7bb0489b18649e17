"""Actions: an LSTM over proprioception and actions; no image is read (CAMP).

After "Remember what you did?" (CAMP, arXiv 2606.21188), whose code is not public: a recurrent
memory of the robot's own actions is a strong history where scenes look alike. The paper trains it
first to reconstruct the past actions (their low frequencies, quantised) and then conditions a
diffusion policy on its code. This memory learns from the action loss alone. Our own choices are
the LSTM of two layers, that it reads states beside actions and those of the conditioning video too,
every `stride` frames, and that it returns `budget` tokens.

A frame's row is [state | action that led to it, relative to that state | 1], both normalised as the
policy's are. Where no action of the robot led to it (the video, the first frame) the last two are
0. On a robot whose action is a motion of many frames they are 0 everywhere: the states show where
it went.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import UserError, check_sizes
from mme_vla.memory.base import NEVER
from mme_vla.memory.history import DerivedHistory, History, StorageSpec
from mme_vla.memory.recurrent import (
    RecurrentLayer,
    RecurrentMemory,
    State,
    Statistics,
    default_hidden,
    full_precision,
    layer_norm,
    linear,
)
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens


class MotionRows(DerivedHistory):
    """A history whose tokens are rows of numbers, padded with zeros to the width of a token.

    Args:
        source: the episode's history.
        read: frames [n] → rows [n, w] float32.
        width: of a token.
        memory: its name, for the error where a row is too long.
        device: to which rows are moved; None leaves them where they are.
    """

    def __init__(
        self,
        source: History,
        read: Callable[[np.ndarray], Tensor],
        width: int,
        memory: str,
        device: torch.device | None = None,
    ) -> None:
        super().__init__(source)
        self._read = read
        self._width = width
        self._memory = memory
        self._device = device

    def gather(self, indices: np.ndarray) -> Tensor:
        rows = self._read(indices[:, 0])
        if rows.shape[1] > self._width:
            raise UserError(
                f"The memory `{self._memory}` reads {rows.shape[1]} numbers a frame of this robot,"
                " and what carries them, most often this backbone's vision tokens, is"
                f" {self._width} wide."
            )
        return nn.functional.pad(rows, (0, self._width - rows.shape[1])).to(self._device)


class LSTMLayer(RecurrentLayer):
    """An LSTM of several layers. State: hidden and cell states, each [b, layers, hidden], 0 at
    first.

    Fresh cells forget at different rates, from half of their value a frame to one part in `longest`
    of it, evenly in the logarithm (after Tallec and Ollivier, arXiv 1804.11188). With the default
    bias of 1 nothing of a video would be left after a hundred frames, and no loss could teach what
    to keep.
    """

    def __init__(self, hidden: int, layers: int, budget: int, longest: int) -> None:
        super().__init__()
        self.hidden = hidden
        self.budget = budget
        # A fresh encoder's outputs are small: without a norm the gates would hardly move.
        self.norm = nn.LayerNorm(hidden)
        inputs = [nn.Linear(hidden, 4 * hidden) for _ in range(layers)]
        self.inputs = nn.ModuleList(inputs)
        self.recurrent = nn.ModuleList(
            nn.Linear(hidden, 4 * hidden, bias=False) for _ in range(layers)
        )
        self.tokens = nn.Linear(hidden, budget * hidden)
        # What is the same for every history must not be most of a token: norms above leave its
        # direction alone.
        nn.init.zeros_(self.tokens.bias)
        keep_biases = torch.linspace(0, math.log(max(longest - 1, 2)), hidden)
        with torch.no_grad():
            for gates in inputs:
                gates.bias[hidden : 2 * hidden] = keep_biases

    def initial(self, batch: int) -> State:
        zeros = self.tokens.weight.new_zeros(
            batch, len(self.inputs), self.hidden, dtype=torch.float32
        )
        return zeros, zeros

    def advance(
        self, state: State, x: Tensor, valid: Tensor, following: int = 0, statistics: bool = False
    ) -> tuple[State, Statistics]:
        with full_precision(x):
            hidden, cells = state
            layer_input = layer_norm(self.norm, x.float()[:, :, 0])  # b t d
            new_hidden, new_cells = [], []
            for i, (inputs, recurrent) in enumerate(zip(self.inputs, self.recurrent, strict=True)):
                h, c = hidden[:, i], cells[:, i]
                entering = linear(inputs, layer_input)  # type: ignore[arg-type]
                outputs = []
                for t in range(layer_input.shape[1]):
                    gates = entering[:, t] + linear(recurrent, h)  # type: ignore[arg-type]
                    let_in, keep, new, out = gates.chunk(4, -1)
                    cell = keep.sigmoid() * c + let_in.sigmoid() * new.tanh()
                    real = valid[:, t, None]
                    c = torch.where(real, cell, c)
                    h = torch.where(real, out.sigmoid() * cell.tanh(), h)
                    outputs.append(h)
                layer_input = torch.stack(outputs, 1)
                new_hidden.append(h)
                new_cells.append(c)
            return (torch.stack(new_hidden, 1), torch.stack(new_cells, 1)), {}

    def read(self, state: State) -> tuple[Tensor, Tensor]:
        tokens = linear(self.tokens, state[0][:, -1]).unflatten(-1, (self.budget, self.hidden))
        return tokens, torch.ones(tokens.shape[:2], dtype=torch.bool, device=tokens.device)


@MEMORIES.register("actions")
class ActionMemory(RecurrentMemory):
    """`budget` tokens of an LSTM over the robot's states and actions."""

    uses_proprio = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 8,
        hidden: int | None = None,
        layers: int = 2,
        max_steps: int = 256,
        max_video: int = 128,
        stride: int = 4,
        **options: Any,
    ) -> None:
        """See `RecurrentMemory`, whose frames these are; there are no images, so no grid and no
        pooling.

        Args:
            budget: memory tokens.
            hidden: width of the LSTM; None is a quarter of `d_vision`, at least 64.
            layers: of the LSTM.
            max_steps, max_video, stride: which frames it reads.
        """
        check_sizes("memory", budget=budget, layers=layers)
        hidden = default_hidden(d_vision, hidden)
        layer = LSTMLayer(hidden, layers, budget, max_steps)
        options |= {"grid": 1, "max_steps": max_steps, "max_video": max_video, "stride": stride}
        super().__init__(d_vision, width, layer, hidden, budget, **options)
        self.storage = StorageSpec(1, "mean", NEVER)
        self.d_vision = d_vision

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return np.zeros(0, np.int64)

    def gather_selection(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> HistoryTokens:
        return super().gather_selection(self._motion_rows(history), step, rng)

    def encode(self, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
        device = self.output.weight.device
        rows = [self._motion_rows(history, device) for history in histories]
        return super().encode(rows, streams)

    def prepare(self, history: History, stream: Any) -> bool:
        return super().prepare(self._motion_rows(history, self.output.weight.device), stream)

    def _motion_rows(self, history: History, device: torch.device | None = None) -> MotionRows:
        return MotionRows(history, history.motion_rows, self.d_vision, "actions", device)
