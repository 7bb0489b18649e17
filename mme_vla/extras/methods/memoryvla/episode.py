"""An episode of MemoryVLA: what its banks hold, and which moments of the conditioning video enter
them.
"""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.extras.methods.memoryvla.bank import BankState
from mme_vla.extras.methods.memoryvla.model import BankStates
from mme_vla.extras.methods.writable_memory import MemoryEntries
from mme_vla.policy.episode import Episode
from mme_vla.types import FrameBatch

if TYPE_CHECKING:
    from mme_vla.extras.methods.memoryvla.policy import MemoryVlaPolicy

VIDEO_STRIDE = 8  # of the conditioning video every eighth frame is a moment, but for its last one


class MemoryVlaEpisode(Episode):
    """Banks beside the current view.

    Of the video every `VIDEO_STRIDE`-th frame is written; of the execution, each frame at which a
    chunk was chosen. The latter is written when the next frames arrive, so that choosing twice at
    one frame gives the same chunk.
    """

    def __init__(self, policy: "MemoryVlaPolicy", goal: str, seed: int = 0) -> None:
        super().__init__(policy, goal, seed)
        self._writer = policy
        self._banks = policy.banked.init_state()
        self._moments: list[np.ndarray] = []
        self.pending: tuple[Tensor, Tensor] | None = None
        """The moment at which the last chunk was chosen: its cognition token [1, d] and vision
        features [p, c].
        """
        self._due: np.ndarray | None = None

    @property
    def banks(self) -> BankStates:
        """What the banks hold. Moments of the video are read with the goal, so they are written
        once it is needed.
        """
        if self._moments:
            self._banks = self._writer.write(self._banks, np.stack(self._moments), self.prompt)
            self._moments = []
        return self._banks

    @banks.setter
    def banks(self, banks: BankStates) -> None:
        self._banks = banks
        self._moments = []

    def _take(
        self,
        frames: FrameBatch,
        demo: np.ndarray,
        executed: np.ndarray,
        states: np.ndarray | None = None,
    ) -> None:
        if self.pending is not None:
            self.banks = self._writer.store(self.banks, *self.pending)
            self.pending = None
        moments = []
        for i in range(len(demo)):
            if self._due is not None and demo[i]:
                # a later frame of the video shows that it was not the last one
                moments.append(self._due)
            if self._due is not None and (demo[i] or not self._video_over):
                self._due = None
            if demo[i] and (self.n_observed_frames + i) % VIDEO_STRIDE == 0:
                image = frames.image(i)
                assert image is not None, "all frames are rendered for banks"
                self._due = image.copy()
        super()._take(frames, demo, executed, states)
        self._moments = [*self._moments, *moments]  # a twin of this episode has its own list

    # Writable memory (`methods/writable_memory.py`)

    memory_clock = "moments"

    def writable_memory(self) -> tuple[MemoryEntries, ...]:
        """The entries of both banks, each with its times."""
        stores = []
        for name in ("cognition", "perceptual"):
            bank: BankState = getattr(self.banks, name)
            entries = tuple(zip(bank.times.tolist(), bank.entries, strict=True))
            stores.append(MemoryEntries(name, entries, self.banks.count))
        return tuple(stores)

    def with_entries(self, stores: Sequence[Sequence[tuple[int, Tensor]]]) -> Self:
        banks = self.banks
        cognition, perceptual = stores
        twin = copy.copy(self)
        twin.banks = replace(
            banks,
            cognition=_bank(cognition, banks.cognition),
            perceptual=_bank(perceptual, banks.perceptual),
        )
        return twin

    def resume_from(self, twin: Episode) -> None:
        assert isinstance(twin, MemoryVlaEpisode)
        self.pending = twin.pending


def _bank(entries: Sequence[tuple[int, Tensor]], like: BankState) -> BankState:
    if not entries:
        return BankState(like.entries[:0], like.times[:0])
    times, contents = zip(*entries, strict=True)
    return BankState(torch.stack(contents), like.times.new_tensor(times))
