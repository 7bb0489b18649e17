"""Several memories under one budget: their tokens follow one another (beyond the paper)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.errors import UserError, brief, require
from mme_vla.memory.base import (
    NEVER,
    MemoryModule,
    encode_selection,
    pad_selection,
    union_frames,
)
from mme_vla.memory.history import (
    DerivedHistory,
    FrameScorer,
    FrameScores,
    History,
    PromptConditionedHistory,
    StorageSpec,
    on_interval,
)
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, Labels, MemoryTokens, ReadsLabels, labels_read

SHARE_UNIT = 16  # shares are multiples of it, so that they hold whole frames of the smaller grids


@MEMORIES.register("joined")
class JoinedMemory(MemoryModule, ReadsLabels):
    """Each member selects and encodes as if it were alone, within its share of the budget.

    The history stores what serves all of them: a grid of which all of theirs are pooled when they
    are read (exact but for the rounding of what is stored), and every frame that a member keeps.

    Selections follow one another in `HistoryTokens`, each padded as its member pads. The length of
    the first may vary: batches pad the shorter ones. All others are padded to their capacity, so
    that `capacity` is the sum of the members'. `select` returns more rows than that where a member
    reads a coarser grid than is stored.
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
            d_vision: width of a vision token.
            width: of a memory token, given by the integration.
            members: names, or sections with `name` and the memory's own options.
            budget: most memory tokens of all together. Members that name no budget share evenly
                what the others leave.
        """
        super().__init__()
        built: list[MemoryModule] = []
        names: list[str] = []
        self.names: list[str] = []
        for member in shares(members, budget):
            section = {**member.options, "name": member.name, "budget": member.budget}
            built.append(MEMORIES.build(section, d_vision=d_vision, width=width))
            # Equal names get a number.
            names.append(member.name)
            count = names.count(member.name)
            self.names.append(member.name if count == 1 else f"{member.name}_{count}")
        self.members = nn.ModuleList(built)
        by_name = dict(zip(self.names, built, strict=True))
        self.storage = common_storage({name: one.storage for name, one in by_name.items()})
        self.budget = sum(member.budget for member in built)
        self.capacity = sum(member.capacity for member in built)
        self.pad_left = self.capacity if any(member.pad_left for member in built) else 0
        self.timed = all(member.timed for member in built)
        self.uses_proprio = any(member.uses_proprio for member in built)
        self.reads_labels = labels_read(*built)
        self.lazy = all(member.lazy for member in built)
        viewing = [name for name, one in by_name.items() if one.past_view_spec is not None]
        require(
            len(viewing) <= 1,
            f"{' and '.join(viewing)} each give the vision tower past views: join only one of"
            " them.",
        )
        self.past_view_spec = by_name[viewing[0]].past_view_spec if viewing else None
        # Indices of the members in the order in which their selections follow one another.
        self._order = sorted(range(len(built)), key=lambda i: not built[i].pad_left)

    def select(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """What all members select, as the stored tokens of which theirs are pooled."""
        selections = []
        for member, view in zip(self.memories, self._views(history), strict=True):
            indices = member.select(view, step, rng)
            selections.append(finer(indices, member.storage.grid, self.storage.grid))
        return np.unique(np.concatenate(selections), axis=0)

    def frames_read(self, steps: Sequence[int] | np.ndarray, exec_start: int) -> np.ndarray:
        return union_frames([member.frames_read(steps, exec_start) for member in self.memories])

    def make_scorer(self) -> FrameScorer | None:
        for member in self.memories:
            scorer = member.make_scorer()
            if scorer is not None:
                return _Upsampled(scorer, member.storage.grid, self.storage.grid)
        return None

    def gather_selection(
        self, history: History, step: int, rng: np.random.Generator | None = None
    ) -> HistoryTokens:
        memories = self.memories
        views = self._views(history)
        first, *others = self._order
        parts = [memories[first].gather_selection(views[first], step, rng)]
        for i in others:
            part = memories[i].gather_selection(views[i], step, rng)
            parts.append(pad_selection(part, memories[i].capacity, bool(memories[i].pad_left)))
        return HistoryTokens(
            features=torch.cat([part.features for part in parts]),
            positions=torch.cat([part.positions for part in parts]),
            mask=torch.cat([part.mask for part in parts]),
            step=parts[0].step,
        )

    def condition_on_prompt(
        self, history: HistoryTokens, with_prompt: Callable[[Tensor], Tensor]
    ) -> HistoryTokens:
        features = []
        for i, part in self.split(history):
            # In float32, as states beside tokens are: an episode conditions them so too.
            selection = replace(part, features=part.features.float())
            features.append(self.memories[i].condition_on_prompt(selection, with_prompt).features)
        return replace(history, features=torch.cat(features, 1))

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        memories = self.memories
        outputs: dict[int, MemoryTokens] = {}
        for i, selection in self.split(history):
            memories[i].reporting = self.reporting
            outputs[i] = encode_selection(memories[i], selection)
        return self._join([outputs[i] for i in range(len(memories))])

    def split(self, history: HistoryTokens) -> list[tuple[int, HistoryTokens]]:
        """Each member's index and selection, in the order in which they follow one another."""
        first, *others = self._order
        lengths = {i: self.memories[i].capacity for i in others}
        lengths[first] = history.mask.shape[1] - sum(lengths.values())
        selections = []
        start = 0
        for i in self._order:
            stop = start + lengths[i]
            selection = HistoryTokens(
                features=history.features[:, start:stop],
                positions=history.positions[:, start:stop],
                mask=history.mask[:, start:stop],
                step=history.step,
                labels=Labels({k: values[:, start:stop] for k, values in history.labels.items()}),
            )
            selections.append((i, selection))
            start = stop
        return selections

    def start_stream(self) -> tuple[Any, ...]:
        return tuple(member.start_stream() for member in self.memories)

    def encode(self, histories: Sequence[History], streams: Sequence[Any]) -> MemoryTokens:
        views = [self._views(history) for history in histories]
        outputs = []
        for i, member in enumerate(self.memories):
            member_histories = [view[i] for view in views]
            member_streams = [stream[i] for stream in streams]
            outputs.append(member.encode(member_histories, member_streams))
        return self._join(outputs)

    def prepare(self, history: History, stream: Any) -> bool:
        is_left = False
        members = zip(self.memories, self._views(history), stream, strict=True)
        for member, view, member_stream in members:
            if member.prepare(view, member_stream):
                is_left = True
        return is_left

    @property
    def memories(self) -> list[MemoryModule]:
        """The members, in their order."""
        return [member for member in self.members if isinstance(member, MemoryModule)]

    def _views(self, history: History) -> list[History]:
        return [CoarserHistory(history, member.storage) for member in self.memories]

    def _join(self, outputs: Sequence[MemoryTokens]) -> MemoryTokens:
        """The members' tokens, one after the other; their metrics and losses under their names."""
        metrics: dict[str, Tensor] = {}
        losses: dict[str, Tensor] = {}
        for name, output in zip(self.names, outputs, strict=True):
            metrics |= {f"{name}/{key}": value for key, value in output.metrics.items()}
            losses |= {f"{name}/{key}": value for key, value in output.losses.items()}
        ages = None
        member_ages = [output.ages for output in outputs if output.ages is not None]
        if len(member_ages) == len(outputs):
            ages = torch.cat(member_ages, 1)
        tokens = torch.cat([output.tokens for output in outputs], 1)
        mask = torch.cat([output.mask for output in outputs], 1)
        return MemoryTokens(tokens, mask, metrics, ages, losses)


class CoarserHistory(DerivedHistory):
    """A history as a member reads it that needs a coarser grid, or fewer frames than are stored."""

    def __init__(self, source: History, spec: StorageSpec) -> None:
        super().__init__(source)
        self.spec = spec

    @property
    def stored_frames(self) -> np.ndarray:
        stored = self._source.stored_frames
        return stored[on_interval(stored, self.spec.keep_every)]

    @property
    def scores(self) -> FrameScores:
        scores = self._source.scores
        grid, fine = self.spec.grid, self._source.spec.grid
        every = fine // grid
        rows = scores.values.reshape(-1, fine, fine)[:, ::every, ::every]
        return FrameScores(scores.frames, rows.reshape(-1, grid**2))

    def gather(self, indices: np.ndarray) -> Tensor:
        if isinstance(self._source, PromptConditionedHistory):
            # As in training, the prompt conditions tokens that are pooled.
            tokens = self._pooled(indices, self._source.stored)
            return self._source.with_prompt(tokens[None].float())[0]
        return self._pooled(indices, self._source.gather)

    def stored(self, indices: np.ndarray) -> Tensor:
        return self._pooled(indices, self._source.stored)

    def _pooled(self, indices: np.ndarray, gather: Callable[[np.ndarray], Tensor]) -> Tensor:
        fine = self._source.spec.grid
        tokens = gather(finer(indices, self.spec.grid, fine))
        parts = (fine // self.spec.grid) ** 2
        if parts == 1:
            return tokens
        cells = tokens.unflatten(0, (-1, parts)).float()
        pooled = cells.mean(1) if self.spec.pooling == "mean" else cells.amax(1)
        return pooled.to(tokens.dtype)


class _Upsampled(FrameScorer):
    """A member's scorer, its rows expanded to the finer grid that is stored."""

    def __init__(self, scorer: FrameScorer, grid: int, fine: int) -> None:
        self._scorer = scorer
        self.grid = grid
        self._times = fine // grid

    @property
    def key(self) -> str:
        """The member's: its code and options decide the scores."""
        return self._scorer.key

    def frames_scored(self, length: int) -> np.ndarray:
        return self._scorer.frames_scored(length)

    def __call__(self, frame_index: int, frame: np.ndarray) -> np.ndarray | None:
        row = self._scorer(frame_index, frame)
        if row is None:
            return None
        cells = row.reshape(self.grid, self.grid)
        return np.kron(cells, np.ones((self._times, self._times), row.dtype)).reshape(-1)


def finer(indices: np.ndarray, grid: int, fine: int) -> np.ndarray:
    """(frame, patch) [n, 2] of a grid as the patches [n·k², 2] of a grid k times as fine; one after
    the other.
    """
    times = fine // grid
    row, column = np.divmod(indices[:, 1], grid)
    inside = np.arange(times)
    rows = row[:, None] * times + inside  # n k
    columns = column[:, None] * times + inside
    patches = rows[:, :, None] * fine + columns[:, None, :]  # n k k
    return np.stack([np.repeat(indices[:, 0], times**2), patches.reshape(-1)], axis=1)


@dataclass(frozen=True)
class Member:
    """One of the memories that are joined; options: its own, without name and budget."""

    name: str
    budget: int | None
    options: Mapping[str, Any]


def shares(members: Sequence[str | Mapping[str, Any]], budget: int) -> list[Member]:
    """Every member with a budget: its own, or an even share of what the others leave."""
    require(
        not isinstance(members, str | Mapping) and len(members) >= 2,
        f"memory.members={brief(members)}: name at least two, such as [framesamp, ttt].",
    )
    read: list[Member] = []
    taken = 0
    n_open = 0
    for member in members:
        options: dict[str, Any] = {"name": member}
        if isinstance(member, Mapping):
            options = dict(member)
        name = options.pop("name", None)
        member_budget = options.pop("budget", None)
        require(
            isinstance(name, str) and name != "joined",
            f"memory.members: {brief(member)} is no memory to join; give a name, or {{name: …}}.",
        )
        require(
            member_budget is None or type(member_budget) is int,
            f"memory.members: {brief(member)}: budget={brief(member_budget)} must be a whole"
            " number.",
        )
        read.append(Member(name, member_budget, options))
        if member_budget is None:
            n_open += 1
        else:
            taken += member_budget
    share = (budget - taken) // max(n_open, 1)
    if share >= SHARE_UNIT:
        share -= share % SHARE_UNIT
    if taken > budget or (n_open and share < 1):
        requests = [f"{one.name} {one.budget or 'an even share'}" for one in read]
        raise UserError(
            f"memory.budget={budget} is less than its members use ({', '.join(requests)}): lower"
            " their budgets, or raise it."
        )
    return [replace(one, budget=share) if one.budget is None else one for one in read]


def common_storage(specs: Mapping[str, StorageSpec]) -> StorageSpec:
    """What has to be stored so that each of these memories finds what it reads; some store nothing.

    Raises:
        UserError: they pool in different ways, or score frames differently.
    """
    stored = {name: spec for name, spec in specs.items() if spec.keep_every != NEVER}
    if not stored:
        stored = dict(specs)
    first_name, first = next(iter(stored.items()))
    for name, other in stored.items():
        require(
            other.pooling == first.pooling,
            f"{first_name} stores {first} and {name} {other}: one history pools in one way. Set the"
            f" same pooling for both, such as {{name: {name}, pooling: {first.pooling}}}.",
        )
    scorers = {name: spec.scorer for name, spec in stored.items() if spec.scorer}
    keys = set(scorers.values())
    if len(keys) > 1:
        raise UserError(
            f"{' and '.join(scorers)} score frames differently ({', '.join(scorers.values())}), and"
            " one history keeps one set of scores: set the same grid and stride for both, or join"
            " only one of them."
        )
    return StorageSpec(
        grid=math.lcm(*(spec.grid for spec in stored.values())),
        pooling=first.pooling,
        keep_every=math.gcd(*(spec.keep_every for spec in stored.values())),
        scorer=next(iter(keys), ""),
    )
