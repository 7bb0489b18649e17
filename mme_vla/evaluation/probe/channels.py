"""Where each kind of policy keeps what it remembers, and how to ask it as if it remembered something else.

Nothing here touches a network: a channel hands the policy other entries through the door that its own come through.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.evaluation.probe.altered_history import Exchanged, OnlyFrames
from mme_vla.evaluation.probe.remembered import Entry, Remembered
from mme_vla.memory.bank import BankState
from mme_vla.memory.base import stack_history
from mme_vla.memory.history import History
from mme_vla.memory.sam2act.keyframe_bank import BankState as KeyframeState
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.policy.memoryvla.episode import MemoryVlaEpisode
from mme_vla.policy.sam2act.keyframe_episode import KeyframeEpisode
from mme_vla.policy.sam2act.waypoint_policy import SAM2ActPolicy
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


class BankChannel(Channel):
    """MemoryVLA: two banks of moments, each with times of its own. Its clock counts moments."""

    clock, sees_pauses, chooses = "moments", False, False

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def read(self, episode: Episode, step: int | None = None, only: np.ndarray | None = None) -> Recollection:
        assert isinstance(episode, MemoryVlaEpisode)
        banks = episode.banks
        stores = [
            Remembered(tuple(Entry(int(t), e) for t, e in zip(bank.times, bank.entries, strict=True)), banks.count, n)
            for n, bank in (("cognition", banks.cognition), ("perceptual", banks.perceptual))
        ]
        return Recollection(tuple(stores), banks)

    def as_if(self, episode: Episode, recollection: Recollection, stores: Sequence[Remembered]) -> Episode:
        assert isinstance(episode, MemoryVlaEpisode)
        banks = recollection.source
        twin = copy.copy(episode)
        twin.banks = replace(
            banks, cognition=_bank(stores[0], banks.cognition), perceptual=_bank(stores[1], banks.perceptual)
        )
        return twin

    def answer(
        self, batch: Any, remembering: Sequence[Any], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        return self._policy.answer(batch, remembering, draws, steps)

    def chosen(self, episode: Episode, remembering: Any) -> None:
        assert isinstance(episode, MemoryVlaEpisode)
        episode.asked = remembering.asked


def _bank(store: Remembered, empty: BankState) -> BankState:
    held = [entry for entry in store.entries if entry is not None]
    entries = torch.stack([entry.content for entry in held]) if held else empty.entries[:0]
    return BankState(entries, empty.times.new_tensor([entry.time for entry in held]))


class KeyframeChannel(Channel):
    """SAM2Act+: maps of its latest keyframes, in an order and without times. An entry's age counts keyframes."""

    clock, sees_pauses, chooses = None, False, False

    def __init__(self, policy: Policy) -> None:
        assert isinstance(policy, SAM2ActPolicy)
        self._policy, self._most = policy, policy.backbone.sizes.remembered

    def read(self, episode: Episode, step: int | None = None, only: np.ndarray | None = None) -> Recollection:
        assert isinstance(episode, KeyframeEpisode)
        maps = episode.remembered.maps
        return Recollection((Remembered(tuple(Entry(i, m) for i, m in enumerate(maps)), len(maps)),))

    def as_if(self, episode: Episode, recollection: Recollection, stores: Sequence[Remembered]) -> Episode:
        assert isinstance(episode, KeyframeEpisode)
        twin = copy.copy(episode)
        twin.remembered = KeyframeState(tuple(entry.content for entry in stores[0].entries if entry is not None))
        return twin

    def answer(
        self, batch: Any, remembering: Sequence[Any], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        return self._policy.answer(batch, remembering, draws, steps)

    def chosen(self, episode: Episode, remembering: Any) -> None:
        assert isinstance(episode, KeyframeEpisode)
        newest = remembering.awaiting.maps[-1]  # the others were put there by the probe, and are not kept
        episode.decided(KeyframeState((*episode.remembered.maps, newest)[-self._most :]))


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


_BANKS: tuple[tuple[type[Episode], type[Channel]], ...] = (
    (MemoryVlaEpisode, BankChannel),
    (KeyframeEpisode, KeyframeChannel),
)


def channel_of(policy: Policy) -> Channel:
    """The way to what this policy remembers."""
    if policy.memory is not None:
        return SelectionChannel(policy)
    episode = policy.start_episode("")
    for kind, channel in _BANKS:
        if isinstance(episode, kind):
            return channel(policy)  # type: ignore[call-arg]
    return NoChannel(policy)
