"""Diffusion Policy's network: pictures, states and words as one condition, under which a U-Net denoises chunks."""

import torch
from torch import Tensor, nn

from mme_vla.backbone.diffusion.keypoints import keypoint_pool, picture_encoder
from mme_vla.backbone.diffusion.sizes import DiffusionSizes
from mme_vla.backbone.diffusion.unet import ConditionalUnet1d
from mme_vla.backbone.layers.recomputing import Recompute, run_layer
from mme_vla.backbone.pi05.backbone import initialise
from mme_vla.backbone.pi05.siglip import VisionTower, pool_grid


class DiffusionNetwork(nn.Module):
    """What learns: one picture encoder for all cameras, keypoints, a projection of the words, and the U-Net.

    With a memory, a frozen vision tower turns remembered frames into the tokens that memories store.
    """

    def __init__(
        self, sizes: DiffusionSizes, cameras: int, state_width: int, memory_feature: int = 0, tower: bool = False
    ) -> None:
        """Build it.

        Args:
            memory_feature: numbers that a memory adds to the condition. tower: whether frames are to be remembered.
        """
        super().__init__()
        self.sizes = sizes
        self.recomputed: Recompute = False
        # The tower comes first: with one seed it is the same whatever else is built, and so is a cache made by it.
        if tower:
            self.vision = VisionTower(sizes.memory_tower, sizes.memory_width)
            initialise(self.vision)
        self.image_encoder = picture_encoder()
        self.image_pool = keypoint_pool(sizes.keypoints)
        self.text_proj = nn.Sequential(
            nn.LayerNorm(sizes.text_dim),
            nn.Linear(sizes.text_dim, sizes.text_hidden),
            nn.ReLU(),
            nn.Linear(sizes.text_hidden, sizes.text_width),
        )
        step = cameras * 2 * sizes.keypoints + state_width + sizes.text_width
        self.condition_width = sizes.window * step + memory_feature
        self.unet = ConditionalUnet1d(
            sizes.action_dim, self.condition_width, sizes.step_width, sizes.widths, sizes.kernel, sizes.groups
        )

    def condition(self, pictures: Tensor, state: Tensor, text: Tensor, memory: Tensor | None = None) -> Tensor:
        """The condition [b, c]: for each step keypoints of all cameras, state and words; then the memory's feature.

        Args:
            pictures: [b, t, v, 3, h, w] in [−1, 1], cropped. state: [b, t, s] normalised. text: [b, d] of unit length.
        """
        flat = pictures.flatten(0, 2)
        features = run_layer(self.image_encoder, flat, how=self.training and self.recomputed)
        points = self.image_pool(features).unflatten(0, pictures.shape[:3]).flatten(2)  # b t (v k 2)
        words = self.text_proj(text)[:, None].expand(-1, pictures.shape[1], -1)
        steps = torch.cat([points, state, words], dim=-1).flatten(1)
        return steps if memory is None else torch.cat([steps, memory], dim=-1)

    def pooled_tokens(self, images: Tensor, grid: int, pooling: str) -> Tensor:
        """Pictures [n, 3, s, s] in [−1, 1] → tokens [n, grid², d_vision] as memories store them."""
        return pool_grid(self.vision(images), grid, pooling)
