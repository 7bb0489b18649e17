"""What stands between raw data and MemoryVLA: one camera, words that end, clipped quantiles, groups
of one episode.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.config.sections import PositiveInt, read_section, without
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import require
from mme_vla.extras.methods.memoryvla.model import MemoryVlaConfig
from mme_vla.extras.methods.openvla_oft.processor import ClippedQuantiles, OpenVlaProcessor
from mme_vla.memory.base import stack_history
from mme_vla.processing.base import Sample, SampleSpec, StatsSpec
from mme_vla.registry import PROCESSORS
from mme_vla.types import HistoryTokens, TensorStruct


@dataclass
class GroupBatch(TensorStruct):
    """Groups of moments, each of one episode in the order of time, padded behind.

    images: [g, m, 3, s, s] uint8.
    prompt: [g, m, l] ids.
    prompt_mask: [g, m, l] bool.
    times: [g, m] int64.
    valid: [g, m] bool; False on padding.
    actions: [g, m, h, a] normalised; None when sampling.
    action_mask: [g, m, h] bool; None counts all actions.
    history: a memory's selections [g, m, n, …] of all moments, or [g, n, …] of each group's last
        one alone; None where banks remember.
    """

    images: Tensor
    prompt: Tensor
    prompt_mask: Tensor
    times: Tensor
    valid: Tensor
    actions: Tensor | None = None
    action_mask: Tensor | None = None
    history: HistoryTokens | None = None

    def histories(self) -> HistoryTokens | None:
        """The selections of all moments without padding, one after the other, [k, n, …]."""
        return self._histories(self.valid)

    def last(self) -> "GroupBatch":
        """The last moments, each a group of one, with a history [g, n, …]."""
        here = self.valid & (self.valid.cumsum(1) == self.valid.sum(1, keepdim=True))
        alone = replace(self, history=None)._map(lambda x: x[here][:, None])
        return replace(alone, history=self._histories(here))

    def _histories(self, index: Tensor) -> HistoryTokens | None:
        if self.history is None or self.history.mask.ndim == 2:
            return self.history
        return self.history.rows(index)


GROUP_SIZE = 16


@dataclass(frozen=True)
class MemoryVlaProcessorSettings:
    """Settings of a `MemoryVlaProcessor` beside those of `OpenVlaProcessor`."""

    group_size: PositiveInt = GROUP_SIZE


@PROCESSORS.register("memoryvla")
class MemoryVlaProcessor(OpenVlaProcessor):
    """As OpenVLA's, but for the prompt's end, the numbers that are commanded as −1 or 1, and
    groups.
    """

    stats_spec = StatsSpec(horizon=1, every=True, extremes=True, exact=True, video=True)
    group_size = 1
    """Steps of one episode in a training sample."""

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """As `OpenVlaProcessor.from_config`, with `group_size` beside the other settings."""
        settings = read_section(MemoryVlaProcessorSettings, config, "processor", others=True)
        built = super().from_config(without(config, "group_size"))
        camera = built.embodiment.memory_camera
        built.group_size = settings.group_size
        kind = "steps" if settings.group_size == 1 else "groups"
        built.samples = SampleSpec(kind, cameras=(camera,))
        return built

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> Self:
        """As `Processor.from_sections`, at the sizes of the section `backbone`, which is no
        `Backbone` here.
        """
        sizes = MemoryVlaConfig.from_dict(sections["backbone"])
        options = {"image_size": sizes.vision.image_size, "action_dim": sizes.action_dim}
        built = cls.from_config(
            {**sections["processor"], **options, "embodiment": embodiment_of(sections).to_dict()}
        )
        require(
            built.tokenizer.vocab_size <= sizes.vocab_size,
            f"The tokenizer {built.tokenizer.spec!r} has {built.tokenizer.vocab_size} entries but"
            f" backbone.vocab_size={sizes.vocab_size}: choose the processor that goes with the"
            " backbone.",
        )
        return built

    def prompt(self, *args: Any, **named: Any) -> tuple[Tensor, Tensor]:
        """As `OpenVlaProcessor.prompt`, with the end-of-sequence token behind the piece `▁`."""
        ids, mask = super().prompt(*args, **named)
        place = min(int(mask.sum()), len(ids) - 1)
        ids[place - 1], ids[place] = self.tokenizer.piece("▁"), self.tokenizer.end
        mask[place] = True
        return ids, mask

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        """As `OpenVlaProcessor.actions`; numbers that are commanded as −1 or 1 stay as they are."""
        raw = torch.as_tensor(chunk, dtype=torch.float32)
        at = torch.as_tensor(state, dtype=torch.float32)
        return self._quantiles().normalize(self.embodiment.action.to_relative(raw, at))

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        """As `OpenVlaProcessor.absolute_actions`, of chunks that are clipped to ±1 first."""
        raw = self._quantiles().unnormalize(chunk.float().clamp(-1, 1))
        return self.embodiment.action.to_absolute(raw, state.to(raw))

    def _quantiles(self) -> ClippedQuantiles:
        stats = self.require_stats().actions
        scaled = np.ones(len(stats), bool)
        scaled[list(self.embodiment.action.binary)] = False
        return ClippedQuantiles.of(stats, scaled)

    def resized(self, frames: np.ndarray) -> Tensor:
        """Frames [..., H, W, 3] uint8 of that camera as images [..., 3, s, s] uint8."""
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(self._resized(frames), -1, -3)))

    def prepare_images(self, images: Tensor) -> Tensor:
        """Of images [..., v, 3, s, s] those of the one camera this policy looks through."""
        robot = self.embodiment
        return images[..., robot.camera_names.index(robot.memory_camera), :, :, :]

    def item(self, sample: Sample) -> dict[str, Any]:
        """One moment: its image [3, s, s], prompt [l] and actions [h, a]."""
        state, camera = sample.states[-1], self.embodiment.memory_camera
        prompt, mask = self.prompt(sample.goal, subgoal=sample.subgoal)
        return {
            "images": self.resized(sample.views[camera][-1]),
            "prompt": prompt,
            "prompt_mask": mask,
            "actions": self.actions(sample.actions, state),
        }

    def collate(self, items: Sequence[dict[str, Any]]) -> GroupBatch:  # type: ignore[override]
        """Groups side by side, the shorter ones filled up with their last moment; a single step is
        a group of one.
        """
        groups = [item.get("moments", [item]) for item in items]
        longest = max(len(group) for group in groups)
        moments: list[Any] = []  # of all groups, one after the other
        times: list[Tensor] = []
        valid: list[Tensor] = []
        for item, group in zip(items, groups, strict=True):
            rows = np.minimum(np.arange(longest), len(group) - 1).tolist()
            moments += [group[i] for i in rows]
            times.append(torch.as_tensor(item.get("times", item["place"][-1:]))[rows])
            valid.append(torch.arange(longest) < len(group))

        def stack(name: str) -> Tensor:
            stacked = torch.stack([moment[name] for moment in moments])
            return stacked.unflatten(0, (len(groups), longest))

        history = None
        if "history" in moments[0]:
            histories = stack_history([moment["history"] for moment in moments])
            history = histories._map(lambda x: x.unflatten(0, (len(groups), longest)))
        mask = stack("prompt_mask")
        length = int(mask.sum(-1).max())
        return GroupBatch(
            images=stack("images"),
            prompt=stack("prompt")[..., :length],
            prompt_mask=mask[..., :length],
            times=torch.stack(times),
            valid=torch.stack(valid),
            actions=stack("actions"),
            action_mask=stack("action_mask") if "action_mask" in groups[0][0] else None,
            history=history,
        )

    def to_config(self) -> dict[str, Any]:
        return {**super().to_config(), "name": "memoryvla", "group_size": self.group_size}
