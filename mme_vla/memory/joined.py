"""Several memories under one budget, side by side: their tokens stand one after the other (beyond
the paper).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import UserError, brief, require
from mme_vla.memory.base import (
    NEVER,
    CompilableMemory,
    MemoryModule,
    PastViewMemory,
    PastViewSpec,
    ProprioMemory,
    ScoringMemory,
    StreamingMemory,
    encode_histories,
    frames_scored,
    make_scorer,
    past_view_spec,
    start_stream,
    union_frames,
    uses_proprio,
)
from mme_vla.memory.history import FrameScorer, FrameScores, History, StorageSpec
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, Labels, MemoryTokens, ReadsLabels, labels_read

SHARE_UNIT = 16  # shares are multiples of it, so that they hold whole frames of the smaller grids


@MEMORIES.register("joined")
class JoinedMemory(
    MemoryModule,
    StreamingMemory,
    ScoringMemory,
    ProprioMemory,
    PastViewMemory,
    CompilableMemory,
    ReadsLabels,
):
    """Each member selects and encodes as if it were alone, within its share of the budget.

    The history keeps what serves all of them: a grid of which all of theirs are pooled when they
    are read (exact but for the rounding of what is stored), and every frame that anyone keeps.

    Selections lie one after the other in `HistoryTokens`, each padded as its member pads. One
    member's may vary in length, and comes first, where batches pad the shorter ones; all others are
    padded to their capacity.
    """

    def __init__(
        self,
        d_vision: int,
        width: int,
        members: Sequence[str | Mapping[str, Any]],
        budget: int = 512,
    ):
        """Build the members.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            members: names, or sections with `name` and the memory's own options.
            budget: most memory tokens of all together. Members that name no budget share evenly
                what the others leave.
        """
        super().__init__()
        sections = shares(members, budget)
        built: list[MemoryModule] = [
            MEMORIES.build(section, d_vision=d_vision, width=width) for section in sections
        ]
        self.members = nn.ModuleList(built)
        names = [section["name"] for section in sections]
        # Equal names get a number.
        self.names = [
            f"{n}_{names[: i + 1].count(n)}" if n in names[:i] else n for i, n in enumerate(names)
        ]
        self.storage = common_storage(
            dict(zip(self.names, [member.storage for member in built], strict=True))
        )
        self.budget = sum(member.budget for member in built)
        self.capacity = sum(m.capacity * (self.storage.grid // m.storage.grid) ** 2 for m in built)
        self.pad_left = any(member.pad_left for member in built)
        self.timed = all(member.timed for member in built)
        self.uses_proprio = any(uses_proprio(member) for member in built)
        self.reads_labels = labels_read(*built)
        self.lazy = all(member.lazy for member in built)
        self.past_view_spec = single_past_view_spec(
            {n: past_view_spec(m) for n, m in zip(self.names, built, strict=True)}
        )
        # Indices of the members in the order in which their selections lie.
        self._order = sorted(range(len(built)), key=lambda i: not built[i].pad_left)

    def compile(self, **options: Any) -> None:
        for member in self.memories:
            if isinstance(member, CompilableMemory):
                member.compile(**options)

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """What any member remembers, as the stored tokens it is made of."""
        indices = [
            finer(member.select(view, step, rng), member.storage.grid, self.storage.grid)
            for member, view in zip(self.memories, self._views(history), strict=True)
        ]
        return np.unique(np.concatenate(indices), axis=0)

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return union_frames([member.frames_read(steps, exec_start) for member in self.memories])

    def frames_scored(self, length: int) -> np.ndarray:
        return union_frames([frames_scored(member, length) for member in self.memories])

    def make_scorer(self) -> FrameScorer | None:
        for member in self.memories:
            scorer = make_scorer(member)
            if scorer is not None:
                return _Upsampled(scorer, member.storage.grid, self.storage.grid)
        return None

    def padded_length(self, count: int) -> int:
        first, *others = (self.memories[i] for i in self._order)
        return first.padded_length(min(count, first.capacity)) + sum(
            member.capacity for member in others
        )

    def gather_selection(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> HistoryTokens:
        memories, views = self.memories, self._views(history)
        parts = []
        for place, i in enumerate(self._order):
            part = memories[i].gather_selection(views[i], step, rng)
            parts.append(_padded(part, memories[i]) if place else part)
        features, positions, mask = (
            torch.cat([getattr(part, name) for part in parts]) for name in _FIELDS
        )
        return HistoryTokens(features, positions, mask, parts[0].step)

    def condition_on_prompt(
        self, history: HistoryTokens, condition: Callable[[Tensor], Tensor]
    ) -> HistoryTokens:
        parts = [
            self.memories[i].condition_on_prompt(piece, condition)
            for i, piece in self._pieces(history)
        ]
        return replace(history, features=torch.cat([part.features for part in parts], 1))

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        memories = self.memories
        outputs: dict[int, MemoryTokens] = {}
        for i, piece in self._pieces(history):
            memories[i].reporting = self.reporting
            outputs[i] = memories[i](piece)
        return self._joined([outputs[i] for i in range(len(memories))])

    def _pieces(self, history: HistoryTokens) -> list[tuple[int, HistoryTokens]]:
        """Each member's number and selection, in the order in which they lie."""
        fixed = [self.memories[i].capacity for i in self._order[1:]]
        lengths = [history.mask.shape[1] - sum(fixed), *fixed]
        pieces = zip(*(getattr(history, name).split(lengths, 1) for name in _FIELDS), strict=True)
        labels = [Labels() for _ in self._order]
        for name, values in history.labels.items():
            for piece, part in zip(labels, values.split(lengths, 1), strict=True):
                piece[name] = part
        return [
            (i, HistoryTokens(f, p, m, history.step, of))
            for i, (f, p, m), of in zip(self._order, pieces, labels, strict=True)
        ]

    def start_stream(self) -> tuple[Any, ...]:
        return tuple(start_stream(member) for member in self.memories)

    def encode(self, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
        views = [self._views(history) for history in histories]
        return self._joined([
            encode_histories(member, [view[i] for view in views], [stream[i] for stream in streams])
            for i, member in enumerate(self.memories)
        ])  # fmt: skip

    def prepare(self, history: History, stream: Any) -> bool:
        members = zip(self.memories, self._views(history), stream, strict=True)
        left = [
            m.prepare(view, piece) for m, view, piece in members if isinstance(m, StreamingMemory)
        ]
        return any(left)

    @property
    def memories(self) -> list[MemoryModule]:
        """The members, in their order."""
        return [member for member in self.members if isinstance(member, MemoryModule)]

    def _views(self, history: History) -> list[History]:
        return [CoarserHistory(history, member.storage) for member in self.memories]

    def _joined(self, outputs: Sequence[MemoryTokens]) -> MemoryTokens:
        pairs = list(zip(self.names, outputs, strict=True))
        metrics = {
            f"{name}/{key}": value for name, of in pairs for key, value in of.metrics.items()
        }
        losses = {f"{name}/{key}": value for name, of in pairs for key, value in of.losses.items()}
        member_ages = [f.ages for f in outputs if f.ages is not None]
        ages = torch.cat(member_ages, 1) if len(member_ages) == len(outputs) else None
        tokens, mask = (
            torch.cat([f.tokens for f in outputs], 1),
            torch.cat([f.mask for f in outputs], 1),
        )
        return MemoryTokens(tokens, mask, metrics, ages, losses)


_FIELDS = ("features", "positions", "mask")


class CoarserHistory(History):
    """A history as a memory sees it that wants a coarser grid than is stored."""

    def __init__(self, stored: History, spec: StorageSpec) -> None:
        super().__init__(spec, stored.exec_start)
        self._stored, self.motion, self.state_width = stored, stored.motion, stored.state_width
        self.clock_starts = stored.clock_starts

    def __len__(self) -> int:
        return len(self._stored)

    @property
    def scores(self) -> FrameScores:
        scores, grid, fine = self._stored.scores, self.spec.grid, self._stored.spec.grid
        rows = scores.values.reshape(-1, fine, fine)[:, :: fine // grid, :: fine // grid]
        return FrameScores(scores.frames, rows.reshape(-1, grid**2))

    @property
    def stored_frames(self) -> np.ndarray:
        return self._stored.stored_frames

    def gather(self, indices: np.ndarray) -> Tensor:
        return self._pooled(indices, self._stored.gather)

    def stored(self, indices: np.ndarray) -> Tensor:
        return self._pooled(indices, self._stored.stored)

    def _pooled(self, indices: np.ndarray, gather: Callable[[np.ndarray], Tensor]) -> Tensor:
        parts = (self._stored.spec.grid // self.spec.grid) ** 2
        pooled = gather(finer(indices, self.spec.grid, self._stored.spec.grid))
        if parts == 1:
            return pooled
        cells = pooled.unflatten(0, (-1, parts)).float()
        return (cells.mean(1) if self.spec.pooling == "mean" else cells.amax(1)).to(pooled.dtype)


class _Upsampled(FrameScorer):
    """A member's scorer, its rows spread over the finer grid that is stored."""

    def __init__(self, scorer: FrameScorer, grid: int, fine: int) -> None:
        self._scorer, self._grid, self._times = scorer, grid, fine // grid

    def __call__(self, frame_index: int, frame: np.ndarray) -> np.ndarray | None:
        row = self._scorer(frame_index, frame)
        if row is None:
            return None
        return np.kron(
            row.reshape(self._grid, self._grid), np.ones((self._times, self._times), row.dtype)
        ).reshape(-1)


def finer(indices: np.ndarray, grid: int, fine: int) -> np.ndarray:
    """(frame, patch) [n, 2] of a grid as the patches [n·k², 2] of a grid k times as fine; one after
    the other.
    """
    times = fine // grid
    row, column = np.divmod(indices[:, 1], grid)
    inside = np.arange(times)
    rows = (row[:, None] * times + inside)[:, :, None]
    patches = rows * fine + (column[:, None] * times + inside)[:, None, :]
    return np.stack([np.repeat(indices[:, 0], times**2), patches.reshape(-1)], axis=1)


def shares(members: Sequence[str | Mapping[str, Any]], budget: int) -> list[dict[str, Any]]:
    """Every member's section, with a budget: its own, or an even share of what the others leave."""
    require(
        not isinstance(members, str | Mapping) and len(members) >= 2,
        f"memory.members={brief(members)}: name at least two, such as [framesamp, ttt].",
    )
    sections: list[dict[str, Any]] = [
        dict(m) if isinstance(m, Mapping) else {"name": m} for m in members
    ]
    for section in sections:
        require(
            isinstance(section.get("name"), str) and section["name"] != "joined",
            f"memory.members: {brief(section)} is no memory to join; give a name, or {{name: …}}.",
        )
    taken = sum(section.get("budget") or 0 for section in sections)
    open_ones = [section for section in sections if section.get("budget") is None]
    share = (budget - taken) // max(len(open_ones), 1)
    share -= share % SHARE_UNIT if share >= SHARE_UNIT else 0
    if taken > budget or (open_ones and share < 1):
        requested = ", ".join(f"{s['name']} {s.get('budget') or 'an even share'}" for s in sections)
        raise UserError(
            f"memory.budget={budget} is less than its members use ({requested}): lower their"
            " budgets, or raise it."
        )
    return [
        {**section, "budget": share} if section in open_ones else section for section in sections
    ]


def common_storage(specs: Mapping[str, StorageSpec]) -> StorageSpec:
    """What has to be stored so that every one of these memories finds what it wants; some store
    nothing.
    """
    stored = {name: spec for name, spec in specs.items() if spec.keep_every != NEVER} or dict(specs)
    (first, one), *_ = stored.items()
    for name, other in stored.items():
        require(
            other.pooling == one.pooling,
            f"{first} stores {one} and {name} {other}: one history pools in one way. Set the same "
            f"pooling for both, such as {{name: {name}, pooling: {one.pooling}}}.",
        )
    scorers = {name: spec.scorer for name, spec in stored.items() if spec.scorer}
    if len(set(scorers.values())) > 1:
        raise UserError(
            f"{' and '.join(scorers)} score frames differently ({', '.join(scorers.values())}), and"
            " one history keeps one set of scores: set the same grid and stride for both, or join"
            " only one of them."
        )
    grid = math.lcm(*(spec.grid for spec in stored.values()))
    every = math.gcd(*(spec.keep_every for spec in stored.values()))
    return StorageSpec(grid, one.pooling, every, next(iter(scorers.values()), ""))


def single_past_view_spec(specs: Mapping[str, PastViewSpec | None]) -> PastViewSpec | None:
    """What the one member gives that looks back; None where none does."""
    defined = {name: spec for name, spec in specs.items() if spec is not None}
    require(
        len(defined) <= 1,
        f"{' and '.join(defined)} each give the vision tower past views: join only one of them.",
    )
    return next(iter(defined.values()), None)


def _padded(part: HistoryTokens, member: MemoryModule) -> HistoryTokens:
    """A selection at its member's capacity."""
    missing = member.capacity - len(part.mask)
    ends = (missing, 0) if member.pad_left else (0, missing)
    pad = nn.functional.pad
    features, positions = pad(part.features, (0, 0, *ends)), pad(part.positions, (0, 0, *ends))
    return HistoryTokens(features, positions, pad(part.mask, ends), part.step)
