"""`MMEPolicy`: backbone + memory + integration + processing; loss, sampling, episodes, checkpoints."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.backbone.base import Backbone, Draws, Inject, map_draws, named_draws, stack_draws
from mme_vla.backbone.config import read_backbone, shapes_only
from mme_vla.config.devices import checked_products
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, brief, listed
from mme_vla.integration.base import Integration, extension_points
from mme_vla.memory.base import Memory
from mme_vla.memory.history import PromptConditionedHistory
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_memory, check_integrated
from mme_vla.policy.episode import Episode
from mme_vla.policy.masking import masked_mean
from mme_vla.policy.promises import prefix_overlap
from mme_vla.policy.saving import policy_options
from mme_vla.policy.tensor_files import dtype_of
from mme_vla.policy.vision_cache import encode_frames, tower_fingerprint
from mme_vla.processing.images import full_past, stack_past
from mme_vla.registry import INTEGRATIONS, POLICIES
from mme_vla.speed.graphs import CapturedSampling
from mme_vla.speed.recompute import Recompute
from mme_vla.speed.sharding import ShardGroup
from mme_vla.types import Batch, HistoryTokens, MemoryTokens, send

if TYPE_CHECKING:
    from mme_vla.processing.base import PolicyProcessor


@POLICIES.register("mme")
class MMEPolicy(Policy):
    """One composition of backbone, memory and integration.

    The two independent choices meet here and nowhere else; no method asks which variant it is.
    """

    acts_in_bfloat16 = True
    _sampler: CapturedSampling | None = None

    def __init__(
        self,
        backbone: Backbone,
        memory: Memory | None,
        integration: Integration,
        processor: "PolicyProcessor | None" = None,
        config: Mapping[str, Any] | None = None,
        *,
        compute_dtype: str = "float32",
        history_dtype: str = "bfloat16",
        augment: bool = True,
        attention: str = "auto",
        float32_products: str = "ieee",
    ) -> None:
        """Put the parts together.

        Args:
            processor: needed for episodes and data; the network alone runs on ready batches without it.
            config: what `from_config` was given; saved with the weights.
            compute_dtype: `bfloat16` runs matmuls under autocast over the float32 master weights.
            history_dtype: dtype of stored vision tokens; bfloat16 as released.
            augment: augment the current views while training (memory features never are).
            attention: what computes it: `auto`, `sdpa`, `flex` or `varlen` (docs/evidence/hardware.md).
            float32_products: how a GPU multiplies in recurrent memories, which compute in float32: `ieee` or `tf32`.
        """
        super().__init__()
        self.backbone, self.memory, self.integration = backbone, memory, integration
        self.processor = processor
        self.config = dict(config or {})
        self.compute_dtype = dtype_of(compute_dtype, "policy.compute_dtype")
        self.history_dtype = dtype_of(history_dtype, "policy.history_dtype")
        self.augment = augment
        backbone.choose_attention(attention)
        if memory is not None:
            memory.choose_products(checked_products(float32_products))
        self.horizon, self.action_dim = backbone.horizon, backbone.action_dim
        self.sample_steps = backbone.sample_steps
        self.supports_rtc = backbone.supports_rtc
        self.lora_targets, self.heads, self.lora_exclude = backbone.lora_targets, backbone.heads, backbone.lora_exclude

    @classmethod
    def from_config(
        cls, config: Mapping[str, Any], processor: "PolicyProcessor | None" = None, *, fresh_backbone: bool = True
    ) -> Self:
        """Build from plain sections `backbone`, `memory`, `integration`, `policy`; each `name` is a registry's key.

        With `fresh_backbone=False` no weight of the backbone itself is drawn: a checkpoint is to be loaded.

        Raises:
            UserError: an unknown name or option, or sizes that do not fit together.
        """
        backbone_cls, sizes = read_backbone(config["backbone"])
        embodiment_of(config)  # a robot that does not fit is told before anything is built
        section = config.get("integration")
        if section and (unhosted := extension_points(INTEGRATIONS[section.get("name")]) - backbone_cls.supports):
            raise UserError(
                f"The backbone {config['backbone']['name']!r} has no place for {listed(sorted(unhosted))} of the "
                f"integration {section['name']!r}; it hosts {listed(sorted(backbone_cls.supports))}. Choose another "
                "integration or backbone."
            )
        integration: Integration = INTEGRATIONS.build(section, sizes) if section else Integration(sizes)
        experts = integration.extra_experts()
        with nullcontext() if fresh_backbone else shapes_only():
            backbone = backbone_cls(sizes, experts)
        if not fresh_backbone:
            backbone.to_empty(device=torch.get_default_device())
            backbone.draw_experts(list(experts))
        memory: Memory | None = None
        if config.get("memory"):
            memory = build_memory(config["memory"], backbone.vision_width, backbone.grid, integration.memory_width)
        check_integrated(config, integration, memory, backbone_cls.supports)
        return cls(backbone, memory, integration, processor, config, **policy_options(cls, config))

    def autocast(self) -> torch.autocast:
        """The context all network code runs in."""
        kind = self.device.type if self.device.type != "meta" else "cpu"
        return torch.autocast(kind, self.compute_dtype, enabled=self.compute_dtype != torch.float32)

    # Training

    def loss_draws(self, count: int, generator: torch.Generator) -> Draws:
        """What the backbone's loss draws: of π0.5 the `noise` [n, h, a] and flow times `time` [n]."""
        return self.backbone.loss_draws(count, generator)

    def image_draws(self, count: int, generator: torch.Generator) -> Draws:
        """While training with augmentation `changes` [n, …]: what happens to a sample's images."""
        return {"changes": self._draw_changes(count, generator)} if self.training and self.augment else {}

    def forward(
        self,
        batch: Batch,
        draws: Mapping[str, Tensor] | Tensor | None = None,
        time: Tensor | None = None,
        memory: MemoryTokens | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean loss of a batch, and metrics to log (detached).

        Args:
            batch: with `actions`.
            draws: as `loss_draws` makes them; of a flow also its noise [b, h, a] alone, with the times beside it.
            time: flow times [b], where `draws` is the noise.
            memory: memory tokens encoded beforehand; by default they are made from `batch.history`.

        Returns:
            The loss and its metrics; the memory's own begin with `memory/` and are there while `memory.reporting`.
        """
        if batch.actions is None:
            raise ValueError("forward() computes a loss: batch.actions must hold the recorded chunk (it is None).")
        values = named_draws(draws, time=time)
        if set(self.loss_draws(0, torch.default_generator)) - set(values):
            values = self.loss_draws(len(batch.actions), torch.default_generator) | values
        if "changes" not in values:
            values = values | self.image_draws(len(batch.actions), torch.default_generator)
        sampled = map_draws(values, lambda value: value.to(self.device))
        batch, views = self._current_views(batch, sampled.pop("changes", None))
        with self.autocast():
            memory = self.encode_memory(self._conditioned_history(batch)) if memory is None else memory
            losses = self.backbone.loss(batch, views, self._inject(memory), sampled)  # b h
        loss = masked_mean(losses, batch.action_mask)
        reported = {} if memory is None else memory.metrics
        return loss, {"loss": loss.detach(), **{f"memory/{name}": value for name, value in reported.items()}}

    def velocity(self, batch: Batch, x_t: Tensor, time: Tensor, memory: MemoryTokens | None = None) -> Tensor:
        """Predicted velocity [b, h, a] of a flow backbone at noisy chunks x_t [b, h, a] and times [b], in one pass."""
        with self.autocast():
            memory = self.encode_memory(self._conditioned_history(batch)) if memory is None else memory
            return self.backbone.velocity(*self._current_views(batch), self._inject(memory), x_t, time)  # type: ignore[operator]

    def recompute(self, mode: Recompute) -> None:
        """Compute activations again in the backward pass instead of keeping them, or keep them."""
        self.backbone.recompute(mode)

    def compile(self, **options: Any) -> None:
        """Compile the backbone's tower and layers in place, each by itself, and what of the memory is worth it."""
        self.backbone.compile(**options)
        if self.memory is not None:
            self.memory.compile(**options)

    def shard_groups(self) -> Sequence[ShardGroup]:
        """The backbone's groups. Memory and integration stand in none: they are small, and compute in float32."""
        return self.backbone.shard_groups()

    def _inject(self, memory: MemoryTokens | None) -> Inject:
        return lambda observation: self.integration.inject(observation, memory)

    def encode_memory(self, history: HistoryTokens | None) -> MemoryTokens | None:
        """Memory tokens of a selection, or None for a policy without memory."""
        if self.memory is None or history is None:
            return None
        return self.memory(history)

    def _conditioned_history(self, batch: Batch) -> HistoryTokens | None:
        """The batch's selection as the backbone reads it beside the prompt."""
        if self.memory is None or batch.history is None:
            return None
        mark = partial(self.backbone.mark, prompt=batch.prompt, prompt_mask=batch.prompt_mask)
        return self.memory.condition_on_prompt(batch.history, mark)

    def _draw_changes(self, count: int, generator: torch.Generator) -> Tensor:
        """The random numbers that change the images of `count` training samples, [count, …] on the CPU."""
        from mme_vla.processing.augment import augmentation_draws

        return augmentation_draws(count, generator)

    def _current_views(self, batch: Batch, changes: Tensor | None = None) -> tuple[Batch, Tensor]:
        """The batch and its current views as the backbone takes them; past ones are changed as the current ones are."""
        views = self._views(batch, changes)
        if batch.past is None:
            return batch, views
        count = batch.past.images.shape[1]
        each = replace(batch, images=batch.past.images.flatten(0, 1), past=None)
        past = self._views(each, None if changes is None else changes.repeat_interleave(count, 0))
        return replace(batch, past=replace(batch.past, images=past.unflatten(0, (-1, count)))), views

    def _views(self, batch: Batch, changes: Tensor | None = None) -> Tensor:
        """The current views in [−1, 1], changed where random numbers say how (`_draw_changes`)."""
        from mme_vla.processing.augment import augment_views
        from mme_vla.processing.images import to_unit_range

        images = to_unit_range(batch.images)
        return images if changes is None else augment_views(images, self.embodiment.augmentations, changes)

    # Sampling

    def sample_draws(self, generator: torch.Generator) -> Draws:
        """What one chunk of the backbone draws: of π0.5 the starting `noise` [h, a]."""
        return self.backbone.sample_draws(generator)

    @torch.no_grad()
    def sample_actions(
        self,
        batch: Batch,
        draws: Mapping[str, Tensor] | Tensor | None = None,
        steps: int | None = None,
        generator: torch.Generator | None = None,
        memory: MemoryTokens | None = None,
    ) -> Tensor:
        """A normalised chunk [b, h, a].

        Args:
            draws: as `sample_draws` makes them, with a batch axis; of a flow also its noise [b, h, a] alone.
            steps: Euler steps of a flow; 10 by default, as released.
            generator: where fresh draws come from (on the CPU). memory: memory tokens encoded beforehand.
        """
        if draws is None:
            source = torch.default_generator if generator is None else generator
            draws = stack_draws([self.sample_draws(source) for _ in range(len(batch.prompt))])
        sampled = map_draws(named_draws(draws), lambda value: send(value, self.device))
        if memory is None:
            with self.autocast():
                memory = self.encode_memory(self._conditioned_history(batch))
        # A chunk that agrees with promised actions runs the network backwards as well: no graph is made of that.
        if self._sampler is not None and not self.training and batch.overlap is None:
            return self._sampler(batch, memory, sampled, steps or self.sample_steps)
        return self._sample(batch, memory, sampled, steps)

    def _sample(
        self, batch: Batch, memory: MemoryTokens | None, sampled: Mapping[str, Tensor], steps: int | None
    ) -> Tensor:
        with self.autocast():
            return self.backbone.sample(*self._current_views(batch), self._inject(memory), sampled, steps)

    @property
    def compiles_sampling(self) -> bool:
        """Whether its backbone's sampler can be compiled."""
        return self.backbone.compiles_sampling

    def compile_sampling(self, layers: bool = False) -> None:
        """Make chunks quick, for a policy whose weights are done: they are the same to the rounding of their kernels.

        What depends on the flow time alone is computed once and kept. On a GPU a chunk becomes one CUDA graph for each
        size of batch, captured when it first occurs; here for one episode and every length of prompt.

        Args:
            layers: compile the tower and the layers too, which takes a minute or more at full size.

        Raises:
            UserError: this backbone has no sampler that can be captured.
        """
        self.backbone.compile_sampling()
        if layers:
            self.backbone.compile(dynamic=False)
        if self.device.type != "cuda":
            return
        self._sampler = CapturedSampling(self._sample, self.backbone.sampling_stamp)
        if self.processor is None:
            return
        full = self.full_batch(self.device)
        for length in range(16, self._prompt_length() + 16, 16):
            cut = replace(full, prompt=full.prompt[:, :length], prompt_mask=full.prompt_mask[:, :length])
            self.sample_actions(cut)

    # Episodes

    def observation(self, episodes: Sequence[Episode]) -> Batch:
        """The current views and prompts of running episodes."""
        prompts, masks = zip(*(e.prompt for e in episodes), strict=True)
        states = torch.stack([e.state for e in episodes])
        prefixes = [e.action_prefix for e in episodes]
        batch = Batch(
            images=torch.stack([e.images for e in episodes]),
            image_mask=torch.ones(len(episodes), len(self.embodiment.cameras), dtype=torch.bool),
            prompt=torch.stack(prompts),
            prompt_mask=torch.stack(masks),
            state=states,
            overlap=prefix_overlap(prefixes, states, self.require_processor(), self.action_dim),
            past=stack_past([e.past for e in episodes]),
        )
        return batch.without_prompt_padding().sent(self.device)

    def answer(
        self, batch: Batch, episodes: Sequence[Episode], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        """A chunk for what `observation` saw, through the episodes' memories."""
        return self.sample_actions(batch, draws, steps, memory=self._memory_tokens(episodes, batch))

    @torch.no_grad()
    def _memory_tokens(self, episodes: Sequence[Episode], batch: Batch) -> MemoryTokens | None:
        """Memory tokens of running episodes, through what their streams have already taken."""
        if self.memory is None:
            return None
        with self.autocast():
            histories = [
                PromptConditionedHistory(
                    e.required_history(), partial(self._mark_one, batch.prompt[i], batch.prompt_mask[i])
                )
                for i, e in enumerate(episodes)
            ]
            for episode, history in zip(episodes, histories, strict=True):
                episode.read = history
            return self.memory.encode(histories, [e.stream for e in episodes])

    @torch.no_grad()
    def prepare(self, episode: Episode) -> bool:
        if self.memory is None or episode.read is None:
            return False
        with self.autocast():
            return self.memory.prepare(episode.read, episode.stream)

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray:
        """What the memory reads; nothing without one."""
        return np.zeros(0, np.int64) if self.memory is None else self.memory.frames_read(steps, exec_start)

    def _mark_one(self, prompt: Tensor, prompt_mask: Tensor, tokens: Tensor) -> Tensor:
        """Stored tokens [n, d_vision] of one episode, read beside its prompt [l]."""
        return self.backbone.mark(tokens[None], prompt[None], prompt_mask[None])[0]

    def encode_frames(self, frames: np.ndarray | Tensor, batch_size: int = 32) -> Tensor:
        """Memory-view frames [n, H, W, 3] uint8 → pooled tokens [n, grid², d_vision] as a history stores them."""
        return encode_frames(self, frames, self.backbone.pooled_tokens, self.backbone.vision_width, batch_size)

    def vision_fingerprint(self) -> str:
        """A hash of the vision tower's weights and the dtype it runs in: what a cache of its tokens depends on."""
        image_format = "" if self.processor is None else self.processor.memory_image_format
        return tower_fingerprint(self.backbone.vision, self.compute_dtype, image_format)

    def full_batch(self, device: torch.device | str = "cpu") -> Batch:
        """A batch of one without content: all views, the longest prompt without padding, and a memory that is full."""
        size, views, length = self.backbone.image_size, len(self.embodiment.cameras), self._prompt_length()
        return Batch(
            images=torch.zeros(1, views, 3, size, size, dtype=torch.uint8, device=device),
            image_mask=torch.ones(1, views, dtype=torch.bool, device=device),
            prompt=torch.full((1, length), 5, device=device),
            prompt_mask=torch.ones(1, length, dtype=torch.bool, device=device),
            history=None if self.memory is None else self.memory.full_history(self.backbone.vision_width, device),
            actions=torch.zeros(1, self.horizon, self.action_dim, device=device),
            past=None if self.memory is None else full_past(self.memory.past_view_spec, views, size, device),
        )

    def _prompt_length(self) -> int:
        return int(self.config["processor"]["prompt_length"]) + self.embodiment.action.options_length

    def warm_up_vision(self) -> None:
        """Run the vision tower on one black memory frame."""
        size = self.backbone.image_size
        self.backbone.encode_images(torch.zeros(1, 3, size, size, device=self.device))

    def check_processor(self, source: str) -> None:
        """See `Saved`."""
        super().check_processor(source)
        processor = self.require_processor()
        for name in ("image_size", "action_dim", "horizon"):
            actual, expected = getattr(processor, name), getattr(self.backbone, name)
            if actual != expected:
                raise UserError(
                    f"{source}: the processor's {name} is {brief(actual)}, the network's {expected}. The files are "
                    "from two checkpoints, or one was changed."
                )

    def parts(self) -> Mapping[str, str]:
        """The backbone's parts in its order; memory, integration and the latter's experts are the part `memory`."""
        parts = {part: rf"backbone\.(?:{pattern})" for part, pattern in self.backbone.parts().items()}
        experts = f"|{parts['memory']}" if "memory" in parts else ""
        return {**parts, "memory": rf"memory\.|integration\.{experts}"}


def mme_of(policy: Policy, what: str) -> MMEPolicy:
    """The policy, where it is made of backbone, memory and integration."""
    if not isinstance(policy, MMEPolicy):
        raise UserError(
            f"{what} looks inside a backbone that a memory is integrated with; {policy.config.get('name', 'this')} is "
            f"a {type(policy).__name__}, which has none."
        )
    return policy
