"""What every processor is asked: images, words, states and actions in the network's form, batches, and back."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError
from mme_vla.memory.base import stack_history
from mme_vla.processing.images import stack_past
from mme_vla.processing.normalise import NormStats, normalize
from mme_vla.registry import PROCESSORS
from mme_vla.types import Batch
from mme_vla.utils import check_sums, inside, read_json

CONFIG_FILE = "processor.json"
STATS_FILE = "norm_stats.json"
DEFAULT = "pi05"
"""The processor of configurations and checkpoints that name none."""


@dataclass(frozen=True)
class Sample:
    """One training step as it is recorded, with the frames before it that the processor asked for.

    views: camera → images [t, H, W, 3] uint8, in the embodiment's order, the current one last. states: [t, s].
    goal: the task in words; subgoal: its current part, where the policy reads one.
    past_actions: [n, w] the robot's own actions right before the chunk. actions: [h, w] the chunk, absolute.
    """

    views: Mapping[str, np.ndarray]
    states: np.ndarray
    goal: str
    subgoal: str | None
    past_actions: np.ndarray
    actions: np.ndarray


@dataclass(frozen=True)
class Counted:
    """What normalisation statistics are made of.

    horizon: chunk steps of each observation that count, relative where the embodiment says so; None for the chunk's.
    every: every execution step once, in the data's order; else in shuffled batches of which an incomplete last one is
        left out, as the released code of π0.5 does.
    extremes: keep the smallest and the largest value too. exact: quantiles of all rows at once, not of their histogram.
    video: the conditioning video's steps count as well.
    """

    horizon: int | None = None
    every: bool = False
    extremes: bool = False
    exact: bool = False
    video: bool = False


class PolicyProcessor:
    """Everything between raw data and one kind of policy's network, saved with every checkpoint.

    Training, evaluation and serving share one such object, so they cannot differ. A subclass registers in `PROCESSORS`,
    sets `embodiment` (then `stats`), and implements what raises NotImplementedError.
    """

    embodiment: Embodiment
    window: int = 1
    """Frames an observation consists of, the current one last; clamped at the episode's start."""
    full_chunks_only: bool = False
    """Whether steps with fewer recorded actions ahead of them than a chunk has are left out of training."""
    group_size: int = 1
    """Steps of one episode that a training sample holds: more than 1 for policies that are trained on sequences."""
    consecutive: bool = True
    """Whether the frames of the window follow each other in an episode; else they are those at which it was asked."""
    prompt_name: str = "plain"
    """How the goal becomes words, for messages."""
    counted: Counted = Counted()
    samples: str = "steps"
    """What a training sample is: `steps` of an execution, or `keyframes` with depth."""
    _stats: NormStats | None = None

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> Self:
        """Build the processor of a composed configuration, at its backbone's sizes."""
        raise NotImplementedError

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras whose images an item is made of, in the embodiment's order."""
        return self.embodiment.camera_names

    @property
    def reads_subgoal(self) -> bool:
        """Whether the words of an observation hold a subgoal."""
        return False

    @property
    def past_actions(self) -> int:
        """Executed actions that the words of an observation hold."""
        return 0

    @property
    def horizon(self) -> int:
        """h; steps in a chunk."""
        return self.embodiment.action.horizon

    @property
    def stats(self) -> NormStats | None:
        """Normalisation statistics; may be set once the data are known."""
        return self._stats

    @stats.setter
    def stats(self, stats: NormStats | None) -> None:
        robot = self.embodiment
        if stats is not None and (len(stats.state), len(stats.actions)) != (robot.state.width, robot.action.width):
            raise UserError(
                f"Statistics of {len(stats.state)}-number states and {len(stats.actions)}-number actions are not those "
                f"of {robot.name!r}, which has {robot.state.width} and {robot.action.width}: give this robot's."
            )
        self._stats = stats

    def require_stats(self) -> NormStats:
        """Return the statistics, or say where they come from."""
        if self._stats is None:
            raise UserError(
                "States and actions need normalisation statistics, and this processor has none. Training computes them "
                "from its data; otherwise set processor.stats to a norm_stats.json (one is in every checkpoint)."
            )
        return self._stats

    # Observations

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """Images of all cameras in the embodiment's order, [H, W, 3] or [n, H, W, 3] each, as the network takes them.

        Returns:
            uint8 [v, 3, s, s'], or [n, v, 3, s, s'].
        """
        raise NotImplementedError

    def memory_images(self, frames: np.ndarray | Tensor, device: torch.device | str | None = None) -> Tensor:
        """Memory frames [n, H, W, 3] uint8 as the vision tower takes them, on `device` if one is given."""
        raise NotImplementedError

    def prompt(
        self,
        goal: str,
        subgoal: str | None = None,
        state: np.ndarray | Tensor | None = None,
        past_actions: np.ndarray | Tensor | None = None,
    ) -> Any:
        """What the network reads of the words, in a form of the processor's own, without a batch axis."""
        raise NotImplementedError

    @property
    def words_from(self) -> str:
        """What turns words into numbers, for reports."""
        raise NotImplementedError

    @property
    def memory_image_format(self) -> str:
        """What a setting lets memory images go through besides, which a cache of their tokens depends on."""
        return ""

    @property
    def words_fingerprint(self) -> str | None:
        """Equal for two processors exactly if words mean the same numbers to both; None where that needs no check."""
        return None

    # Actions

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        """Recorded actions [h, w] at a raw state [s] as the network should answer."""
        raise NotImplementedError

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        """The network's answer [..., h, a] at raw states [..., s] as actions [..., h, w] that the robot takes."""
        raise NotImplementedError

    def motion(self, states: np.ndarray, actions: np.ndarray, known: np.ndarray) -> Tensor:
        """What a memory of the robot's own motion reads of t frames: [t, s + w + 1] float32.

        Args:
            states: [t, s] raw. actions: [t, w] absolute, each the one that led to its frame. known: bool [t], False
                where none of the robot's own did; what is in `actions` there does not matter.

        Returns:
            [state | action relative to it | known], normalised; actions are 0 where they are not known.
        """
        stats = self.require_stats()
        proprio = torch.from_numpy(np.asarray(states, np.float32))
        done = torch.from_numpy(np.asarray(actions, np.float32))
        is_known = torch.from_numpy(np.asarray(known, np.float32))[:, None]
        relative = self.embodiment.action.to_relative(done[:, None], proprio)[:, 0]
        return torch.cat([normalize(proprio, stats.state), normalize(relative, stats.actions) * is_known, is_known], 1)

    # Batches

    def item(self, sample: Sample) -> dict[str, Any]:
        """One training step without a batch axis, for `collate`."""
        raise NotImplementedError

    def keyframe_item(self, sample: Any) -> dict[str, Any]:
        """The same of a run of keyframes with depth (`mme_vla.data.keyframes`), where samples are such."""
        raise NotImplementedError

    def collate(self, items: Sequence[dict[str, Any]]) -> Any:
        """Items as the batch that the policy reads: an object with `to`.

        An item may also hold `history` (a memory's selection) and `action_mask` [h], which the dataset adds.
        """
        raise NotImplementedError

    # Folders

    def to_config(self) -> dict[str, Any]:
        """Describe this processor as `processor.json` does; file names are relative to the folder `save` wrote."""
        raise NotImplementedError

    def save(self, folder: Path | str) -> list[str]:
        """Write `processor.json` and the statistics; the names of the files."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CONFIG_FILE).write_text(json.dumps(self.to_config(), indent=2) + "\n")
        if self.stats is None:
            return [CONFIG_FILE]
        self.stats.save(folder / STATS_FILE)
        return [CONFIG_FILE, STATS_FILE]

    @classmethod
    def load(cls, folder: Path | str, tokenizer: Path | str | None = None) -> Self:
        """Read what `save` wrote; nothing outside of the folder is read on its word.

        Args:
            folder: of a checkpoint, which may be an untrusted.
            tokenizer: in place of the one that `processor.json` names.
        """
        raise NotImplementedError


def read_settings(folder: Path) -> dict[str, Any]:
    """What `processor.json` of a checkpoint says."""
    if not (folder / CONFIG_FILE).is_file():
        raise UserError(f"No {CONFIG_FILE} in {folder}: this is not a checkpoint of this library.")
    check_sums(folder, [CONFIG_FILE])
    settings: dict[str, Any] = read_json(inside(folder, CONFIG_FILE), "a processor's settings", limit=2**20)
    return settings


def load_processor(folder: Path | str, tokenizer: Path | str | None = None) -> PolicyProcessor:
    """Read the processor of a checkpoint, of whatever kind."""
    folder = Path(folder)
    kind: type[PolicyProcessor] = PROCESSORS[read_settings(folder).get("name", DEFAULT)]
    return kind.load(folder, tokenizer)


def collate(items: Sequence[dict[str, Any]]) -> Batch:
    """Stack items of one dataset into a `Batch`, without the prompt padding that none of them uses."""

    def stack(name: str) -> Tensor:
        return torch.stack([item[name] for item in items])

    images = stack("images")
    batch = Batch(
        images=images,
        image_mask=torch.ones(images.shape[:2], dtype=torch.bool),
        prompt=stack("prompt"),
        prompt_mask=stack("prompt_mask"),
        history=stack_history([item["history"] for item in items]) if "history" in items[0] else None,
        actions=stack("actions"),
        action_mask=stack("action_mask") if "action_mask" in items[0] else None,
        state=stack("state"),
        past=stack_past([item.get("past") for item in items]),
    )
    return batch.without_prompt_padding()


def pad_width(x: Tensor, width: int) -> Tensor:
    """Append zeros to the last dimension until it is `width` long."""
    return functional.pad(x, (0, width - x.shape[-1]))
