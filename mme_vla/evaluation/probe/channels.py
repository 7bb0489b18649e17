"""Where each kind of policy keeps what it remembers, and how to ask it as if it remembered something else.

Nothing here touches a network: a channel hands the policy other entries through the door that its own come through.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from mme_vla.evaluation.probe.altered_history import Exchanged, OnlyFrames
from mme_vla.evaluation.probe.remembered import Entry, Remembered
from mme_vla.memory.base import stack_history
from mme_vla.memory.history import History
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.policy.written import Writes
from mme_vla.types import HistoryTokens


@dataclass(frozen=True)
class Recollection:
    """What an episode remembers now: its stores, and what the channel needs to give them back."""

    stores: tuple[Remembered, ...]
    source: Any = None


class Channel:
    """One way to what a policy remembers. `clock`: what the times of its entries count; None where they have none."""

    clock: str | None = "frames"
    sees_pauses = True
    """Whether frames at which nothing is decided reach this memory."""
    chooses = True
    """Whether the memory chooses among frames, so that it can be given fewer."""

    def read(self, episode: Episode, step: int | None = None, only: np.ndarray | None = None) -> Recollection:
        """What is remembered at `step` (by default now), choosing among the frames `only` where they are given."""
        raise NotImplementedError

    def as_if(self, episode: Episode, recollection: Recollection, stores: Sequence[Remembered]) -> Any:
        """What `answer` takes for an episode that remembers `stores` instead."""
        raise NotImplementedError

    def answer(
        self, batch: Any, remembering: Sequence[Any], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        """Normalised chunks [n, h, a] for what `observation` saw of n episodes, through what `as_if` made of them."""
        raise NotImplementedError

    def chosen(self, episode: Episode, remembering: Any) -> None:
        """Let the real episode go on from a chunk that was chosen so."""


class SelectionChannel(Channel):
    """Memories that choose stored tokens (`Memory.select`): perceptual, recurrent and joined ones; an entry is a frame.

    They may stand behind any network whose batch has a `history`.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy, self._memory = policy, policy.require_memory()

    def read(self, episode: Episode, step: int | None = None, only: np.ndarray | None = None) -> Recollection:
        whole = episode.required_history()
        now = len(whole) - 1 if step is None else step
        if only is not None and step is not None:
            raise ValueError("Choosing among some frames is for the current one.")
        view: History = whole if only is None else OnlyFrames(whole, only)
        at = now if only is None else len(view) - 1
        names = view.frames if isinstance(view, OnlyFrames) else {}
        frames = np.unique(self._memory.select(view, at)[:, 0]).tolist()
        entries = tuple(Entry(names.get(frame, frame), (view, frame)) for frame in frames)
        return Recollection((Remembered(entries, now),), (view, at, frames))

    def as_if(self, episode: Episode, recollection: Recollection, stores: Sequence[Remembered]) -> HistoryTokens:
        view, at, frames = recollection.source
        slots = dict(zip(frames, stores[0].entries, strict=True))
        places = {frame: entry.content for frame, entry in slots.items() if entry is not None}
        tokens = self._memory.recall(Exchanged(view, places), at)
        positions, mask = tokens.positions.clone(), tokens.mask.clone()
        for frame, entry in slots.items():
            its = tokens.mask & (tokens.positions[:, 0] == frame)
            positions[its, 0] = 0.0 if entry is None else float(entry.time)
            mask[its] = entry is not None
        kept = mask[:, None]
        return HistoryTokens(tokens.features.masked_fill(~kept, 0), positions.masked_fill(~kept, 0), mask, tokens.step)

    def answer(
        self, batch: Any, remembering: Sequence[Any], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        batch = replace(batch, history=stack_history(remembering, self._policy.device))
        return self._policy.sample_actions(batch, draws, steps)


class WrittenChannel(Channel):
    """Episodes that write a memory of their own (`policy/written.py`), where chunks are chosen."""

    sees_pauses, chooses = False, False

    def __init__(self, policy: Policy, clock: str | None) -> None:
        self._policy, self.clock = policy, clock

    def read(self, episode: Episode, step: int | None = None, only: np.ndarray | None = None) -> Recollection:
        assert isinstance(episode, Writes)
        stores = [
            Remembered(tuple(Entry(time, content) for time, content in store.entries), store.now, store.name)
            for store in episode.written()
        ]
        return Recollection(tuple(stores))

    def as_if(self, episode: Episode, recollection: Recollection, stores: Sequence[Remembered]) -> Any:
        assert isinstance(episode, Writes)
        held = [[(entry.time, entry.content) for entry in store.entries if entry is not None] for store in stores]
        return episode.as_if_written(held)

    def answer(
        self, batch: Any, remembering: Sequence[Any], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        return self._policy.answer(batch, remembering, draws, steps)

    def chosen(self, episode: Episode, remembering: Any) -> None:
        assert isinstance(episode, Writes)
        episode.go_on_from(remembering)


class NoChannel(Channel):
    """A policy without a memory that a probe can reach: what it is shown can be changed, and what it is told."""

    clock, chooses = None, False

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def read(self, episode: Episode, step: int | None = None, only: np.ndarray | None = None) -> Recollection:
        return Recollection(())

    def as_if(self, episode: Episode, recollection: Recollection, stores: Sequence[Remembered]) -> Episode:
        return episode

    def answer(
        self, batch: Any, remembering: Sequence[Any], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        return self._policy.answer(batch, remembering, draws, steps)


def channel_of(policy: Policy) -> Channel:
    """The way to what this policy remembers."""
    if policy.memory is not None:
        return SelectionChannel(policy)
    episode = policy.start_episode("")
    return WrittenChannel(policy, episode.written_clock) if isinstance(episode, Writes) else NoChannel(policy)
