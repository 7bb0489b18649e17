"""Where each kind of policy keeps its memory, and how to sample chunks with other entries.

No network is changed: a channel gives the policy other entries in place of its own.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import starmap
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.extras.methods.writable_memory import WritableMemory
from mme_vla.memory.base import NEVER, MemoryModule, stack_history
from mme_vla.memory.history import DerivedHistory, FrameScores, History, StorageSpec
from mme_vla.memory.joined import JoinedMemory
from mme_vla.memory.recurrent import ScheduledMemory
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.types import HistoryTokens


@dataclass(frozen=True)
class Entry:
    """One entry of a memory: a frame's tokens, a row of a bank.

    time: in frames that the policy observed (in chunks, for banks that count those).
    content: what it holds; only the channel it came from can read it.
    """

    time: int
    content: Any


@dataclass(frozen=True)
class Remembered:
    """The entries of one store, in the order they are read; None where an intervention took one
    away.

    now: the current time, on the clock of the entries' times.
    name: which store, for policies that have several.
    """

    entries: tuple[Entry | None, ...]
    now: int
    name: str = "memory"

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def occupied(self) -> list[int]:
        """Slots that hold something."""
        return [slot for slot, entry in enumerate(self.entries) if entry is not None]

    def age(self, slot: int) -> int:
        """How long ago an entry was; 0 for a slot that holds nothing."""
        entry = self.entries[slot]
        return 0 if entry is None else self.now - entry.time

    def without(self, slots: Sequence[int]) -> "Remembered":
        """The same with these slots empty."""
        remaining = list(self.entries)
        for slot in slots:
            remaining[slot] = None
        return replace(self, entries=tuple(remaining))

    def rearranged(self, slots: Sequence[int], contents: Sequence[Any]) -> "Remembered":
        """The same with other contents at these slots; times stay."""
        new = list(self.entries)
        for slot, content in zip(slots, contents, strict=True):
            entry = new[slot]
            if entry is not None:
                new[slot] = replace(entry, content=content)
        return replace(self, entries=tuple(new))

    def changed(self, other: "Remembered") -> list[int]:
        """Ages of the entries that are otherwise in `other`: taken away, of another content, or at
        another time.
        """
        ages = []
        for slot, (mine, its) in enumerate(zip(self.entries, other.entries, strict=True)):
            if mine is not its and mine is not None:
                ages.append(self.age(slot))
        return ages


Place = tuple[History, int]  # A frame of a history


def selectable(spec: StorageSpec) -> StorageSpec:
    """Which frames a memory chooses among: the stored ones; all of them where it stores none, and
    reads states and actions.
    """
    if spec.keep_every == NEVER:
        return replace(spec, keep_every=1)
    return spec


class OnlyFrames(History):
    """A history in which some stored frames follow one another as if there had been no others.

    What the memory then chooses is a choice among these; `frames` says which frame each of its
    numbers means.
    """

    def __init__(self, full: History, frames: np.ndarray) -> None:
        """Take frames [m] of `selectable`, ascending, at least one; the last means the current
        one.
        """
        spec = selectable(full.spec)
        every = spec.keep_every
        self.has_gaps = int(frames[-1] - frames[0]) > every * len(frames)
        self._length = len(frames) if every == 1 else max((len(frames) - 1) * every, 1)
        self._stored = spec.stored_frames(self._length)
        self.frames = dict(zip(self._stored.tolist(), frames.tolist(), strict=True))
        earlier = int((frames < full.exec_start).sum())
        super().__init__(
            spec, int(self._stored[earlier]) if earlier < len(frames) else self._length
        )
        self._full_history = full
        if full.motion is not None:
            self.motion = self._motion
            self.state_width = full.state_width

    def __len__(self) -> int:
        return self._length

    @property
    def stored_frames(self) -> np.ndarray:
        return self._stored

    def _motion(self, frames: np.ndarray) -> Tensor:
        """Of the stored frame that each frame is, or that comes before it."""
        stored = np.maximum(np.searchsorted(self._stored, frames, side="right") - 1, 0)
        its = [self.frames[frame] for frame in self._stored[stored].tolist()]
        return self._full_history.motion_rows(np.array(its, np.int64))

    @property
    def scores(self) -> FrameScores:
        full = self._full_history.scores
        row_of = {frame: row for row, frame in enumerate(full.frames.tolist())}
        frames = []
        rows = []
        for mine, its in self.frames.items():
            # The first frame has a score only where that of an episode has one.
            if its in row_of and (mine or 0 in row_of):
                frames.append(mine)
                rows.append(row_of[its])
        return FrameScores(np.array(frames, np.int64), full.values[rows])

    def gather(self, indices: np.ndarray) -> Tensor:
        its = np.array([self.frames[frame] for frame in indices[:, 0].tolist()], np.int64)
        return self._full_history.gather(np.stack([its, indices[:, 1]], axis=1))


class Exchanged(DerivedHistory):
    """A history whose frames hold what other frames held, of this episode or another.

    A memory chooses frames by the episode's own `scores`, `stored` and `proprio`.
    """

    def __init__(self, full: History, places: Mapping[int, Place]) -> None:
        super().__init__(full)
        self.clock_starts = (0,)  # entries have times of their own
        self._places = places
        if full.motion is not None:
            self.motion = self._motion

    def proprio(self, frames: np.ndarray) -> Tensor:
        return self._source.proprio(frames)

    def stored(self, indices: np.ndarray) -> Tensor:
        return self._source.stored(indices)

    def _motion(self, frames: np.ndarray) -> Tensor:
        return self._exchanged(frames, lambda history, its, rows: history.motion_rows(its))

    def gather(self, indices: np.ndarray) -> Tensor:
        def tokens(history: History, frames: np.ndarray, rows: list[int]) -> Tensor:
            # Of a joined memory some frames are those of states alone.
            stored = history.newest_stored(frames)
            return history.gather(np.stack([stored, indices[rows, 1]], axis=1))

        return self._exchanged(indices[:, 0], tokens)

    def _exchanged(
        self, frames: np.ndarray, read: Callable[[History, np.ndarray, list[int]], Tensor]
    ) -> Tensor:
        """What frames [n] hold, [n, w]: all of one history are read at once."""
        its = frames.astype(np.int64)
        # History → the rows of `frames` that it holds
        rows_of: dict[History, list[int]] = {}
        for row, frame in enumerate(frames.tolist()):
            history, its[row] = self._places.get(frame, (self._source, frame))
            rows_of.setdefault(history, []).append(row)
        if not rows_of:
            return read(self._source, its, [])
        order: list[int] = []
        contents = []
        for history, rows in rows_of.items():
            order += rows
            contents.append(read(history, its[rows], rows))
        return torch.cat(contents)[np.argsort(order)]


@dataclass(frozen=True)
class MemorySnapshot:
    """An episode's memory now: its stores, and what the channel needs to write them back."""

    stores: tuple[Remembered, ...]
    source: Any = None


class Channel:
    """One way to what a policy remembers; this one for a policy without a memory that a probe can
    reach.

    clock: what the times of its entries count; None where they have none.
    sees_pauses: whether frames at which nothing is decided reach this memory.
    chooses: whether the memory chooses among frames, so that it can be given fewer.
    """

    clock: str | None = None
    sees_pauses = True
    chooses = False

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def read(
        self, episode: Episode, step: int | None = None, only: np.ndarray | None = None
    ) -> MemorySnapshot:
        """What is remembered at `step` (by default now), choosing among the frames `only` where
        they are given.
        """
        return MemorySnapshot(())

    def counterfactual(
        self, episode: Episode, snapshot: MemorySnapshot, stores: Sequence[Remembered]
    ) -> Any:
        """What `predict_chunk` takes for an episode that remembers `stores` instead."""
        return episode

    def predict_chunk(
        self,
        batch: Any,
        remembering: Sequence[Any],
        draws: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """Normalised chunks [n, h, a] for a batch of n episodes, through what `counterfactual` made
        of them.
        """
        return self._policy.predict_chunk(batch, remembering, draws, steps)

    def commit(self, episode: Episode, remembering: Any) -> None:
        """Let the real episode continue from a chunk that was chosen so."""


class SelectionChannel(Channel):
    """Memories that choose stored tokens (`Memory.select`): perceptual, recurrent and joined ones;
    an entry is a frame.

    They may stand behind any network whose batch has a `history`.
    """

    clock, chooses = "frames", True

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self._memory = policy.require_memory()

    def read(
        self, episode: Episode, step: int | None = None, only: np.ndarray | None = None
    ) -> MemorySnapshot:
        full = episode.required_history()
        now = len(full) - 1 if step is None else step
        assert only is None or step is None, "choosing among some frames is for the current one"
        view: History = full if only is None else OnlyFrames(full, only)
        at = now if only is None else len(view) - 1
        names = view.frames if isinstance(view, OnlyFrames) else {}
        with reading_all(self._memory, view):
            frames = np.unique(self._memory.select(view, at)[:, 0]).tolist()
        entries = tuple(Entry(names.get(frame, frame), (view, frame)) for frame in frames)
        return MemorySnapshot((Remembered(entries, now),), (view, at, frames))

    def counterfactual(
        self, episode: Episode, snapshot: MemorySnapshot, stores: Sequence[Remembered]
    ) -> HistoryTokens:
        view, at, frames = snapshot.source
        (store,) = stores
        slots = dict(zip(frames, store.entries, strict=True))
        places = {frame: entry.content for frame, entry in slots.items() if entry is not None}
        with reading_all(self._memory, view):
            tokens = self._memory.gather_selection(Exchanged(view, places), at)
        positions, mask = tokens.positions.clone(), tokens.mask.clone()
        for frame, entry in slots.items():
            its = tokens.mask & (tokens.positions[:, 0] == frame)
            positions[its, 0] = 0.0 if entry is None else float(entry.time)
            mask[its] = entry is not None
        mask_3d = mask[:, None]
        remembered = HistoryTokens(
            tokens.features.masked_fill(~mask_3d, 0),
            positions.masked_fill(~mask_3d, 0),
            mask,
            torch.tensor(store.now),  # among `only` some frames the view counts these alone
        )
        return without_gaps(self._memory, remembered)

    def predict_chunk(
        self,
        batch: Any,
        remembering: Sequence[Any],
        draws: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        batch = replace(batch, history=stack_history(remembering, self._policy.device))
        return self._policy.sample_actions(batch, draws, steps)


@contextmanager
def reading_all(memory: MemoryModule, view: History) -> Iterator[None]:
    """While this holds, memories that read every so many frames read each one of a view whose
    frames have others between them.
    """
    scheduled: list[ScheduledMemory] = []
    if isinstance(view, OnlyFrames) and view.has_gaps:
        members = memory.memories if isinstance(memory, JoinedMemory) else [memory]
        scheduled = [member for member in members if isinstance(member, ScheduledMemory)]
    schedules = [member.schedule for member in scheduled]
    try:
        for member in scheduled:
            member.schedule = replace(member.schedule, stride=1, every=1, jitter=0)
        yield
    finally:
        for member, schedule in zip(scheduled, schedules, strict=True):
            member.schedule = schedule


def without_gaps(memory: MemoryModule, history: HistoryTokens) -> HistoryTokens:
    """An unbatched selection without gaps, for encoders that read several tokens together: these
    count on padding at one end. Where each token is encoded by itself, the others keep their slots.
    """
    if isinstance(memory, JoinedMemory):
        parts = []
        for i, selection in memory.split(stack_history([history])):
            parts.append(without_gaps(memory.memories[i], selection.rows(torch.tensor(0))))
        return replace(
            history,
            features=torch.cat([part.features for part in parts]),
            positions=torch.cat([part.positions for part in parts]),
            mask=torch.cat([part.mask for part in parts]),
        )
    if not memory.pad_left and memory.capacity == memory.budget:
        return history
    order = history.mask.int().argsort(stable=True, descending=not memory.pad_left)
    return replace(
        history,
        features=history.features[order],
        positions=history.positions[order],
        mask=history.mask[order],
    )


class WritableChannel(Channel):
    """Episodes that write a memory of their own (`policy/episode.py`), where chunks are chosen."""

    sees_pauses = False

    def __init__(self, policy: Policy, clock: str | None) -> None:
        super().__init__(policy)
        self.clock = clock

    def read(
        self, episode: Episode, step: int | None = None, only: np.ndarray | None = None
    ) -> MemorySnapshot:
        assert isinstance(episode, WritableMemory)
        stores = []
        for store in episode.writable_memory():
            entries = tuple(starmap(Entry, store.entries))
            stores.append(Remembered(entries, store.now, store.name))
        return MemorySnapshot(tuple(stores))

    def counterfactual(
        self, episode: Episode, snapshot: MemorySnapshot, stores: Sequence[Remembered]
    ) -> Any:
        assert isinstance(episode, WritableMemory)
        contents = []
        for store in stores:
            present = [entry for entry in store.entries if entry is not None]
            contents.append([(entry.time, entry.content) for entry in present])
        return episode.with_entries(contents)

    def commit(self, episode: Episode, remembering: Any) -> None:
        assert isinstance(episode, WritableMemory)
        episode.resume_from(remembering)


def channel_of(policy: Policy) -> Channel:
    """The way to what this policy remembers."""
    if policy.memory is not None:
        return SelectionChannel(policy)
    episode = policy.start_episode("")
    if isinstance(episode, WritableMemory):
        return WritableChannel(policy, episode.memory_clock)
    return Channel(policy)
