"""Training on demonstrations of motions or choices: every decision is a sample, of tokens made
beforehand.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from mme_vla.backbone.siglip import pool_grid
from mme_vla.data.columns import BOUNDARY, FACT, FACT_VISIBLE, SUBTASK, with_labels
from mme_vla.embodiment.action_space import MIDDLE, ActionSpace
from mme_vla.errors import require
from mme_vla.extras.nano.backbone import NanoBackbone
from mme_vla.extras.nano.demonstrations import Demonstration
from mme_vla.extras.nano.tokens import FrameTokens, tokenize
from mme_vla.extras.nano.tower import reflect, reflect_points
from mme_vla.memory.base import Memory, stack_history
from mme_vla.memory.history import CachedHistory, History
from mme_vla.memory.perturbation import Perturbation
from mme_vla.memory.transforms import TransformedHistory, map_frames
from mme_vla.policy.base import draw_noise
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.base import motion_rows
from mme_vla.processing.normalise import NormStats, RunningStats
from mme_vla.processing.prompt import perturb_point, subgoal_kind
from mme_vla.training.order import generator_for, seed_of
from mme_vla.types import Batch, HistoryTokens, labels_read

# of an action's number, in metres or radians: less than that is jitter, and is not blown up
NARROWEST = 0.1
FrameLabels = Mapping[str, np.ndarray]
"""Name of a label → its values [t] at all frames."""
JOINT_NOISE = 0.05
VIEW_NOISE = 0.25  # on tokens of current images: what points at an object reads its place there
MIN_DISTANCE = 0.05  # Metres above the table from where on a motion is one to another place


@dataclass(frozen=True)
class Replay:
    """What a memory selects from in a demonstration whose frames are transformed, anew in each
    epoch.

    rows: for each decision its history, its frame, and the labels of its demonstration.
    """

    memory: Memory
    rows: Sequence[tuple[History, int, FrameLabels]]
    transforms: Sequence[Perturbation]
    seed: int

    def select(self, rows: Sequence[int], epoch: int) -> HistoryTokens:
        """The selections of these decisions, each a function of (seed, epoch, row)."""
        items = []
        for row in rows:
            history, frame, labels = self.rows[row]
            rng = np.random.default_rng([self.seed, epoch, row])
            visible = map_frames(self.transforms, frame + 1, history.exec_start, rng, keep=[frame])
            now = int(visible.transformed(np.array(frame)))
            selection = self.memory.gather_selection(TransformedHistory(history, visible), now)
            items.append(with_labels(selection, labels, visible.real))
        return stack_history(items)


def check_reflection(p: float, space: ActionSpace, layout: str | None) -> None:
    """Raise UserError unless decisions can be learned at mirrored places with probability p.

    layout: of the tokens of a nano backbone's tower (`backbone.vision.layout`); None of another
        backbone.
    """
    require(0 <= p < 1, f"learning.reflect={p} must be a probability below 1.")
    require(
        not p or (len(space.point) == 2 and layout == "places"),
        f"learning.reflect={p} needs a point in the image and located objects: set"
        " learning.reflect=0, or embodiment=robomme_choice_front and backbone=nano_choice.",
    )


@dataclass(frozen=True)
class Reflection:
    """Mirrors the places of a decision's objects, in its images, its memory and its point alike.

    What is learned of one place then holds for others. The robot's joints stay as they are.

    p: probability of each of three changes: columns are mirrored, rows are, and both change places.
    bounds: what the numbers of points [2] are normalised by.
    columns: of a point in an action.
    fixed: [n] bool, decisions that it leaves alone.
    """

    p: float
    bounds: tuple[Tensor, Tensor]
    columns: Sequence[int]
    fixed: Tensor

    @classmethod
    def of(
        cls, policy: MMEPolicy, p: float, goals: Sequence[str], sides: Sequence[str]
    ) -> "Reflection | None":
        """None with p=0, and for a memory of the robot's joints, which stay where they are.

        goals: of all decisions.
        sides: words of goals that depend on where left or forward is.
        """
        if not p or (policy.memory is not None and policy.memory.uses_proprio):
            return None
        space = policy.embodiment.action
        backbone = policy.backbone
        layout = backbone.config.vision.layout if isinstance(backbone, NanoBackbone) else None
        check_reflection(p, space, layout)
        stats = policy.require_processor().stats
        assert stats is not None
        columns = list(space.point)
        low, high = stats.actions.bounds("quantiles")
        bounds = (
            torch.as_tensor(low, dtype=torch.float32)[columns],
            torch.as_tensor(high, dtype=torch.float32)[columns],
        )
        fixed = torch.zeros(len(goals), dtype=torch.bool)
        if sides:
            names_a_side = re.compile("|".join(rf"\b{side}\b" for side in sides))
            fixed = torch.tensor([names_a_side.search(goal) is not None for goal in goals])
        return cls(p, bounds, columns, fixed)

    def __call__(self, batch: Batch, rows: Sequence[int]) -> Batch:
        """The batch of these decisions with its objects elsewhere, as chosen by the rows."""
        generator = generator_for("reflection", *map(int, rows))
        changes = torch.rand(3, len(rows), generator=generator) < self.p
        changes = changes & ~self.fixed[torch.as_tensor(list(rows))]
        signs = torch.where(changes[:2], -1.0, 1.0).T
        exchange = changes[2]
        assert batch.view_tokens is not None and batch.actions is not None
        low, high = self.bounds
        half = (high - low) / 2
        actions = batch.actions.clone()
        points = actions[..., self.columns]
        reflected = (reflect_points((points + 1) * half + low, signs, exchange) - low) / half - 1
        # the others stay equal to the last bit
        in_motion = changes.any(0).view(-1, *[1] * (points.ndim - 1))
        actions[..., self.columns] = torch.where(in_motion, reflected, points).to(actions.dtype)
        history = batch.history
        if history is not None:
            history = replace(history, features=reflect(history.features, signs, exchange))
        return replace(
            batch,
            view_tokens=reflect(batch.view_tokens, signs, exchange),
            actions=actions,
            history=history,
        )


class Decisions(Dataset[int]):
    """The decisions of demonstrations as a policy learns them, all in memory: an item is a row, see
    `collate`.

    batch: every decision, or every so many where the robot executes more motions of a chunk than
        one; the tokens of the current images (`Batch.view_tokens`) stand in place of the images.
    tasks: [n]; of which task each is.
    distant: [n] bool; decisions on a motion to another place than the last one's, which are hard
        and few: each is an item `oversample` times.
    noise: spread of what is added whenever a decision is learned, so that few demonstrations are
        learned by heart less: to each number of a remembered token, `VIEW_NOISE` of it to those of
        current images, and `JOINT_NOISE` of it to each joint (radians).
    token_noise: the same for tokens alone, in standard deviations of what each of their numbers is
        over all decisions.
    reflection: puts the objects of all frames of a decision elsewhere whenever it is learned.
    replay: selects the history of a decision anew in each epoch, where transforms change the
        demonstrations' frames.
    balanced: repeat the decisions of tasks that have few, so that all tasks are learned about
        equally often.
    """

    epoch = 0

    def __init__(
        self,
        batch: Batch,
        distant: Tensor,
        tasks: Sequence[str],
        oversample: int = 1,
        noise: float = 0.0,
        token_noise: float = 0.0,
        reflection: "Reflection | None" = None,
        replay: Replay | None = None,
        balanced: bool = False,
    ) -> None:
        self.batch = batch
        self.distant = distant
        self.tasks = tasks
        self.noise = noise
        self.token_noise = token_noise
        self.reflection = reflection
        self.replay = replay
        repeats = torch.where(distant, oversample, 1)
        if balanced:  # all tasks have about as many as the largest
            counts = Counter(tasks)
            largest = max(counts.values())
            repeats = repeats * torch.tensor([round(largest / counts[task]) for task in tasks])
        self._rows = torch.arange(len(batch.prompt)).repeat_interleave(repeats)

    @classmethod
    def of(
        cls,
        policy: MMEPolicy,
        demonstrations: Iterable[tuple[Demonstration, FrameTokens]] | Iterable[Demonstration],
        min_distance: float = MIN_DISTANCE,
        transforms: Sequence[Perturbation] = (),
        seed: int = 0,
        reflect_p: float = 0.0,
        sides: Sequence[str] = (),
        **options: Any,
    ) -> "Decisions":
        """Select what a policy reads at each decision.

        policy: with statistics.
        demonstrations: with the tokens of their frames; alone they are encoded now.
        min_distance: metres from which on a motion leads to another place.
        transforms: of a demonstration's frames, chosen by `seed` and epoch.
        reflect_p, sides: see `Reflection`.
        options: see the class.
        """
        items: list[dict[str, Any]] = []
        distant: list[np.ndarray] = []
        rows: list[tuple[History, int, FrameLabels]] = []
        tasks: list[str] = []
        goals: list[str] = []
        for entry in demonstrations:
            if isinstance(entry, Demonstration):
                demonstration = entry
                tokens = tokenize(policy, entry)
            else:
                demonstration, tokens = entry
            history = _history(policy, demonstration, tokens)
            new = _items(policy, demonstration, history, tokens)
            items += new
            tasks += [demonstration.task] * len(new)
            goals += [demonstration.goal] * len(new)
            if history is not None and transforms:
                labels = _labels(policy.require_memory(), demonstration)
                rows += [(history, frame, labels) for frame in _decisions(policy, demonstration)]
            # Motions that end far above the table from the one before; the first does.
            ends = demonstration.motions.targets[:, :2]
            steps = np.linalg.norm(np.diff(ends, axis=0), axis=1)
            is_distant = np.concatenate([[True], steps > min_distance])
            distant.append(is_distant[:: policy.embodiment.action.execute])
        require(items, "The demonstrations hold no decision to learn from.")
        replay = Replay(policy.require_memory(), rows, transforms, seed) if rows else None
        reflection = Reflection.of(policy, reflect_p, goals, sides)
        stacked = torch.from_numpy(np.concatenate(distant))
        return cls(_stack(items), stacked, tasks, reflection=reflection, replay=replay, **options)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> int:
        return int(self._rows[index])

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch, which transforms depend on."""
        self.epoch = epoch

    def collate(self, rows: Sequence[int]) -> Batch:
        """The batch of these decisions."""
        indices = torch.as_tensor(list(rows))
        batch = self.batch.rows(indices)
        if self.replay is not None:
            batch = replace(batch, history=self.replay.select(rows, self.epoch))
        if self.reflection is not None:
            batch = self.reflection(batch, rows)
        if not (self.noise or self.token_noise):
            return batch

        # Noise is of the rows' numbers alone, so the same everywhere.
        generator = torch.Generator().manual_seed(seed_of("rows", *map(int, rows)))

        def perturbed(values: Tensor, size: float | Tensor) -> Tensor:
            return (values + size * torch.randn(values.shape, generator=generator)).to(values.dtype)

        assert batch.state is not None and batch.view_tokens is not None
        fixed = {"views": VIEW_NOISE * self.noise, "past": self.noise}
        size = {name: fixed[name] + self.token_noise * std for name, std in self._token_std.items()}
        # the last number is the gripper's
        joints = perturbed(batch.state[:, :-1], JOINT_NOISE * self.noise)
        state = torch.cat([joints, batch.state[:, -1:]], 1)
        batch = replace(batch, state=state, view_tokens=perturbed(batch.view_tokens, size["views"]))
        if batch.history is None:
            return batch
        return replace(
            batch,
            history=replace(
                batch.history, features=perturbed(batch.history.features, size["past"])
            ),
        )

    @cached_property
    def _token_std(self) -> dict[str, Tensor]:
        """The standard deviation of each number of a token, of the present images and of those
        remembered.
        """
        assert self.batch.view_tokens is not None
        features = {"views": self.batch.view_tokens}
        if self.batch.history is not None:
            features["past"] = self.batch.history.features[self.batch.history.mask]
        return {name: tokens.float().flatten(0, -2).std(0) for name, tokens in features.items()}


@torch.no_grad()
def _predicted(
    policy: MMEPolicy, val_set: Decisions, rows: Sequence[int], seed: int
) -> tuple[Tensor, Tensor]:
    """The first action of each chunk, as it is predicted and as it should be: [n, w] each,
    absolute.
    """
    generator = torch.Generator().manual_seed(seed)
    processor = policy.require_processor()
    predicted: list[Tensor] = []
    recorded: list[Tensor] = []
    for start in range(0, len(rows), 64):
        batch = val_set.collate(rows[start : start + 64])
        assert batch.actions is not None and batch.state is not None
        noise = draw_noise(policy, len(batch.prompt), generator)
        chunk = policy.sample_actions(batch, noise).float()
        predicted.append(processor.absolute_actions(chunk, batch.state)[:, 0])
        recorded.append(processor.absolute_actions(batch.actions, batch.state)[:, 0])
    return torch.cat(predicted), torch.cat(recorded)


def position_error(policy: MMEPolicy, val_set: Decisions, seed: int = 0) -> Tensor:
    """How far above the table motions to another place end from where they should, the first of
    each chunk; [n] m.
    """
    rows = val_set.distant.nonzero()[:, 0].tolist()
    predicted, recorded = _predicted(policy, val_set, rows, seed)
    return (predicted - recorded)[:, :2].norm(dim=1)


NEAR = 0.05
"""Of the image's side: a point this near lies on the object that it means."""


@dataclass(frozen=True)
class ChoiceErrors:
    """Of held-out choices; distances are in shares of the image's side.

    accuracy: task → share of right letters.
    points: task → share of points within `NEAR`, of tasks that need any.
    off_by: median distance of points; None where none is needed.
    """

    accuracy: dict[str, float]
    points: dict[str, float]
    off_by: float | None


def choice_errors(policy: MMEPolicy, val_set: Decisions, seed: int = 0) -> ChoiceErrors:
    """How often the letter of a decision is right, and how far off its point is."""
    space = policy.embodiment.action
    predicted, recorded = _predicted(policy, val_set, range(len(val_set.tasks)), seed)
    letters = list(space.choice)
    right = (predicted[:, letters].argmax(1) == recorded[:, letters].argmax(1)).numpy()
    tasks = np.array(val_set.tasks)
    points = recorded[:, list(space.point)]
    needed = (points - torch.tensor(MIDDLE)).abs().amax(1) > 1e-6
    off = (predicted[:, list(space.point)] - points)[needed].norm(dim=1)
    near = (off < NEAR).numpy()
    of_points = tasks[needed.numpy()]
    return ChoiceErrors(
        {task: float(right[tasks == task].mean()) for task in dict.fromkeys(tasks.tolist())},
        {task: float(near[of_points == task].mean()) for task in dict.fromkeys(of_points.tolist())},
        float(off.median()) if len(off) else None,
    )


def statistics(demonstrations: Iterable[Demonstration], policy: MMEPolicy) -> NormStats:
    """What states and motions are normalised by; numbers that hardly move keep their size."""
    states, actions = RunningStats(), RunningStats()
    space = policy.embodiment.action
    for demonstration in demonstrations:
        state = torch.from_numpy(demonstration.states[demonstration.motions.decisions])
        states.update(state.numpy())
        targets = torch.from_numpy(demonstration.motions.targets)[:, None]
        actions.update(space.to_relative(targets, state).numpy())
    of_actions = actions.result()
    middle = (of_actions.q01 + of_actions.q99) / 2
    half = np.maximum((of_actions.q99 - of_actions.q01) / 2, NARROWEST)
    widened = replace(of_actions, q01=middle - half, q99=middle + half)
    return NormStats(state=states.result(), actions=widened)


def _items(
    policy: MMEPolicy, demonstration: Demonstration, history: History | None, made: FrameTokens
) -> list[dict[str, Any]]:
    processor = policy.require_processor()
    decisions = _decisions(policy, demonstration)
    cameras = policy.embodiment.camera_names
    view_tokens = torch.stack([made.at(name, decisions) for name in cameras], 1)
    subgoals: Sequence[str | None] = [None] * len(decisions)
    kind = subgoal_kind(policy)
    if kind is not None:
        # As the simulator says them, their points moved a little
        noise = int(PolicySections.of(policy.config).subgoal_text["point_noise"])
        rng = np.random.default_rng(demonstration.seed)
        texts = demonstration.subgoals[kind.removesuffix("_subgoal")]
        moved = [perturb_point(text, noise, rng) for text in texts]
        subgoals = moved[:: policy.embodiment.action.execute]
    items = []
    for place, frame in enumerate(decisions):
        state = demonstration.states[frame]
        chunk, recorded = demonstration.motions.chunk(frame, processor.embodiment.action.horizon)
        prompt, prompt_mask = processor.prompt(
            demonstration.goal, subgoal=subgoals[place], state=state
        )
        item = {
            "view_tokens": view_tokens[place], "prompt": prompt, "prompt_mask": prompt_mask,
            "state": torch.from_numpy(state), "actions": processor.actions(chunk, state),
            "action_mask": torch.from_numpy(recorded),
        }  # fmt: skip
        if history is not None:
            selection = policy.require_memory().gather_selection(history, frame)
            item["history"] = with_labels(
                selection, _labels(policy.require_memory(), demonstration)
            )
        items.append(item)
    return items


def _decisions(policy: MMEPolicy, demonstration: Demonstration) -> list[int]:
    every = policy.embodiment.action.execute
    decisions: list[int] = demonstration.motions.decisions[::every].tolist()
    return decisions


def _history(policy: MMEPolicy, demonstration: Demonstration, made: FrameTokens) -> History | None:
    if policy.memory is None:
        return None
    memory, camera = policy.memory, policy.embodiment.memory_camera
    read = memory.frames_read(np.array(_decisions(policy, demonstration)), demonstration.exec_start)
    frames = np.intersect1d(read, made.frames[camera])
    tokens = pool_grid(made.at(camera, frames).float(), memory.storage.grid, memory.storage.pooling)
    stored = tokens.to(policy.info.history_dtype).float().numpy()
    scores = made.scores.get(memory.storage.scorer)
    history = CachedHistory(
        memory.storage, stored, frames, demonstration.length, scores, demonstration.exec_start
    )
    if memory.uses_proprio:
        # An action is a motion of many frames here, so the states alone tell what was done.
        length = demonstration.length
        nothing = np.zeros((length, policy.embodiment.action.width), np.float32)
        states = demonstration.states[:length]
        unknown = np.zeros(length, bool)
        motion = motion_rows(policy.require_processor(), states, nothing, unknown)
        history.motion = motion.__getitem__
        history.state_width = policy.embodiment.state.width
    return history


def _labels(memory: Memory, demonstration: Demonstration) -> FrameLabels:
    """The labels of sub-tasks and facts that a memory reads."""
    frames = np.arange(demonstration.length)

    def count(begins: np.ndarray) -> np.ndarray:
        return np.searchsorted(begins, frames, side="right").astype(np.float32)

    def is_in(labelled: np.ndarray) -> np.ndarray:
        return np.isin(frames, labelled).astype(np.float32)

    begins = demonstration.boundaries
    known = {SUBTASK: count(begins), BOUNDARY: is_in(begins)}
    if demonstration.facts is not None:
        spans = [fact.frames for fact in demonstration.facts]
        visible = [np.arange(first, last + 1) for first, last in spans]
        known[FACT] = count(np.sort([first for first, _ in spans]))
        known[FACT_VISIBLE] = is_in(np.concatenate([np.empty(0, np.int64), *visible]))
    return {name: known[name] for name in labels_read(memory) if name in known}


def _stack(items: Sequence[dict[str, Any]]) -> Batch:
    def stack(name: str) -> Tensor:
        return torch.stack([item[name] for item in items])

    view_tokens = stack("view_tokens")
    rows, views = view_tokens.shape[:2]
    history = None
    if "history" in items[0]:
        history = stack_history([item["history"] for item in items])
    batch = Batch(
        images=torch.zeros(rows, views, 3, 0, 0, dtype=torch.uint8),
        image_mask=torch.ones(rows, views, dtype=torch.bool),
        prompt=stack("prompt"),
        prompt_mask=stack("prompt_mask"),
        history=history,
        actions=stack("actions"),
        action_mask=stack("action_mask"),
        state=stack("state"),
        view_tokens=view_tokens,
    )
    return batch.without_prompt_padding()
