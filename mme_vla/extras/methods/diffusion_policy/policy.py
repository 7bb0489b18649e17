"""`DiffusionPolicy`: chunks of absolute joint targets by denoising, as its authors trained it or
with a memory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.backbone.base import FineTuneSpec
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, missing_extra, require
from mme_vla.extras.methods.diffusion_policy.config import DiffusionSizes
from mme_vla.extras.methods.diffusion_policy.model import DiffusionNetwork, noise_schedule, sample
from mme_vla.extras.methods.diffusion_policy.processor import DiffusionBatch, DiffusionProcessor
from mme_vla.extras.methods.network import MethodPolicy, processor_for
from mme_vla.integration.film import PooledIntegration
from mme_vla.memory.base import Memory, full_history
from mme_vla.model import masked_mean
from mme_vla.policy.base import draw_noise
from mme_vla.policy.build import build_memory, check_past
from mme_vla.policy.episode import Episode
from mme_vla.policy.network import MemoryTower
from mme_vla.policy.saving import policy_options
from mme_vla.policy.sections import PolicySections
from mme_vla.registry import INTEGRATIONS, POLICIES
from mme_vla.speed import Recompute
from mme_vla.speed.sharding import ShardGroup
from mme_vla.types import MemoryTokens, Noise, map_noise

if TYPE_CHECKING:
    from mme_vla.processing.base import PolicyProcessor


@POLICIES.register("diffusion_policy")
class DiffusionPolicy(MethodPolicy):
    """Diffusion Policy (RoboMME's DP-Unet): a U-Net that denoises chunks conditioned on images,
    state and goal.

    Any memory may stand beside it, through an integration that makes one vector of its tokens
    (`film`).
    """

    processor: DiffusionProcessor | None
    finetune_spec = FineTuneSpec(
        components={
            "vision": r"backbone\.vision\.",  # the memory's tower alone, which is never trained
            "memory": r"memory\.|integration\.",
            "encoder": r"backbone\.(image_encoder|image_pool)\.",
            "text": r"backbone\.text_proj\.",
            "action": "",
        },
        lora_targets=("cond_encoder.1", "diffusion_step_encoder.1", "diffusion_step_encoder.3"),
        full_train=("final_conv",),
    )

    def __init__(
        self,
        backbone: DiffusionNetwork,
        memory: Memory | None = None,
        integration: PooledIntegration | None = None,
        processor: DiffusionProcessor | None = None,
        config: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Put the parts together; `processor`, `config` and `options` as for `NetworkPolicy`.

        While training, `augment` crops at random, one position for the whole batch; else the centre
        is cropped, as when acting.
        """
        super().__init__(processor, config, **options)
        self.backbone, self.memory, self.integration = backbone, memory, integration
        self.sizes = sizes = backbone.sizes
        self.horizon, self.action_dim = sizes.horizon, sizes.action_dim
        self.n_past_steps = sizes.window - 1
        self.info = replace(
            self.info,
            sample_steps=sizes.diffusion_steps,
            processor_sizes={
                "picture": sizes.picture,
                "samples.window": sizes.window,
                "text.width": sizes.text_dim,
                "embodiment.action.horizon": sizes.horizon,
                "memory_size": sizes.memory_tower.image_size,
            },
        )

    @classmethod
    def from_config(
        cls,
        config: Mapping[str, Any],
        processor: "PolicyProcessor | None" = None,
        *,
        fresh_backbone: bool = True,
    ) -> Self:
        if not find_spec("diffusers"):  # which is used much later
            raise missing_extra("Diffusion Policy", "baselines")
        sections = PolicySections.of(config)
        sizes, robot = DiffusionSizes.from_dict(sections.backbone), embodiment_of(config)
        integration: PooledIntegration | None = None
        if sections.integration:
            name = sections.integration.get("name", "")
            kind = INTEGRATIONS[name]
            if not (isinstance(kind, type) and issubclass(kind, PooledIntegration)):
                raise UserError(
                    f"Diffusion Policy has no place for what the integration {name!r} brings:"
                    " memory reaches it as one vector. Choose integration=film."
                )
            integration = INTEGRATIONS.build(sections.integration, sizes)
        mismatch = ""
        if sections.memory and integration is None:
            mismatch = "a memory without an integration"
        elif integration is not None and not sections.memory:
            mismatch = "an integration without a memory"
        if mismatch:
            raise UserError(f"This configuration names {mismatch}; name both, or neither.")
        require(
            robot.action.width == sizes.action_dim,
            f"backbone.action_dim={sizes.action_dim}: Diffusion Policy predicts the robot's own "
            f"{robot.action.width} numbers an action; leave it to the embodiment.",
        )
        feature = 0 if integration is None else integration.feature_width
        network = DiffusionNetwork(
            sizes, len(robot.cameras), robot.state.width, feature, integration is not None
        )
        memory: Memory | None = None
        if integration is not None:
            grid = sizes.memory_tower.image_size // sizes.memory_tower.patch_size
            memory = build_memory(
                sections.memory, sizes.memory_width, grid, integration.memory_width
            )
            check_past(sections, memory, frozenset())
        processor = processor_for(DiffusionProcessor, processor, "dp, or dp_tiny to try things out")
        return cls(network, memory, integration, processor, config, **policy_options(cls, config))

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """The `noise` [n, h, a] that is added and the `step` [n] of the noise level."""
        step = torch.randint(self.sizes.diffusion_steps, (count,), generator=generator)
        return {
            "noise": torch.randn(count, self.horizon, self.action_dim, generator=generator),
            "step": step,
        }

    def forward(
        self,
        batch: DiffusionBatch,
        noise: Mapping[str, Tensor] | None = None,
        corner: tuple[int, int] | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean squared error of the predicted noise, and metrics to log (detached).

        Args:
            batch: with `actions`.
            noise: as `training_noise` makes them.
            corner: (top, left) of the crop; by default sampled while training and the centre's
                else.
        """
        if batch.actions is None:
            raise ValueError(
                "forward() computes a loss: batch.actions must hold the recorded chunk (it is"
                " None)."
            )
        values = noise or self.training_noise(len(batch.actions), torch.default_generator)
        sampled = map_noise(values, lambda value: value.to(self.device))
        memory = self.encode_memory(batch.history)
        with self.autocast():
            condition = self.condition(batch, memory, corner)
            schedule = noise_schedule(self.sizes.diffusion_steps)
            noisy = schedule.add_noise(batch.actions, sampled["noise"], sampled["step"])
            predicted = self.backbone.unet(noisy, sampled["step"], condition)
        losses = (predicted.float() - sampled["noise"]).square().mean(-1)  # b h
        loss = masked_mean(losses, batch.action_mask)
        metrics = {"loss": loss.detach()}
        if memory is not None:
            metrics |= memory.logged()
        return loss, metrics

    def condition(
        self,
        batch: DiffusionBatch,
        memory: MemoryTokens | None = None,
        corner: tuple[int, int] | None = None,
    ) -> Tensor:
        """What the U-Net denoises under, [b, c]: the window's steps, oldest first, then the
        memory's vector.
        """
        feature = None if self.integration is None else self.integration.feature(memory)
        return self.backbone.condition(
            self._cropped_images(batch.images, corner), batch.state, batch.text, feature
        )

    def recompute(self, mode: Recompute) -> None:
        """Compute the images' features again in the backward pass instead of keeping them, or keep
        them.
        """
        self.backbone.recomputed = mode

    def shard_groups(self) -> Sequence[ShardGroup]:
        tower = [] if self.memory is None else [ShardGroup(self.backbone.vision, full=True)]
        return [*tower, ShardGroup(self.backbone.image_encoder), ShardGroup(self.backbone.unet)]

    def _cropped_images(self, images: Tensor, corner: tuple[int, int] | None) -> Tensor:
        """Images [..., H, W] uint8, all cropped at one place, in [−1, 1]."""
        height, width = self.sizes.cropped
        lowest, rightmost = images.shape[-2] - height, images.shape[-1] - width
        if corner is not None:
            top, left = corner
        elif self.training and self.augment:
            top = int(torch.randint(lowest + 1, ()))
            left = int(torch.randint(rightmost + 1, ()))
        else:
            top, left = round(lowest / 2), round(rightmost / 2)
        cropped = images[..., top : top + height, left : left + width]
        return (cropped.float() / 255 - 0.5) / 0.5

    # Sampling

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The starting `noise` [h, a], and what is `added` [99, h, a] after each step
        but the last.
        """
        shape, steps = (self.horizon, self.action_dim), self.sizes.diffusion_steps
        noise = torch.randn(shape, generator=generator)
        return {"noise": noise, "added": torch.randn(steps - 1, *shape, generator=generator)}

    @torch.no_grad()
    def sample_actions(
        self,
        batch: DiffusionBatch,
        noise: Mapping[str, Tensor] | None = None,
        steps: int | None = None,
        memory: MemoryTokens | None = None,
    ) -> Tensor:
        """A normalised chunk [b, h, a], from the first step of the current frame on.

        Args:
            noise: as `sampling_noise` makes them, with a batch axis.
            steps: of the sampler; 100 as trained by default.
            memory: memory tokens encoded beforehand.
        """
        if noise is None:
            noise = draw_noise(self, len(batch.state))
        sampled = map_noise(noise, lambda value: value.to(self.device))
        memory = self.encode_memory(batch.history) if memory is None else memory
        with self.autocast():
            condition = self.condition(batch, memory)

            def predict(x: Tensor, step: Tensor) -> Tensor:
                with self.autocast():
                    return self.backbone.unet(x, step, condition).float()

            schedule = noise_schedule(self.sizes.diffusion_steps)
            return sample(schedule, predict, sampled["noise"], sampled["added"], steps)

    # Episodes

    def observation(self, episodes: Sequence[Episode]) -> DiffusionBatch:
        processor = self.require_processor()
        images, states = zip(*(e.window for e in episodes), strict=True)
        text = torch.stack([e.prompt for e in episodes])
        return DiffusionBatch(torch.stack(images), processor.states(torch.stack(states)), text).to(
            self.device
        )

    def predict_chunk(
        self,
        batch: DiffusionBatch,
        episodes: Sequence[Episode],
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """A chunk for what `observation` saw, through the episodes' memories."""
        return self.sample_actions(batch, noise, steps, self.encode_memories(episodes))

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """What the memory reads beside the current frame; with a window of consecutive frames, any
        may be seen.
        """
        processor = self.require_processor()
        if processor.samples.window > 1 and processor.samples.consecutive:
            return None
        return super().frames_read(steps, exec_start)

    def require_processor(self) -> DiffusionProcessor:
        processor = super().require_processor()
        assert isinstance(processor, DiffusionProcessor)
        return processor

    @property
    def memory_tower(self) -> MemoryTower:
        self.require_memory()
        vision, sizes = self.backbone.vision, self.sizes
        return MemoryTower(vision, vision, sizes.memory_width, sizes.memory_tower.image_size)

    # Costs

    def full_batch(self, device: torch.device | str = "cpu") -> DiffusionBatch:
        """A batch of one without content, with a memory that is full."""
        sizes, robot = self.sizes, self.embodiment
        shape = (1, sizes.window, len(robot.cameras), 3, *sizes.picture)
        history = None
        if self.memory is not None:
            history = full_history(self.memory, sizes.memory_width, device)
        return DiffusionBatch(
            images=torch.zeros(shape, dtype=torch.uint8, device=device),
            state=torch.zeros(1, sizes.window, robot.state.width, device=device),
            text=torch.zeros(1, sizes.text_dim, device=device),
            actions=torch.zeros(1, self.horizon, self.action_dim, device=device),
            history=history,
        )
