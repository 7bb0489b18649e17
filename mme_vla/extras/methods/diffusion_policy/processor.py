"""What stands between raw data and Diffusion Policy: images as they are, extremes, a text's vector,
a window.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, brief, check_choice, check_integer, did_you_mean, require
from mme_vla.extras.methods.diffusion_policy.config import DiffusionSizes
from mme_vla.extras.methods.goal_encoders import (
    HASHED,
    ClipEncoder,
    GoalEncoder,
    GoalProcessor,
    direction_of,
)
from mme_vla.memory.base import stack_history
from mme_vla.processing.base import STATS_FILE, Sample, SampleSpec, StatsSpec
from mme_vla.processing.images import as_uint8_frames, resize_with_pad, resize_with_pad_uint8
from mme_vla.processing.normalise import NormStats, normalize, unnormalize
from mme_vla.registry import PROCESSORS
from mme_vla.types import HistoryTokens, TensorStruct

if TYPE_CHECKING:
    from transformers import CLIPTextModelWithProjection


CLIP = "openai/clip-vit-base-patch32"
LONGEST = 77
"""Tokens that CLIP reads."""


class HashedWords(GoalEncoder):
    """The sum of one fixed random direction a word: equal words, equal vectors. To try things out
    without CLIP.
    """

    def encode(self, text: str) -> Tensor:
        total = torch.zeros(self.width)
        for word in text.lower().split() or [""]:
            total += direction_of(word, self.width)
        return functional.normalize(total, dim=0)


class ClipText(ClipEncoder):
    """The projected state of the text's end."""

    method, tower = "Diffusion Policy", "CLIPTextModelWithProjection"
    size, option = "projection_dim", "backbone.text_dim"

    def encode(self, text: str) -> Tensor:
        tokenizer, tower = self.parts
        read = tokenizer(
            [text], padding="longest", truncation=True, max_length=LONGEST, return_tensors="pt"
        )
        return text_features(tower, read["input_ids"], read["attention_mask"])[0]


@torch.no_grad()
def text_features(tower: "CLIPTextModelWithProjection", ids: Tensor, mask: Tensor) -> Tensor:
    """Token ids and mask [b, l] → the projected state of each end of text, of unit
    length [b, d].
    """
    return functional.normalize(tower(input_ids=ids, attention_mask=mask).text_embeds, dim=-1)


FRAMES = ("consecutive", "asked")
CLIP_NAME = "clip"
BY = "extremes"


@dataclass
class DiffusionBatch(TensorStruct):
    """Inputs of Diffusion Policy, and for training its targets.

    images: [b, t, v, 3, H, W] uint8; the window's images, the current ones last.
    state: [b, t, s] normalised.
    text: [b, d] the goal's vector.
    actions: [b, h, a] normalised.
    action_mask: [b, h] bool; None counts all steps.
    history: the memory's selection, None for a policy without memory.
    """

    images: Tensor
    state: Tensor
    text: Tensor
    actions: Tensor | None = None
    action_mask: Tensor | None = None
    history: HistoryTokens | None = None


@PROCESSORS.register("diffusion_policy")
class DiffusionProcessor(GoalProcessor):
    """Images of one size without augmentation, states and actions between their extremes, and the
    goal's vector.
    """

    name, trusted = "diffusion_policy", (CLIP_NAME, HASHED)
    stats_spec = StatsSpec(horizon=1, every=True, extremes=True, bounds=BY)

    def __init__(
        self,
        picture: Sequence[int],
        embodiment: Embodiment,
        text: str = CLIP_NAME,
        text_dim: int = 512,
        window: int = 1,
        frames: str = "consecutive",
        memory_size: int = 224,
        stats: NormStats | None = None,
    ) -> None:
        """Put it together.

        Args:
            picture: (height, width) of the images before cropping; images of this size are left as
                they are.
            text: `clip`, `hashed`, or the folder of a CLIP.
            text_dim: width of its vectors.
            window: frames of an observation.
            frames: `consecutive`, or `asked`: those at which the policy was asked.
            memory_size: side of the images that a memory's vision tower reads.
        """
        check_choice("processor.frames", frames, FRAMES)
        check_integer("processor.window", window, 64)
        require(
            text and isinstance(text, str),
            f"processor.text={brief(text)} must be clip, hashed, or a CLIP's folder.",
        )
        height, width = picture
        self.picture = (
            check_integer("processor.picture", height),
            check_integer("processor.picture", width),
        )
        self.embodiment = embodiment
        width = check_integer("processor.text_dim", text_dim)
        folder = CLIP if text == CLIP_NAME else text
        self.text_name = text
        self.text = HashedWords(width) if text == HASHED else ClipText(width, folder)
        self.samples = SampleSpec(window=window, consecutive=frames == FRAMES[0])
        self.memory_size = check_integer("processor.memory_size", memory_size)
        self.stats = stats

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> Self:
        sizes = DiffusionSizes.from_dict(sections["backbone"])
        settings = dict(sections["processor"])
        settings.pop("name", None)
        for key in settings:
            if key not in ("text", "window", "frames", "stats"):
                known = ("text", "window", "frames")
                raise UserError(
                    f"processor has no key {brief(key)}. {did_you_mean(str(key), known)}"
                )
        stats = settings.pop("stats", None)
        return cls(
            sizes.picture,
            embodiment_of(sections),
            text_dim=sizes.text_dim,
            memory_size=sizes.memory_tower.image_size,
            stats=None if stats is None else NormStats.load(stats),
            **settings,
        )

    # Observations

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """Images of all cameras [v, 3, H, W] uint8, or [n, v, 3, H, W]; with black bars where the
        shape is another.
        """
        names = self.embodiment.camera_names
        require(
            len(views) == len(names),
            f"Expected {len(names)} views ({', '.join(names)}), got {len(views)}.",
        )
        resized = [resize_with_pad_uint8(as_uint8_frames(view), self.picture) for view in views]
        return torch.from_numpy(
            np.ascontiguousarray(np.moveaxis(np.stack(resized, axis=-4), -1, -3))
        )

    def memory_images(
        self, frames: np.ndarray | Tensor, device: torch.device | str | None = None
    ) -> Tensor:
        """Memory frames [n, H, W, 3] uint8 as [n, 3, s, s] float32 in [−1, 1]."""
        if not isinstance(frames, Tensor):
            frames = torch.from_numpy(np.require(frames, requirements=["C", "W"]))
        if device is not None:
            frames = frames.to(device)
        return resize_with_pad(frames, self.memory_size)

    def states(self, raw: np.ndarray | Tensor) -> Tensor:
        """Raw states [..., s] between their extremes, −1 … 1."""
        return normalize(torch.as_tensor(raw, dtype=torch.float32), self.require_stats().state, BY)

    # Actions

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        """Recorded actions [h, w] between their extremes, relative first if the
        embodiment says so.
        """
        raw = torch.as_tensor(chunk, dtype=torch.float32)
        at = torch.as_tensor(state, dtype=torch.float32)
        relative = self.embodiment.action.to_relative(raw, at)
        return normalize(relative, self.require_stats().actions, BY)

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        """A chunk [..., h, a] as actions [..., h, w]: the inverse of `actions`."""
        predicted = unnormalize(chunk.float(), self.require_stats().actions, BY)
        return self.embodiment.action.to_absolute(predicted, state.to(predicted))

    # Batches

    def item(self, sample: Sample) -> dict[str, Any]:
        """One training step: the window's images and states, the goal's vector, the chunk."""
        return {
            "images": self.images(list(sample.views.values())),
            "state": self.states(sample.states),
            "text": self.prompt(sample.goal),
            "actions": self.actions(sample.actions, sample.states[-1]),
        }

    def collate(self, items: Sequence[dict[str, Any]]) -> DiffusionBatch:
        stacked: dict[str, Any] = {}
        for name in DiffusionBatch.__dataclass_fields__:
            if name in items[0]:  # a sample may hold more than the network reads
                stack = stack_history if name == "history" else torch.stack
                stacked[name] = stack([item[name] for item in items])
        return DiffusionBatch(**stacked)

    # Folders

    def to_config(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "picture": list(self.picture),
            "text": self.text_name,
            "text_dim": self.text.width,
            "window": self.samples.window,
            "frames": FRAMES[0] if self.samples.consecutive else FRAMES[1],
            "memory_size": self.memory_size,
            "embodiment": self.embodiment.to_dict(),
            "stats": None if self.stats is None else STATS_FILE,
        }
