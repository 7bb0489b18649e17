"""`MMEPolicy`: backbone + memory + integration + processing; loss, sampling, episodes, checkpoints."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

import mme_vla.integration
import mme_vla.memory  # noqa: F401  (importing the rooms registers what they ship)
from mme_vla.backbone.pi05 import flow
from mme_vla.backbone.pi05.backbone import Pi05Backbone, initialise
from mme_vla.backbone.pi05.gemma import Conditioning, Hook, KVCache, Layout
from mme_vla.backbone.pi05.sizes import BackboneConfig
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError
from mme_vla.integration.base import Integration
from mme_vla.memory.base import Memory
from mme_vla.policy.episode import Episode
from mme_vla.policy.saving import Saved
from mme_vla.policy.tensor_files import dtype_of
from mme_vla.registry import BACKBONES, INTEGRATIONS, MEMORIES
from mme_vla.types import Batch, HistoryTokens, MemoryTokens

if TYPE_CHECKING:
    from mme_vla.processing.processor import Processor


class MMEPolicy(Saved):
    """One composition of backbone, memory and integration.

    The two independent choices meet here and nowhere else; no method asks which variant it is.
    """

    def __init__(
        self,
        backbone: Pi05Backbone,
        memory: Memory | None,
        integration: Integration,
        processor: "Processor | None" = None,
        config: Mapping[str, Any] | None = None,
        *,
        compute_dtype: str = "float32",
        history_dtype: str = "bfloat16",
        augment: bool = True,
    ) -> None:
        """Put the parts together.

        Args:
            processor: needed for episodes and data; the network alone runs on ready batches without it.
            config: what `from_config` was given; saved with the weights.
            compute_dtype: `bfloat16` runs matmuls under autocast over the float32 master weights.
            history_dtype: dtype of stored vision tokens; bfloat16 as released.
            augment: augment the current views while training (memory features never are).
        """
        super().__init__()
        self.backbone, self.memory, self.integration = backbone, memory, integration
        self.processor = processor
        self.config = dict(config or {})
        self.compute_dtype = dtype_of(compute_dtype, "policy.compute_dtype")
        self.history_dtype = dtype_of(history_dtype, "policy.history_dtype")
        self.augment = augment

    @classmethod
    def from_config(
        cls, config: Mapping[str, Any], processor: "Processor | None" = None, *, fresh_backbone: bool = True
    ) -> Self:
        """Build from plain sections `backbone`, `memory`, `integration`, `policy`; each `name` is a registry's key.

        With `fresh_backbone=False` no weight of π0.5 itself is drawn: they hold anything until a checkpoint is loaded.

        Raises:
            UserError: an unknown name or option, or sizes that do not fit together.
        """
        sizes = dict(config["backbone"])
        backbone_cls = BACKBONES[sizes.pop("name")]
        backbone_config = BackboneConfig.from_dict(sizes)
        embodiment_of(config)  # a robot that does not fit is told before anything is built
        integration = _construct(INTEGRATIONS, config.get("integration"), backbone_config) or Integration(
            backbone_config
        )
        experts = integration.extra_experts()
        with nullcontext() if fresh_backbone else torch.device("meta"):
            backbone = backbone_cls(backbone_config, experts)
        if not fresh_backbone:
            backbone.to_empty(device=torch.get_default_device())
            for block in backbone.transformer.layers:
                for expert in experts:
                    initialise(block.experts[expert])
        memory = _construct(
            MEMORIES, config.get("memory"), d_vision=backbone_config.vlm.width, width=integration.memory_width
        )
        if (memory is None) != (integration.memory_width == 0):
            given = "an integration without a memory" if memory is None else "a memory without an integration"
            raise UserError(f"This configuration names {given}; name both, or neither for the memoryless policy.")
        return cls(backbone, memory, integration, processor, config, **config.get("policy", {}))

    @property
    def embodiment(self) -> Embodiment:
        """The robot this policy is for."""
        return embodiment_of(self.config) if self.processor is None else self.processor.embodiment

    @property
    def device(self) -> torch.device:
        return self.backbone.device

    def autocast(self) -> torch.autocast:
        """The context all network code runs in."""
        kind = self.device.type if self.device.type != "meta" else "cpu"
        return torch.autocast(kind, self.compute_dtype, enabled=self.compute_dtype != torch.float32)

    # Training

    def forward(
        self,
        batch: Batch,
        noise: Tensor | None = None,
        time: Tensor | None = None,
        memory: MemoryTokens | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The flow-matching loss of a batch.

        Args:
            batch: with `actions`.
            noise [b, h, a], time [b]: drawn when not given.
            memory: memory tokens encoded beforehand; by default they are made from `batch.history`.

        Returns:
            The mean loss, and metrics to log (detached); the memory's own begin with `memory/`, and are there while
            `memory.reporting` is True.
        """
        if batch.actions is None:
            raise ValueError("forward() computes a loss: batch.actions must hold the recorded chunk (it is None).")
        actions = batch.actions.float()
        noise = torch.randn_like(actions) if noise is None else noise
        if time is None:
            time = flow.sample_time(len(actions), self.backbone.config.time_distribution, actions.device)
        x_t, target = flow.interpolate(actions, noise, time)
        with self.autocast():
            memory = self.encode_memory(batch.history) if memory is None else memory
        losses = flow.step_loss(self.velocity(batch, x_t, time, memory), target)  # b h
        if batch.action_mask is None:
            loss = losses.mean()
        else:
            # Per sample first: then it does not matter which samples are computed together.
            counted = batch.action_mask.to(losses.dtype)
            loss = ((losses * counted).sum(1) / counted.sum(1).clamp(min=1)).mean()
        reported = {} if memory is None else memory.metrics
        return loss, {"loss": loss.detach(), **{f"memory/{name}": value for name, value in reported.items()}}

    def velocity(self, batch: Batch, x_t: Tensor, time: Tensor, memory: MemoryTokens | None = None) -> Tensor:
        """Predicted velocity [b, h, a] at noisy chunks x_t [b, h, a] and times [b], in one joint pass."""
        with self.autocast():
            memory = self.encode_memory(batch.history) if memory is None else memory
            blocks = self.integration.blocks(self.backbone.observation_blocks(batch, self._views(batch)), memory)
            blocks = [*blocks, self.backbone.action_block(x_t)]
            transformer = self.backbone.transformer
            layout = transformer.layout(blocks, self.integration.visibility)
            condition = self.backbone.time_condition(time)
            answer, _ = transformer(blocks, layout, condition, self.integration.hook(memory))
            return self.backbone.velocity(answer)

    def encode_memory(self, history: HistoryTokens | None) -> MemoryTokens | None:
        """Memory tokens of a selection, or None for a policy without memory."""
        if self.memory is None or history is None:
            return None
        return self.memory(history)

    def _views(self, batch: Batch) -> Tensor:
        from mme_vla.processing.augment import augment_views
        from mme_vla.processing.pictures import to_unit_range

        images = to_unit_range(batch.images)
        return augment_views(images, self.embodiment.augmentations) if self.training and self.augment else images

    # Sampling

    @torch.no_grad()
    def sample_actions(
        self,
        batch: Batch,
        noise: Tensor | None = None,
        steps: int = 10,
        generator: torch.Generator | None = None,
        memory: MemoryTokens | None = None,
    ) -> Tensor:
        """Integrate the flow from noise to a normalised chunk [b, h, a].

        All that does not depend on the flow time runs once: memory, prefix keys and values, the modulator's keys and
        values, and every layer's time modulation. A step runs the action block alone.
        """
        config = self.backbone.config
        if noise is None:
            shape = (len(batch.prompt), config.horizon, config.action_dim)
            noise = torch.randn(shape, device=self.device, generator=generator)
        with self.autocast():
            transformer = self.backbone.transformer
            prefix, hook = self.prefill(batch, memory)
            layout = transformer.layout([self.backbone.action_block(noise)], self.integration.visibility, prefix)
            times = flow.euler_times(steps, self.device)
            conditions = transformer.conditioning(self.backbone.time_condition(times))
            return flow.euler(noise, steps, lambda x, i: self.denoise(x, conditions.at(i), layout, prefix, hook))

    def prefill(self, batch: Batch, memory: MemoryTokens | None = None) -> tuple[KVCache, Hook | None]:
        """Run what a chunk's steps share: keys and values of the prefix, and the memory's hook."""
        memory = self.encode_memory(batch.history) if memory is None else memory
        blocks = self.integration.blocks(self.backbone.observation_blocks(batch, self._views(batch)), memory)
        layout = self.backbone.transformer.layout(blocks, self.integration.visibility)
        _, prefix = self.backbone.transformer(blocks, layout, keep=True)
        return prefix, self.integration.hook(memory)

    def denoise(
        self, x_t: Tensor, condition: Tensor | Conditioning, layout: Layout, prefix: KVCache, hook: Hook | None
    ) -> Tensor:
        """The velocity at one flow time, from the cached prefix: what one Euler step costs."""
        block = self.backbone.action_block(x_t)
        answer, _ = self.backbone.transformer([block], layout, condition, hook, past=prefix)
        return self.backbone.velocity(answer)

    # Episodes

    def start_episode(self, goal: str, seed: int = 0) -> Episode:
        """Begin an episode: its memory, its noise and its current view live in the returned object alone."""
        return Episode(self, goal, seed)

    def act(self, episodes: Sequence[Episode], steps: int = 10) -> np.ndarray:
        """Choose the next chunk for many episodes in one batch, adding nothing to their memories.

        Returns:
            float32 [n, h, w]: the embodiment's actions, absolute.
        """
        if not episodes:
            return np.zeros((0, self.backbone.config.horizon, self.embodiment.action.width), np.float32)
        processor = self.require_processor()
        processor.require_stats()  # before any episode's noise or memory moves on
        prompts, masks = zip(*(e.prompt for e in episodes), strict=True)
        batch = Batch(
            images=torch.stack([e.images for e in episodes]),
            image_mask=torch.ones(len(episodes), len(self.embodiment.cameras), dtype=torch.bool),
            prompt=torch.stack(prompts),
            prompt_mask=torch.stack(masks),
        )
        batch = batch.without_prompt_padding().to(self.device)
        noise = torch.stack([e.draw_noise() for e in episodes]).to(self.device)
        was_training = self.training
        self.eval()
        try:
            memory = self._remember(episodes)
            chunk = self.sample_actions(batch, noise, steps, memory=memory).float().cpu()
        finally:
            self.train(was_training)
        actions = processor.absolute_actions(chunk, torch.stack([e.state for e in episodes])).numpy()
        for episode, chosen in zip(episodes, actions, strict=True):
            episode.acted(chosen)
        return actions

    @torch.no_grad()
    def _remember(self, episodes: Sequence[Episode]) -> MemoryTokens | None:
        """Memory tokens of running episodes, through what their streams have already taken."""
        if self.memory is None:
            return None
        with self.autocast():
            return self.memory.remember([e.required_history() for e in episodes], [e.stream for e in episodes])

    @torch.no_grad()
    def encode_frames(self, frames: np.ndarray | Tensor, batch_size: int = 32) -> Tensor:
        """Memory-view frames [n, H, W, 3] uint8 → pooled tokens [n, grid², d_vision] as a history stores them."""
        storage, encoded = self.require_memory().storage, []
        for start in range(0, len(frames), batch_size):
            images = self.require_processor().memory_images(frames[start : start + batch_size], device=self.device)
            with self.autocast():
                tokens = self.backbone.pooled_tokens(images, storage.grid, storage.pooling)
            encoded.append(tokens.to(self.history_dtype))
        if not encoded:
            width = self.backbone.config.vlm.width
            return torch.zeros(0, storage.grid**2, width, dtype=self.history_dtype, device=self.device)
        return torch.cat(encoded)

    def vision_fingerprint(self) -> str:
        """A hash of the vision tower's weights and the dtype it runs in: what a cache of its tokens depends on."""
        digest = hashlib.sha256(str(self.compute_dtype).encode())
        for name, tensor in sorted(self.backbone.vision.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.detach().float().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def require_memory(self) -> Memory:
        """Return the memory, or say that there is none."""
        if self.memory is None:
            raise UserError("This policy has no memory, so it stores no vision tokens of past frames.")
        return self.memory

    def require_processor(self) -> "Processor":
        """Return the processor, or say what it takes to have one."""
        if self.processor is None:
            raise UserError(
                "This policy was built without a processor, so it can run batches but no raw data: build it with "
                "build_policy() or load it with MMEPolicy.from_pretrained()."
            )
        return self.processor


def _construct(registry: Any, section: Mapping[str, Any] | None, *args: Any, **fixed: Any) -> Any:
    """Call the constructor a section names with the section's other keys, or return None for an empty section."""
    if not section:
        return None
    options = dict(section)
    name = options.pop("name")
    try:
        return registry[name](*args, **fixed, **options)
    except TypeError as error:
        raise UserError(f"{registry.kind} {name!r} does not take these options: {options} ({error}).") from error
