"""Training on demonstrations of planned motions: every decision is a sample, and all its tokens are made beforehand."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from mme_vla.errors import UserError
from mme_vla.memory.base import stack_history
from mme_vla.memory.history import History, StorageSpec
from mme_vla.nano.demonstrations import Demonstration
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.normalisers import NormStats, QuantileStats, RunningStats
from mme_vla.types import Batch

NARROWEST = 0.1  # of an action's number, in metres or radians: less than that is jitter, and is not blown up


class SparseHistory(History):
    """The tokens of some of an episode's frames; any other frame is refused.

    tokens: frame → [patches, d_vision].
    """

    def __init__(self, spec: StorageSpec, length: int, tokens: Mapping[int, Tensor], exec_start: int) -> None:
        super().__init__(spec, exec_start)
        self._length, self._kept = length, np.array(sorted(tokens), np.int64)
        self._tokens = torch.stack([tokens[int(frame)] for frame in self._kept])

    def __len__(self) -> int:
        return self._length

    def gather(self, indices: np.ndarray) -> Tensor:
        rows = self._row_of(indices[:, 0], self._kept)
        return self._tokens[torch.as_tensor(rows), torch.as_tensor(indices[:, 1])]


class Decisions(Dataset[dict[str, Any]]):
    """The decisions of demonstrations as a policy learns them; everything is in memory.

    Items hold the tokens of the current pictures (`Batch.view_tokens`) in place of the pictures.
    """

    def __init__(self, policy: MMEPolicy, demonstrations: Sequence[Demonstration]) -> None:
        """Make all tokens.

        Args:
            policy: with the vision weights it trains with, and statistics.

        Raises:
            UserError: there is no decision, or a frame that the memory remembers was not drawn.
        """
        self._items = [item for found in demonstrations for item in _items(policy, found)]
        if not self._items:
            raise UserError("The demonstrations hold no decision to learn from.")

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self._items[index]


def load_all(files: Sequence[Path]) -> list[Demonstration]:
    """Recorded demonstrations, in this order."""
    return [Demonstration.load(file) for file in files]


def statistics(demonstrations: Sequence[Demonstration], policy: MMEPolicy) -> NormStats:
    """What states and motions are normalised by; numbers that hardly move keep their size.

    Raises:
        UserError: fewer than two decisions.
    """
    states, actions = RunningStats(), RunningStats()
    space = policy.embodiment.action
    for found in demonstrations:
        state = torch.from_numpy(found.states[found.motions.decisions])
        states.update(state.numpy())
        targets = torch.from_numpy(found.motions.targets)[:, None]
        actions.update(space.to_relative(targets, state).numpy())
    return NormStats(state=states.result(), actions=_widened(actions.result()))


def _widened(stats: QuantileStats) -> QuantileStats:
    middle, half = (stats.q01 + stats.q99) / 2, np.maximum((stats.q99 - stats.q01) / 2, NARROWEST)
    return replace(stats, q01=middle - half, q99=middle + half)


@torch.no_grad()
def _items(policy: MMEPolicy, found: Demonstration) -> list[dict[str, Any]]:
    processor, cameras = policy.require_processor(), policy.embodiment.camera_names
    decisions = [int(frame) for frame in found.motions.decisions]
    views = processor.images([np.stack([found.pictures[name][frame] for frame in decisions]) for name in cameras])
    flat = views.flatten(0, 1).float() / 255 * 2 - 1
    view_tokens = policy.backbone.encode_images(flat).unflatten(0, (len(decisions), -1))
    history = _history(policy, found)
    items = []
    for place, frame in enumerate(decisions):
        state = found.states[frame]
        chunk, recorded = found.motions.chunk(frame, processor.horizon)
        prompt, prompt_mask = processor.prompt(found.goal, state=state)
        item = {
            "view_tokens": view_tokens[place], "prompt": prompt, "prompt_mask": prompt_mask,
            "state": torch.from_numpy(state), "actions": processor.actions(chunk, state),
            "action_mask": torch.from_numpy(recorded),
        }  # fmt: skip
        if history is not None:
            item["history"] = policy.require_memory().recall(history, frame)
        items.append(item)
    return items


def _history(policy: MMEPolicy, found: Demonstration) -> History | None:
    if policy.memory is None:
        return None
    taken = found.pictures[policy.embodiment.memory_camera]
    tokens = policy.encode_frames(np.stack(list(taken.values())))
    return SparseHistory(
        policy.memory.storage, found.length, dict(zip(taken, tokens, strict=True)), found.exec_start
    )  # fmt: skip


def collate(items: Sequence[dict[str, Any]]) -> Batch:
    """Stack items into a `Batch` whose pictures are tokens already."""

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
