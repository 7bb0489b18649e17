"""Score of writing: whether the frames that a memory keeps are those that show what an episode's
outcome depends on.

Nothing is trained and no policy acts: the memory selects along demonstrated episodes
(`evidence.py`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import comb
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mme_vla.data.statistics import normalised_states
from mme_vla.envs.facts import Fact
from mme_vla.errors import UserError
from mme_vla.extras.probing.evidence import EvidenceEpisode
from mme_vla.memory.base import MemoryModule, stack_history
from mme_vla.memory.history import (
    CachedHistory,
    FrameScores,
    History,
    TokenlessHistory,
    TokensReadError,
    score_frames,
)
from mme_vla.processing.normalise import normalize

if TYPE_CHECKING:
    from mme_vla.policy.mme import MMEPolicy

LONGEST = 4000
"""Frames of an episode that are rendered for a memory at most."""
STRIDE = 4
"""Frames between two steps at which a memory selects: the resolution of the lag."""
FRAMES = 32
"""Frames that the reference selections keep: as many as FrameSamp."""
Selection = Callable[[int], np.ndarray]
"""The frames kept at a step, ascending."""


# Definitions --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EpisodeWriting:
    """What a memory kept along one episode, against the frames that show its facts.

    precision: share of the kept frames that show a fact.
    recall: share of the facts so far of which a frame is kept. Both are means over the steps of the
        execution.
    chance_precision, chance_recall: the expectation for as many frames at random.
    lags: of each fact that was kept at some step, frames from its first frame to the first such
        step.
    """

    precision: float
    recall: float
    chance_precision: float
    chance_recall: float
    lags: Sequence[int]
    facts: int

    @property
    def score(self) -> float:
        """The harmonic mean of precision and recall."""
        return harmonic_mean(self.precision, self.recall)

    @property
    def chance(self) -> float:
        """The score of as many frames at random."""
        return harmonic_mean(self.chance_precision, self.chance_recall)


def harmonic_mean(a: float, b: float) -> float:
    """2ab / (a + b); 0 where both are 0."""
    return 2 * a * b / (a + b) if a + b else 0.0


def score_episode(
    selection: Selection,
    facts: Mapping[str, np.ndarray],
    length: int,
    exec_start: int,
    stride: int = STRIDE,
) -> EpisodeWriting | None:
    """Score a selection along one episode; None where no fact has been visible at any step of the
    execution.

    Args:
        selection: the frames selected at a step.
        facts: name → frames that show it, ascending.
        length: of the episode.
        exec_start: its first execution frame.
        stride: frames between two steps.
    """
    visible = np.zeros((len(facts), length), bool)
    for row, frames in zip(visible, facts.values(), strict=True):
        row[frames] = True
    first = visible.argmax(1) if len(facts) else np.zeros(0, np.int64)
    retained = np.full(len(facts), -1)
    rows = []
    for step in range(0, length, stride):
        begun = first <= step
        if not begun.any():
            continue
        frames = selection(step)
        past = visible[:, : step + 1]
        selected = past[:, frames]
        retained[(retained < 0) & selected.any(1)] = step
        if step < exec_start:
            continue
        count = len(frames)
        shows = float(selected.any(0).mean()) if count else 0.0
        recall = selected[begun].any(1).mean()
        # Of so many frames at random, none shows a fact with the hypergeometric probability of 0.
        missed = []
        for row in past[begun]:
            missed.append(comb(step + 1 - int(row.sum()), count) / comb(step + 1, count))
        rows.append((shows, recall, past.any(0).mean(), 1 - np.mean(missed)))
    if not rows:
        return None
    lags = (retained - first)[retained >= 0].tolist()
    precision, recall, chance_precision, chance_recall = np.mean(np.asarray(rows), axis=0).tolist()
    return EpisodeWriting(precision, recall, chance_precision, chance_recall, lags, len(facts))


@dataclass(frozen=True)
class Operations:
    """What a memory did with the facts of one episode, at the decisions that depend on them.

    stored: of each fact that a decision depends on, whether the memory keeps a frame of it there.
    updated: of each fact that another one replaced before the decision, whether as many frames of
        the new one are kept there as of the old one, and at least one.
    n_stored: facts stored at each decision.
    """

    stored: Sequence[bool]
    updated: Sequence[bool]
    n_stored: Sequence[int]


def operations_of(selection: Selection, facts: Sequence[Fact]) -> Operations:
    """Storage and update of one episode.

    Args:
        selection: the frames selected at a step.
        facts: with the decisions that need them.
    """
    stored: list[bool] = []
    updated: list[bool] = []
    n_stored: list[int] = []
    decisions: set[int] = set()
    for fact in facts:
        decisions.update(fact.needed)
    for decision in sorted(decisions):
        frames = selection(decision)
        needed = [fact for fact in facts if decision in fact.needed]
        counts = []  # of each, how many of the frames show it
        for fact in needed:
            first, last = fact.frames
            counts.append(int(((frames >= first) & (frames <= last)).sum()))
        of_decision = [count > 0 for count in counts]
        stored += of_decision
        n_stored.append(sum(of_decision))
        for fact, count in zip(needed, counts, strict=True):
            if fact.changed is None or fact.changed > decision:
                continue
            for other, new in zip(needed, counts, strict=True):
                if other.frames[0] == fact.changed:
                    updated.append(new >= max(count, 1))
    return Operations(stored, updated, n_stored)


@dataclass
class Writing:
    """The scores of one memory: task → its episodes.

    operations: task → those of its episodes.
    budget: tokens of the memory; None where the frames are no memory's.
    """

    tasks: dict[str, list[EpisodeWriting]] = field(default_factory=dict)
    operations: dict[str, list[Operations]] = field(default_factory=dict)
    budget: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """`tasks` and `mean`: rows of `precision`, `recall`, `score`, `chance`, `lag`, `held`,
        `facts`, `episodes`, `storage`, `update` and `compression`.

        lag: mean, in frames; None where no fact was kept.
        held: share of the facts that were kept at some step.
        """
        rows = {}
        for task, episodes in self.tasks.items():
            row: dict[str, Any] = {}
            for name in ("precision", "recall", "score", "chance"):
                row[name] = float(np.mean([getattr(episode, name) for episode in episodes]))
            lags = np.concatenate([episode.lags for episode in episodes])
            facts = sum(episode.facts for episode in episodes)
            row["lag"] = float(lags.mean()) if len(lags) else None
            row["held"] = len(lags) / facts
            row["facts"] = facts
            row["episodes"] = len(episodes)
            rows[task] = row | _operations_row(self.operations.get(task, ()), self.budget)
        mean: dict[str, Any] = {}
        for name in next(iter(rows.values()), {}):
            values = [row[name] for row in rows.values() if row[name] is not None]
            mean[name] = None
            if name in ("facts", "episodes"):
                mean[name] = sum(values)
            elif values:
                mean[name] = float(np.mean(values))
        return {"tasks": rows, "mean": mean}


def _operations_row(episodes: Sequence[Operations], budget: int | None) -> dict[str, float | None]:
    """`storage`, `update` and `compression` over some episodes.

    storage, update: shares of `Operations.stored` and `updated`; None where there is none.
    compression: facts stored at a decision for each token of the budget.
    """
    stored: list[bool] = []
    updated: list[bool] = []
    n_stored: list[int] = []
    for operations in episodes:
        stored += operations.stored
        updated += operations.updated
        n_stored += operations.n_stored
    row: dict[str, float | None] = {"storage": None, "update": None, "compression": None}
    if stored:
        row["storage"] = float(np.mean(stored))
    if updated:
        row["update"] = float(np.mean(updated))
    if n_stored and budget:
        row["compression"] = float(np.mean(n_stored)) / budget
    return row


# Selections ---------------------------------------------------------------------------------------


def oracle_selection(episode: EvidenceEpisode) -> Selection:
    """The first frame of each fact so far, at most `FRAMES`: the ceiling."""
    first = np.unique([frames[0] for frames in episode.evidence.values()]).astype(np.int64)
    return lambda step: first[first <= step][-FRAMES:]


def random_selection(episode: EvidenceEpisode) -> Selection:
    """`FRAMES` frames at random, anew at each step: chance."""

    def selection(step: int) -> np.ndarray:
        rng = np.random.default_rng([episode.episode, step])
        return np.sort(rng.choice(step + 1, min(FRAMES, step + 1), replace=False))

    return selection


def boundary_selection(episode: EvidenceEpisode) -> Selection:
    """The frames at which sub-tasks begin, and the newest: what the probe's `oracle` lets a memory
    choose from.
    """
    return lambda step: np.union1d(episode.boundaries[episode.boundaries <= step], [step])[-FRAMES:]


REFERENCES = {
    "oracle": oracle_selection,
    "random": random_selection,
    "boundaries": boundary_selection,
}
"""Selections without a memory, by name."""


def selected_frames(memory: MemoryModule, history: History, step: int) -> np.ndarray:
    """The frames that a memory keeps at a step, ascending: those of its selection.

    Where `forward` chooses among the selected tokens, those of its memory tokens.

    Raises:
        UserError: memory tokens belong to no frame, as a recurrent memory's.
    """
    if not memory.timed:
        raise UserError(
            f"{type(memory).__name__} makes a state of all frames that it reads and keeps none:"
            " score one that selects."
        )
    if memory.capacity <= memory.budget:
        return np.unique(memory.select(history, step)[:, 0])
    tokens = memory(stack_history([memory.gather_selection(history, step)]))
    ages = tokens.ages[tokens.mask].cpu().numpy()
    return np.unique(step - ages[ages == ages.round()].astype(np.int64))


def reads_tokens(memory: MemoryModule) -> bool:
    """Whether a memory reads vision tokens to choose its frames, tried on an episode of `LONGEST`
    frames.
    """
    stored = memory.storage.stored_frames(LONGEST)
    unscored = FrameScores.empty(memory.storage.grid**2)
    history = CachedHistory(memory.storage, np.zeros(0), stored, LONGEST, unscored)
    history.motion, history.state_width = torch.zeros(LONGEST, 8).__getitem__, 8
    try:
        selected_frames(memory, TokenlessHistory(history), LONGEST - 1)
    except TokensReadError:
        return True
    return False


def required_frames(memory: MemoryModule) -> frozenset[int]:
    """The frames that have to be rendered for a memory to select: scored ones, and all stored if it
    reads tokens.
    """
    scorer = memory.make_scorer()
    frames = np.zeros(0, np.int64) if scorer is None else scorer.frames_scored(LONGEST)
    if reads_tokens(memory):
        frames = np.union1d(frames, memory.storage.stored_frames(LONGEST))
    return frozenset(frames.tolist())


def memory_selection(
    memory: MemoryModule,
    episode: EvidenceEpisode,
    states: torch.Tensor,
    policy: "MMEPolicy | None" = None,
) -> Selection:
    """What a memory keeps along an episode.

    Args:
        states: of the robot, normalised [t, s].
        policy: makes the tokens; None where the memory reads none to choose.
    """
    # The scores of frames, for memories that choose by them.
    patches = memory.storage.grid**2
    scores = score_frames(memory.make_scorer(), episode.images, patches)

    # Their tokens, for memories that read them.
    stored = memory.storage.stored_frames(episode.length)
    tokens = np.zeros(0)
    if policy is not None:
        images = np.stack([episode.images[frame] for frame in stored.tolist()])
        tokens = policy.encode_frames(images).float().cpu().numpy()
    history: History = CachedHistory(
        memory.storage, tokens, stored, episode.length, scores, episode.exec_start
    )
    history.motion = states.__getitem__
    history.state_width = states.shape[1]
    if policy is None:
        history = TokenlessHistory(history)
    return lambda step: selected_frames(memory, history, step)


@torch.no_grad()
def score_writing(
    selector: MemoryModule | str,
    episodes: Sequence[EvidenceEpisode],
    policy: "MMEPolicy | None" = None,
    stride: int = STRIDE,
) -> Writing:
    """Score what a memory keeps along demonstrated episodes.

    Args:
        selector: a memory, or a name of `REFERENCES`.
        episodes: with the images of `required_frames`.
        policy: the memory's own. Its statistics normalise states, and its vision tower makes tokens
            where the memory reads them to choose. Without it the statistics are those of the
            episodes.
        stride: frames between two steps.

    Raises:
        UserError: the memory keeps no frames, or reads tokens and there is no policy.
    """
    writing = Writing()
    if not episodes:
        return writing
    raw = np.concatenate([episode.states for episode in episodes])
    if policy is None:
        normalised = normalised_states(raw)
    else:
        stats = policy.require_processor().require_stats().state
        normalised = normalize(torch.from_numpy(raw), stats)
    states = normalised.split([episode.length for episode in episodes])
    if isinstance(selector, MemoryModule):
        writing.budget = selector.budget
    tower = policy if isinstance(selector, MemoryModule) and reads_tokens(selector) else None
    for episode, motion in zip(episodes, states, strict=True):
        if isinstance(selector, str):
            selection = REFERENCES[selector](episode)
        else:
            selection = memory_selection(selector, episode, motion, tower)
        score = score_episode(
            selection, episode.evidence, episode.length, episode.exec_start, stride
        )
        if score is not None:
            writing.tasks.setdefault(episode.task, []).append(score)
            operations = operations_of(selection, episode.facts)
            writing.operations.setdefault(episode.task, []).append(operations)
    return writing


def writing_table(results: Mapping[str, Writing]) -> str:
    """Two Markdown tables: the means of each memory, and the score of each in every task with
    chance behind it.

    Memories that were scored on no episode are left out.
    """
    rows = {name: writing.to_dict() for name, writing in results.items() if writing.tasks}
    lines = [
        "| memory | score | chance | precision | recall | lag | held | storage | update |"
        " facts a 100 tokens |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, row in rows.items():
        mean = row["mean"]
        keys = ("score", "chance", "precision", "recall")
        shares = " | ".join(f"{mean[key]:.2f}" for key in keys)
        lag = "" if mean["lag"] is None else f"{mean['lag']:.0f}"
        rates = []
        for key, factor in (("storage", 1), ("update", 1), ("compression", 100)):
            rates.append("" if mean[key] is None else f"{factor * mean[key]:.2f}")
        lines.append(f"| `{name}` | {shares} | {lag} | {mean['held']:.2f} | {' | '.join(rates)} |")
    names = [f"`{name}`" for name in rows]
    lines += ["", f"| task | {' | '.join(names)} |", "|---|" + "---:|" * len(rows)]
    tasks: dict[str, None] = {}
    for row in rows.values():
        tasks |= dict.fromkeys(row["tasks"])
    for task in tasks:
        texts = []
        for row in rows.values():
            cell = row["tasks"].get(task)
            texts.append("" if cell is None else f"{cell['score']:.2f} ({cell['chance']:.2f})")
        lines.append(f"| {task} | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"
