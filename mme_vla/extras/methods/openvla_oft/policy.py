"""`OpenVlaPolicy`: OpenVLA-OFT with any memory as context. What it reads beside π0.5's inputs is
the state.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mme_vla.extras.methods.openvla_oft.processor import (
    OpenVlaProcessor,
    augment,
    centre_crop,
    draw_changes,
)
from mme_vla.policy.episode import Episode
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.network import MemoryTower
from mme_vla.registry import POLICIES
from mme_vla.types import Batch, Noise, to_unit_range


@POLICIES.register("openvla")
class OpenVlaPolicy(MMEPolicy):
    """Backbone × memory × integration, with OpenVLA's images and a normalised state.

    In training every image is cropped and coloured by its own draws; else each is cropped in the
    middle, so that the network sees the same share of a scene.
    """

    def observation(self, episodes: Sequence[Episode]) -> Batch:
        """The current views, prompts and states of running episodes."""
        processor = self.require_processor()
        assert isinstance(processor, OpenVlaProcessor)
        states = processor.proprio(torch.stack([episode.state for episode in episodes]))
        return replace(super().observation(episodes), proprio=states.to(self.device))

    @property
    def memory_tower(self) -> MemoryTower:
        settings = []
        if isinstance(self.processor, OpenVlaProcessor):
            settings.append(self.processor.memory_image_format)
        return super().memory_tower._replace(settings=settings)

    def full_batch(self, device: torch.device | str = "cpu") -> Batch:
        """As `MMEPolicy.full_batch`, with a state."""
        return replace(
            super().full_batch(device),
            proprio=torch.zeros(1, self.embodiment.state.width, device=device),
        )

    def augmentation_params(self, count: int, generator: torch.Generator) -> Noise:
        if not (self.training and self.augment):
            return {}
        views = len(self.embodiment.cameras)
        changes = draw_changes(count * views, generator)
        return {"changes": changes.unflatten(0, (count, views))}

    def transform_images(self, images: Tensor, augmentation: Tensor | None) -> Tensor:
        flat = images.flatten(0, 1)
        if augmentation is None:
            cropped = centre_crop(flat)
        else:
            cropped = augment(flat, augmentation.flatten(0, 1))
        return to_unit_range(cropped).view(images.shape)
