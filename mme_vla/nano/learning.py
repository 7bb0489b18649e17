"""Training on demonstrations of planned motions: every decision is a sample, and its tokens are computed beforehand."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from mme_vla.errors import require
from mme_vla.memory.base import Memory, make_scorer, stack_history, uses_proprio
from mme_vla.memory.history import FrameScores, History, StorageSpec
from mme_vla.memory.transforms import HistoryTransform, TransformedHistory, map_frames
from mme_vla.nano.demonstrations import Demonstration
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.base import motion_rows
from mme_vla.processing.normalise import NormStats, QuantileStats, RunningStats
from mme_vla.processing.prompt import perturb_point, subgoal_kind
from mme_vla.types import Batch, HistoryTokens, stack_noise
from mme_vla.utils import write_atomically

NARROWEST = 0.1  # of an action's number, in metres or radians: less than that is jitter, and is not blown up


_PAST = "history."
JOINT_NOISE = 0.05
MIN_DISTANCE = 0.05  # Metres above the table from where on a motion is one to another place


class SparseHistory(History):
    """The tokens of some of an episode's frames; any other frame is refused.

    tokens: frame → [patches, d_vision].
    """

    def __init__(
        self,
        spec: StorageSpec,
        length: int,
        tokens: Mapping[int, Tensor],
        exec_start: int,
        scores: FrameScores | None = None,
    ) -> None:
        super().__init__(spec, exec_start)
        self._scores = FrameScores.empty(spec.grid**2) if scores is None else scores
        self._length, self._frames = length, np.array(sorted(tokens), np.int64)
        self._tokens = torch.stack([tokens[int(frame)] for frame in self._frames])

    def __len__(self) -> int:
        return self._length

    @property
    def scores(self) -> FrameScores:
        return self._scores

    @property
    def stored_frames(self) -> np.ndarray:
        return self._frames

    def gather(self, indices: np.ndarray) -> Tensor:
        rows = self._row_of(indices[:, 0], self._frames)
        return self._tokens[torch.as_tensor(rows), torch.as_tensor(indices[:, 1])]


@dataclass(frozen=True)
class Replay:
    """What a memory selects from in a demonstration whose frames are transformed, anew in each epoch.

    rows: for each decision its history and its frame.
    """

    memory: Memory
    rows: Sequence[tuple[History, int]]
    transforms: Sequence[HistoryTransform]
    seed: int

    def select(self, rows: Sequence[int], epoch: int) -> HistoryTokens:
        """The selections of these decisions, each a function of (seed, epoch, row)."""
        items = []
        for row in rows:
            history, frame = self.rows[row]
            rng = np.random.default_rng([self.seed, epoch, row])
            visible = map_frames(self.transforms, frame + 1, history.exec_start, rng, keep=[frame])
            now = int(visible.transformed(np.array(frame)))
            items.append(self.memory.gather_selection(TransformedHistory(history, visible), now))
        return stack_history(items)


class Decisions(Dataset[int]):
    """The decisions of demonstrations as a policy learns them, all in memory: an item is a row, see `collate`.

    batch: every decision, or every so many where the robot executes more motions of a chunk than one; the tokens of
        the current images (`Batch.view_tokens`) stand in place of the images.
    distant: [n] bool; decisions on a motion to another place than the last one's, which are hard and few: each is
        an item `oversample` times.
    noise: spread of what is added whenever a decision is learned, so that few demonstrations are learned by heart less:
        to each number of a token and, `JOINT_NOISE` of it, to each joint (radians).
    token_noise: the same for tokens alone, in standard deviations of what each of their numbers is over all decisions.
    replay: selects the history of a decision anew in each epoch, where transforms change the demonstrations' frames.
    """

    epoch = 0

    def __init__(
        self,
        batch: Batch,
        distant: Tensor,
        oversample: int = 1,
        noise: float = 0.0,
        token_noise: float = 0.0,
        replay: Replay | None = None,
    ) -> None:
        self.replay = replay
        self.batch, self.distant, self.noise, self.token_noise = batch, distant, noise, token_noise
        self._rows = torch.arange(len(batch.prompt)).repeat_interleave(torch.where(distant, oversample, 1))

    @classmethod
    def of(
        cls,
        policy: MMEPolicy,
        demonstrations: Iterable[Demonstration],
        oversample: int = 1,
        min_distance: float = MIN_DISTANCE,
        noise: float = 0.0,
        token_noise: float = 0.0,
        transforms: Sequence[HistoryTransform] = (),
        seed: int = 0,
    ) -> "Decisions":
        """Make all tokens, of one demonstration after the other: their images together are gigabytes.

        policy: with the vision weights it trains with, and statistics. min_distance: metres from which on a motion
        leads to another place. transforms: of a demonstration's frames, chosen by `seed` and epoch. The others: see the
        class.
        """
        items: list[dict[str, Any]] = []
        distant: list[np.ndarray] = []
        rows: list[tuple[History, int]] = []
        for demonstration in demonstrations:
            history = _history(policy, demonstration)
            items += _items(policy, demonstration, history)
            if history is not None and transforms:
                rows += [(history, frame) for frame in _decisions(policy, demonstration)]
            distant.append(_distant(demonstration.motions.targets, min_distance)[:: policy.embodiment.action.execute])
        require(items, "The demonstrations hold no decision to learn from.")
        replay = Replay(policy.require_memory(), rows, transforms, seed) if rows else None
        return cls(_stack(items), torch.from_numpy(np.concatenate(distant)), oversample, noise, token_noise, replay)

    @classmethod
    def load(cls, path: Path, oversample: int = 1, noise: float = 0.0, token_noise: float = 0.0) -> "Decisions":
        """Read what `save` wrote."""
        from safetensors.torch import load_file

        tensors = load_file(path)
        distant = tensors.pop("far")
        names = [name for name in tensors if name.startswith(_PAST)]
        past: dict[str, Any] = {name.removeprefix(_PAST): tensors[name] for name in names}
        now: dict[str, Any] = {name: value for name, value in tensors.items() if not name.startswith(_PAST)}
        batch = Batch(**now, history=HistoryTokens(**past) if past else None)
        return cls(batch, distant, oversample, noise, token_noise)

    def save(self, path: Path) -> None:
        """Write one file of tensors, whole or not at all."""
        from safetensors.torch import save_file

        values = {name: value for name, value in vars(self.batch).items() if isinstance(value, Tensor)}
        values["far"] = self.distant
        if self.batch.history is not None:
            past = vars(self.batch.history).items()
            values |= {f"{_PAST}{name}": value for name, value in past if isinstance(value, Tensor)}
        with write_atomically(path) as draft:
            save_file({name: value.contiguous() for name, value in values.items()}, draft)

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
        return self._noisy(batch, rows) if self.noise or self.token_noise else batch

    def _noisy(self, batch: Batch, rows: Sequence[int]) -> Batch:
        generator = torch.Generator().manual_seed(hash(tuple(rows)))  # of numbers alone, so the same everywhere

        def perturbed(values: Tensor, size: float | Tensor) -> Tensor:
            return (values + size * torch.randn(values.shape, generator=generator)).to(values.dtype)

        assert batch.state is not None and batch.view_tokens is not None
        size = {name: self.noise + self.token_noise * std for name, std in self._token_std.items()}
        joints = perturbed(
            batch.state[:, :-1], JOINT_NOISE * self.noise
        )  # the last number is the gripper's, centimetres
        state = torch.cat([joints, batch.state[:, -1:]], 1)
        batch = replace(batch, state=state, view_tokens=perturbed(batch.view_tokens, size["views"]))
        if batch.history is None:
            return batch
        return replace(batch, history=replace(batch.history, features=perturbed(batch.history.features, size["past"])))

    @cached_property
    def _token_std(self) -> dict[str, Tensor]:
        """The standard deviation of each number of a token, of the present images and of those remembered."""
        features = {"views": self.batch.view_tokens, "past": None}
        if self.batch.history is not None:
            features["past"] = self.batch.history.features[self.batch.history.mask]
        return {name: t.float().flatten(0, -2).std(0) for name, t in features.items() if t is not None}


def _distant(targets: np.ndarray, min_distance: float) -> np.ndarray:
    """Which of an episode's motions [m, 7] end that far above the table from the one before; the first does. [m]."""
    steps = np.linalg.norm(np.diff(targets[:, :2], axis=0), axis=1)
    return np.concatenate([[True], steps > min_distance])


@torch.no_grad()
def position_error(policy: MMEPolicy, val_set: Decisions, seed: int = 0) -> Tensor:
    """How far above the table motions to another place end from where they should, the first of each chunk; [n] m."""
    rows = val_set.distant.nonzero()[:, 0].tolist()
    batch, generator = val_set.collate(rows), torch.Generator().manual_seed(seed)
    assert batch.actions is not None and batch.state is not None
    chunk = policy.sample_actions(batch, stack_noise([policy.sampling_noise(generator) for _ in rows])).float()
    processor = policy.require_processor()
    predicted = processor.absolute_actions(chunk, batch.state)
    return (predicted - processor.absolute_actions(batch.actions, batch.state))[:, 0, :2].norm(dim=1)


def statistics(demonstrations: Iterable[Demonstration], policy: MMEPolicy) -> NormStats:
    """What states and motions are normalised by; numbers that hardly move keep their size."""
    states, actions = RunningStats(), RunningStats()
    space = policy.embodiment.action
    for demonstration in demonstrations:
        state = torch.from_numpy(demonstration.states[demonstration.motions.decisions])
        states.update(state.numpy())
        targets = torch.from_numpy(demonstration.motions.targets)[:, None]
        actions.update(space.to_relative(targets, state).numpy())
    return NormStats(state=states.result(), actions=_widened(actions.result()))


def _widened(stats: QuantileStats) -> QuantileStats:
    middle, half = (stats.q01 + stats.q99) / 2, np.maximum((stats.q99 - stats.q01) / 2, NARROWEST)
    return replace(stats, q01=middle - half, q99=middle + half)


@torch.no_grad()
def _items(policy: MMEPolicy, demonstration: Demonstration, history: History | None) -> list[dict[str, Any]]:
    processor, cameras = policy.require_processor(), policy.embodiment.camera_names
    decisions = _decisions(policy, demonstration)
    views = processor.images([np.stack([demonstration.images[name][frame] for frame in decisions]) for name in cameras])
    flat = views.flatten(0, 1).float() / 255 * 2 - 1
    view_tokens = policy.backbone.encode_images(flat).unflatten(0, (len(decisions), -1))
    subgoals = _subgoals(policy, demonstration)[:: policy.embodiment.action.execute]
    items = []
    for place, frame in enumerate(decisions):
        state = demonstration.states[frame]
        chunk, recorded = demonstration.motions.chunk(frame, processor.embodiment.action.horizon)
        prompt, prompt_mask = processor.prompt(demonstration.goal, subgoal=subgoals[place], state=state)
        item = {
            "view_tokens": view_tokens[place], "prompt": prompt, "prompt_mask": prompt_mask,
            "state": torch.from_numpy(state), "actions": processor.actions(chunk, state),
            "action_mask": torch.from_numpy(recorded),
        }  # fmt: skip
        if history is not None:
            item["history"] = policy.require_memory().gather_selection(history, frame)
        items.append(item)
    return items


def _decisions(policy: MMEPolicy, demonstration: Demonstration) -> list[int]:
    return [int(frame) for frame in demonstration.motions.decisions[:: policy.embodiment.action.execute]]


@torch.no_grad()
def _history(policy: MMEPolicy, demonstration: Demonstration) -> History | None:
    if policy.memory is None:
        return None
    images = demonstration.images[policy.embodiment.memory_camera]
    decisions = demonstration.motions.decisions[:: policy.embodiment.action.execute]
    read = policy.frames_read(decisions, demonstration.exec_start).tolist()
    taken = {frame: images[frame] for frame in read if frame in images} or images
    tokens = policy.encode_frames(np.stack(list(taken.values())))
    history = SparseHistory(
        policy.memory.storage, demonstration.length, dict(zip(taken, tokens, strict=True)), demonstration.exec_start,
        _scores(policy.memory, taken),
    )  # fmt: skip
    if uses_proprio(policy.memory):  # an action is a motion of many frames here, so the states alone tell what was done
        nothing = np.zeros((demonstration.length, policy.embodiment.action.width), np.float32)
        motion = motion_rows(
            policy.require_processor(),
            demonstration.states[: demonstration.length],
            nothing,
            np.zeros(demonstration.length, bool),
        )
        history.motion, history.state_width = motion.__getitem__, policy.embodiment.state.width
    return history


def _scores(memory: Memory, images: Mapping[int, np.ndarray]) -> FrameScores:
    """The scores of these frames by the memory's scorer, as in an episode."""
    scorer = make_scorer(memory)
    scores = {} if scorer is None else {frame: scorer(frame, images[frame]) for frame in sorted(images)}
    rows = {frame: values for frame, values in scores.items() if values is not None}
    if not rows:
        return FrameScores.empty(memory.storage.grid**2)
    return FrameScores(np.array(list(rows), np.int64), np.stack(list(rows.values())))


def _subgoals(policy: MMEPolicy, demonstration: Demonstration) -> Sequence[str | None]:
    """The subgoal of each decision as the simulator says it, its point moved a little; None where none is read."""
    kind = subgoal_kind(policy)
    if kind is None:
        return [None] * len(demonstration.motions.decisions)
    noise, rng = int(policy.config["subgoal_text"]["point_noise"]), np.random.default_rng(demonstration.seed)
    return [perturb_point(text, noise, rng) for text in demonstration.subgoals[kind.removesuffix("_subgoal")]]


def _stack(items: Sequence[dict[str, Any]]) -> Batch:
    def stack(name: str) -> Tensor:
        return torch.stack([item[name] for item in items])

    view_tokens = stack("view_tokens")
    rows, views = view_tokens.shape[:2]
    batch = Batch(
        images=torch.zeros(rows, views, 3, 0, 0, dtype=torch.uint8),
        image_mask=torch.ones(rows, views, dtype=torch.bool),
        prompt=stack("prompt"),
        prompt_mask=stack("prompt_mask"),
        history=stack_history([item["history"] for item in items]) if "history" in items[0] else None,
        actions=stack("actions"),
        action_mask=stack("action_mask"),
        state=stack("state"),
        view_tokens=view_tokens,
    )
    return batch.without_prompt_padding()
