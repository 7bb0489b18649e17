"""`PolicyProcessor`: the interface between raw data and one kind of network."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, brief, require
from mme_vla.memory.base import stack_history
from mme_vla.processing.images import stack_past
from mme_vla.processing.normalise import NormStats, normalize
from mme_vla.registry import PROCESSORS
from mme_vla.types import Batch
from mme_vla.utils import checked_file, read_json

CONFIG_FILE = "processor.json"
STATS_FILE = "norm_stats.json"
DEFAULT = "pi05"
"""The processor of configurations and checkpoints that name none."""


@dataclass(frozen=True)
class Sample:
    """One training step as it is recorded, with the frames of the window before it.

    views: camera → images [t, H, W, 3] uint8, in the embodiment's order, the current one last.
    states: [t, s].
    goal: the task in words.
    subgoal: its current part, where the policy reads one.
    past_actions: [n, w] the robot's own actions right before the chunk.
    actions: [h, w] the chunk, absolute.
    """

    views: Mapping[str, np.ndarray]
    states: np.ndarray
    goal: str
    subgoal: str | None
    past_actions: np.ndarray
    actions: np.ndarray


@dataclass(frozen=True)
class SampleSpec:
    """What a training sample and an observation consist of.

    kind: `steps` of an execution, or a name in `TRAINING_SETS`.
    window: frames of an observation, the current one last; before the episode's start its first
        frame is repeated.
    consecutive: the frames of the window follow each other; else they are those at which the policy
        acted.
    full_chunks_only: leave out steps with fewer recorded actions ahead than a chunk has.
    cameras: whose images an item holds, in the embodiment's order; None for all.
    history: from a step to the frames of the memory camera that an item holds, the current one
        last; the other cameras then have the current image alone. None for the window of all
        cameras.
    """

    kind: str = "steps"
    window: int = 1
    consecutive: bool = True
    full_chunks_only: bool = False
    cameras: tuple[str, ...] | None = None
    history: Callable[[int], np.ndarray] | None = None


@dataclass(frozen=True)
class PromptSpec:
    """What a processor's prompts consist of.

    encoder: what turns text into numbers, for reports.
    name: of the prompt format, for messages.
    reads_subgoal: whether the prompt has a subgoal.
    past_actions: executed actions in it.
    fingerprint: equal for two processors only if text means the same numbers to both; None if that
        needs no check.
    """

    encoder: str
    name: str = "plain"
    reads_subgoal: bool = False
    past_actions: int = 0
    fingerprint: str | None = None


@dataclass(frozen=True)
class StatsSpec:
    """What normalisation statistics are computed from.

    horizon: chunk steps of each observation, relative if the embodiment says so; None for the full
        chunk.
    every: every execution step once, in the data's order; else shuffled batches without an
        incomplete last one, as the released code of π0.5 does.
    extremes: keep the smallest and largest values too.
    exact: quantiles of all rows, not of a histogram.
    bounds: what becomes −1 and 1, `quantiles` or `extremes`.
    video: include the steps of the conditioning video.
    """

    horizon: int | None = None
    every: bool = False
    extremes: bool = False
    bounds: str = "quantiles"
    exact: bool = False
    video: bool = False


class PolicyProcessor:
    """Everything between raw data and one kind of network, saved with every checkpoint.

    Training, evaluation and serving share it. A subclass registers in `PROCESSORS`, sets
    `embodiment` (then `stats`), and implements what raises NotImplementedError.
    """

    embodiment: Embodiment
    samples: SampleSpec = SampleSpec()
    stats_spec: StatsSpec = StatsSpec()
    _stats: NormStats | None = None

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> Self:
        """Build the processor of a composed configuration, at its backbone's sizes."""
        raise NotImplementedError

    @property
    def stats(self) -> NormStats | None:
        """Normalisation statistics; may be set once the data are known."""
        return self._stats

    @stats.setter
    def stats(self, stats: NormStats | None) -> None:
        robot = self.embodiment
        if stats is not None:
            require(
                isinstance(stats, NormStats),
                f"processor.stats={brief(stats)} must be a NormStats: NormStats.load(path) of"
                " mme_vla.processing reads a norm_stats.json.",
            )
            widths = len(stats.state), len(stats.actions)
            require(
                widths == (robot.state.width, robot.action.width),
                f"Statistics of {widths[0]}-number states and {widths[1]}-number actions are not"
                f" those of {robot.name!r}, which has {robot.state.width} and {robot.action.width}:"
                " give this robot's.",
            )
        self._stats = stats

    def require_stats(self) -> NormStats:
        """Return the statistics, or raise a `UserError`."""
        if self._stats is None:
            raise UserError(
                "States and actions need normalisation statistics, and this processor has none."
                " Training computes them from its data, and every checkpoint holds them. In Python:"
                " policy.processor.stats = NormStats.load('<checkpoint>/norm_stats.json'), of"
                " mme_vla.processing."
            )
        return self._stats

    # Observations

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """Images of all cameras in the embodiment's order, [H, W, 3] or [n, H, W, 3] each, as the
        network takes them.

        Returns:
            uint8 [v, 3, s, s'], or [n, v, 3, s, s'].
        """
        raise NotImplementedError

    def memory_images(
        self, frames: np.ndarray | Tensor, device: torch.device | str | None = None
    ) -> Tensor:
        """Resize memory frames [n, H, W, 3] uint8 for the vision tower, on `device` if one is
        given. Needed only by networks whose memory stores vision tokens.
        """
        raise NotImplementedError

    @property
    def prompt_spec(self) -> PromptSpec:
        """What the prompts consist of."""
        raise NotImplementedError

    def prompt(
        self,
        goal: str,
        subgoal: str | None = None,
        state: np.ndarray | Tensor | None = None,
        past_actions: np.ndarray | Tensor | None = None,
    ) -> Any:
        """Encode the text as the network reads it, without a batch axis."""
        raise NotImplementedError

    # Actions

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        """Recorded actions [h, w] at a raw state [s] as targets of the network."""
        raise NotImplementedError

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        """The network's chunk [..., h, a] at raw states [..., s] as actions [..., h, w] that the
        robot executes.
        """
        raise NotImplementedError

    # Batches

    def item(self, sample: Any) -> dict[str, Any]:
        """One training sample without a batch axis, for `collate`: of a `Sample`, or of a run of
        keyframes.
        """
        raise NotImplementedError

    def collate(self, items: Sequence[dict[str, Any]]) -> Any:
        """Items as the batch that the policy reads: an object with `to`.

        An item may also hold `history` (a memory's selection), `action_mask` [h], `weight` [] and
        `labels` (by name), which the dataset adds.
        """
        raise NotImplementedError

    # Folders

    def to_config(self) -> dict[str, Any]:
        """Describe this processor as `processor.json` does; file names are relative to the folder
        `save` wrote.
        """
        raise NotImplementedError

    def save(self, folder: Path | str) -> list[str]:
        """Write `processor.json` and the statistics; the names of the files."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CONFIG_FILE).write_text(
            json.dumps(self.to_config(), indent=2) + "\n", encoding="utf-8"
        )
        if self.stats is None:
            return [CONFIG_FILE]
        self.stats.save(folder / STATS_FILE)
        return [CONFIG_FILE, STATS_FILE]

    @classmethod
    def load(cls, folder: Path | str, tokenizer: Path | str | None = None) -> Self:
        """Read what `save` wrote; nothing outside of the folder is read on its word.

        Args:
            folder: of a checkpoint, which may be untrusted.
            tokenizer: in place of the one that `processor.json` names.
        """
        raise NotImplementedError


def motion_rows(
    processor: PolicyProcessor, states: np.ndarray, actions: np.ndarray, known: np.ndarray
) -> Tensor:
    """What a memory of the robot's own motion reads of t frames: [t, s + w + 1] float32.

    Args:
        states: [t, s] raw.
        actions: [t, w] absolute, each the one that led to its frame.
        known: bool [t], False where no action of the robot led to the frame; the values in
            `actions` are ignored there.

    Returns:
        [state | action relative to it | known], normalised; actions are 0 where they are not known.
    """
    stats = processor.require_stats()
    proprio = torch.from_numpy(np.asarray(states, np.float32))
    done = torch.from_numpy(np.asarray(actions, np.float32))
    is_known = torch.from_numpy(np.asarray(known, np.float32))[:, None]
    relative = processor.embodiment.action.to_relative(done[:, None], proprio)[:, 0]
    state = normalize(proprio, stats.state)
    action = normalize(relative, stats.actions) * is_known
    return torch.cat([state, action, is_known], 1)


def read_settings(folder: Path) -> dict[str, Any]:
    """Read `processor.json` of a checkpoint."""
    require(
        (folder / CONFIG_FILE).is_file(),
        f"No {CONFIG_FILE} in {folder}: this is not a checkpoint of this library.",
    )
    settings: dict[str, Any] = read_json(
        checked_file(folder, CONFIG_FILE), "a processor's settings", limit=2**20
    )
    return settings


def load_processor(folder: Path | str, tokenizer: Path | str | None = None) -> PolicyProcessor:
    """Read the processor of a checkpoint, of whatever kind."""
    folder = Path(folder)
    kind: type[PolicyProcessor] = PROCESSORS[read_settings(folder).get("name", DEFAULT)]
    return kind.load(folder, tokenizer)


def collate(items: Sequence[dict[str, Any]]) -> Batch:
    """Stack items of one dataset into a `Batch`, without the prompt padding that none
    of them uses.
    """

    def stack(name: str) -> Tensor:
        return torch.stack([item[name] for item in items])

    images = stack("images")
    batch = Batch(
        images=images,
        image_mask=torch.ones(images.shape[:2], dtype=torch.bool),
        prompt=stack("prompt"),
        prompt_mask=stack("prompt_mask"),
        actions=stack("actions"),
        state=stack("state"),
        past=stack_past([item.get("past") for item in items]),
    )
    # What the dataset adds, all items or none.
    if "history" in items[0]:
        batch.history = stack_history([item["history"] for item in items])
    if "action_mask" in items[0]:
        batch.action_mask = stack("action_mask")
    if "weight" in items[0]:
        batch.weight = stack("weight")
    for name in items[0].get("labels", ()):
        batch.labels[name] = torch.stack([item["labels"][name] for item in items])
    return batch.without_prompt_padding()


def pad_width(x: Tensor, width: int) -> Tensor:
    """Append zeros to the last dimension until it is `width` long."""
    return functional.pad(x, (0, width - x.shape[-1]))
