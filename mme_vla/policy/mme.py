"""`MMEPolicy`: the network `MMEModel` with a processor, episodes and checkpoints."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from mme_vla.backbone.base import Backbone, FineTuneSpec, HasExtraExperts
from mme_vla.backbone.building import read_backbone, shapes_only
from mme_vla.backbone.flow import HasFlowHead
from mme_vla.backbone.layers import check_backend
from mme_vla.config.devices import FLOAT32_PRODUCTS
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, check_choice, listed
from mme_vla.integration.base import Integration, extension_points
from mme_vla.memory.base import (
    MemoryModule,
    full_history,
)
from mme_vla.memory.history import PromptConditionedHistory
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.model import MMEModel
from mme_vla.policy.base import Policy, draw_noise
from mme_vla.policy.build import build_memory, check_integrated
from mme_vla.policy.episode import Episode, prefix_overlap
from mme_vla.policy.network import MemoryTower, NetworkPolicy
from mme_vla.policy.saving import policy_options
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.images import augment_views, augmentation_draws, full_past, stack_past
from mme_vla.registry import INTEGRATIONS, POLICIES
from mme_vla.speed import (
    SAMPLING_OPTIONS,
    CapturableSampling,
    HasAttentionBackends,
    Recompute,
    Recomputes,
    compile_parts,
)
from mme_vla.speed.graphs import CapturedSampling
from mme_vla.speed.sharding import ShardGroup, stacked_layers
from mme_vla.types import (
    Batch,
    MemoryTokens,
    Noise,
    map_noise,
    named_noise,
    send,
    to_unit_range,
)

if TYPE_CHECKING:
    from mme_vla.processing.base import PolicyProcessor


@POLICIES.register("mme")
class MMEPolicy(NetworkPolicy, Recomputes):
    """One composition of backbone, memory and integration, as a policy. No method depends on the
    variant.

    model: the network. Policy and model share the modules `backbone`, `memory` and `integration`:
        names of weights have no prefix, and a part that is replaced in one is replaced in both.
        `compute_dtype`, `loss_weights` and the mode of training are the model's.
    """

    model: MMEModel
    backbone: Backbone
    integration: Integration
    acts_in_bfloat16 = True
    _sampler: CapturedSampling | None = None

    def __init__(
        self,
        backbone: Backbone,
        memory: MemoryModule | None,
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
            processor, config, compute_dtype, history_dtype, augment: as for `NetworkPolicy`.
            attention: backend: `auto`, `sdpa`, `flex` or `varlen` (docs/evidence/hardware.md).
            float32_products: how a GPU multiplies in recurrent memories, which compute in float32:
                `ieee` or `tf32`.
        """
        # The model is no submodule: the policy shares its table of modules, see above. It comes
        # before `super().__init__`, which sets `compute_dtype`.
        model = MMEModel(backbone, memory, integration, transform_images=self.transform_images)
        object.__setattr__(self, "model", model)
        super().__init__(
            processor,
            config,
            compute_dtype=compute_dtype,
            history_dtype=history_dtype,
            augment=augment,
        )
        self._modules = model._modules
        self.horizon = backbone.horizon
        self.action_dim = backbone.action_dim
        sizes = {
            "image_size": backbone.image_size,
            "action_dim": backbone.action_dim,
            "embodiment.action.horizon": backbone.horizon,
        }
        self.info = replace(self.info, processor_sizes=sizes)
        if isinstance(backbone, HasFlowHead):
            head = backbone.head
            self.info = replace(self.info, sample_steps=head.steps, supports_rtc=head.supports_rtc)
        if isinstance(backbone, HasAttentionBackends):
            backbone.set_attention_backend(attention)
        elif check_backend(attention) != "auto":
            raise UserError(
                f"policy.attention={attention}: {type(backbone).__name__} has one attention"
                " backend; leave it at auto."
            )
        check_choice("policy.float32_products", float32_products, FLOAT32_PRODUCTS)
        for module in self.modules():
            if isinstance(module, RecurrentMemory):
                module.float32_products = float32_products

    @property
    def compute_dtype(self) -> torch.dtype:
        """Matrix products run in it, under autocast."""
        return self.model.compute_dtype

    @compute_dtype.setter
    def compute_dtype(self, dtype: torch.dtype) -> None:
        self.model.compute_dtype = dtype

    @property
    def loss_weights(self) -> Mapping[str, float]:
        """Weights of auxiliary losses by name (`train.losses`)."""
        return self.model.loss_weights

    @loss_weights.setter
    def loss_weights(self, weights: Mapping[str, float]) -> None:
        self.model.loss_weights = weights

    def train(self, mode: bool = True) -> Self:
        """Set policy and model to training, or to inference."""
        self.model.training = mode
        return super().train(mode)

    @classmethod
    def from_config(
        cls,
        config: Mapping[str, Any],
        processor: "PolicyProcessor | None" = None,
        *,
        fresh_backbone: bool = True,
    ) -> Self:
        """Build from plain sections `backbone`, `memory`, `integration`, `policy`; each `name` is a
        registry's key.

        With `fresh_backbone=False` no weight of the backbone itself is initialised: a checkpoint is
        loaded next.

        Raises:
            UserError: an unknown name or option, or sizes that do not fit together.
        """
        sections = PolicySections.of(config)
        backbone_cls, sizes = read_backbone(sections.backbone)
        embodiment_of(config)  # raises an error before anything is built

        # The integration, which decides on the backbone's extra experts.
        integration = Integration(sizes)
        if sections.integration:
            name: Any = sections.integration.get("name")
            unsupported = extension_points(INTEGRATIONS[name]) - backbone_cls.supports
            if unsupported:
                raise UserError(
                    f"The backbone {sections.backbone['name']!r} has no place for"
                    f" {listed(sorted(unsupported))} of the integration {name!r}; it hosts"
                    f" {listed(sorted(backbone_cls.supports))}. Choose another integration or"
                    " backbone."
                )
            integration = INTEGRATIONS.build(sections.integration, sizes)
        experts = integration.extra_experts()

        # The backbone, whose weights are not initialised if a checkpoint is loaded next.
        with nullcontext() if fresh_backbone else shapes_only():
            backbone = backbone_cls(sizes, experts)
        if not fresh_backbone:
            backbone.to_empty(device=torch.get_default_device())
            if isinstance(backbone, HasExtraExperts):
                backbone.init_experts(list(experts))

        memory: MemoryModule | None = None
        if sections.memory:
            memory = build_memory(
                sections.memory, backbone.vision_width, backbone.grid, integration.memory_width
            )
        cls._check_parts(sections, integration, memory, backbone_cls.supports)
        return cls(backbone, memory, integration, processor, config, **policy_options(cls, config))

    _check_parts = staticmethod(check_integrated)

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        return self.model.training_noise(count, generator)

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        return self.model.sampling_noise(generator)

    def augmentation_params(self, count: int, generator: torch.Generator) -> Noise:
        """While training with augmentation `changes` [n, …]: random numbers that change a sample's
        images.
        """
        if self.training and self.augment:
            return {"changes": augmentation_draws(count, generator)}
        return {}

    def forward(
        self,
        batch: Batch,
        noise: Mapping[str, Tensor] | Tensor | None = None,
        time: Tensor | None = None,
        memory: MemoryTokens | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean loss of a batch, and metrics to log (detached).

        Args:
            batch: with `actions`.
            noise: as `training_noise` makes it, sampled by default; of a flow also its noise [b, h,
                a] alone, with the times beside it. In training `augmentation_params` may be beside
                it, else they are sampled.
            time: flow times [b], if `noise` is a tensor; sampled by default.
            memory: memory tokens; by default those of `batch.history`.

        Returns:
            The loss and its metrics. Auxiliary losses are `losses/<name>`, unweighted. The memory's
            own begin with `memory/` and are present while `memory.reporting`.
        """
        # The random numbers of the loss and of the augmentation: as given, the others sampled.
        count, generator = len(batch.prompt), torch.default_generator
        draws = named_noise(noise, time)
        is_complete = isinstance(noise, Mapping) or (noise is not None and time is not None)
        if not draws or not is_complete:
            draws = self.training_noise(count, generator) | draws
        if "changes" not in draws:
            draws = self.augmentation_params(count, generator) | draws
        draws = map_noise(draws, lambda value: value.to(self.device))
        augmentation = draws.pop("changes", None)

        metrics: dict[str, Tensor] = {}
        loss = self.model.loss(batch, draws, memory, augmentation, metrics)
        return loss, metrics

    def predict(
        self, batch: Batch, x_t: Tensor, time: Tensor, memory: MemoryTokens | None = None
    ) -> Tensor:
        """The network's output [b, h, a] of a backbone with a flow head, at noisy chunks x_t [b, h,
        a] and times [b], in one pass. The head `flow` reads it as a velocity, `clean_flow` as a
        chunk.
        """
        assert isinstance(self.backbone, HasFlowHead)
        if memory is None:
            memory = self.model.memory_tokens(batch)
        with self.autocast():
            injection = self.model.inject(self.model.prepare_images(batch), memory)
            return self.backbone.predictor(batch, injection)(x_t, time)

    def recompute(self, mode: Recompute) -> None:
        if not isinstance(self.backbone, Recomputes):
            name = type(self.backbone).__name__
            raise UserError(
                f"train.gradient_checkpointing={mode}: {name} does not inherit from"
                " mme_vla.speed.Recomputes. Set it to false."
            )
        self.backbone.recompute(mode)

    def compile(self, **options: Any) -> None:
        """Compile the backbone's tower and layers in place, each by itself, and what memory and
        integration override `compile` for.
        """
        self.backbone.compile(**options)
        compile_parts(self.memory, **options)
        compile_parts(self.integration, **options)

    def shard_groups(self) -> Sequence[ShardGroup]:
        """The vision tower as one group, each layer of the rest of the backbone, and each module
        with `shard_alone = True`, such as a large embedding, in float32. Memory and integration are
        in none: they are small, and compute in float32.
        """
        tower = self.backbone.vision
        in_tower = set(tower.modules())
        groups = [ShardGroup(tower, full=True)]
        for layer in stacked_layers(self.backbone):
            if layer not in in_tower:
                groups.append(ShardGroup(layer))
        for module in self.backbone.modules():
            if getattr(module, "shard_alone", False):
                groups.append(ShardGroup(module, full=True))
        return groups

    def transform_images(self, images: Tensor, augmentation: Tensor | None) -> Tensor:
        """Views in [−1, 1], augmented as the cameras of the embodiment say."""
        views = to_unit_range(images)
        if augmentation is None:
            return views
        augmentations = [camera.augment for camera in self.embodiment.cameras]
        return augment_views(views, augmentations, augmentation)

    # Sampling

    @torch.no_grad()
    def sample_actions(
        self,
        batch: Batch,
        noise: Mapping[str, Tensor] | Tensor | None = None,
        steps: int | None = None,
        generator: torch.Generator | None = None,
        memory: MemoryTokens | None = None,
    ) -> Tensor:
        """A normalised chunk [b, h, a].

        Args:
            noise: as `sampling_noise` makes it, with a batch axis; of a flow also its noise [b, h,
                a] alone.
            steps: Euler steps of a flow; 10 by default, as released.
            generator: source of new noise, on the CPU.
            memory: memory tokens; by default those of `batch.history`.
        """
        if noise is None:
            noise = draw_noise(self, len(batch.prompt), generator)
        values = map_noise(named_noise(noise), lambda value: send(value, self.device))
        # Real-time chunking also runs the network backwards, which a graph does not contain.
        if self._sampler is None or self.training or batch.overlap is not None:
            return self.model.sample(batch, values, steps, memory)
        if memory is None:
            memory = self.model.memory_tokens(batch)
        steps = self.info.sample_steps if steps is None else steps
        return self._sampler(batch, values, steps, memory)

    def compile_sampling(
        self, layers: bool = False, report: Callable[[str], object] = lambda text: None
    ) -> bool:
        """Speed up sampling with fixed weights; chunks are equal up to the rounding of other
        kernels.

        What depends on the flow time alone is computed once and kept. On a GPU a chunk becomes one
        CUDA graph for each batch size, captured when it first occurs; here for one episode and
        every length of prompt. Layers are compiled for the same lengths.

        Args:
            layers: compile the tower and the layers too, which takes a minute or more at full size.
            report: gets a line for each length that is ready.

        Returns:
            Whether this backbone has a sampler that can be captured.
        """
        if not isinstance(self.backbone, CapturableSampling):
            return False
        stamp = self.backbone.compile_sampling(layers)
        if layers:
            compile_parts(self.integration, **SAMPLING_OPTIONS)
        on_gpu = self.device.type == "cuda"
        if on_gpu:
            self._sampler = CapturedSampling(self.model.sample, stamp)
        if self.processor is None or not (on_gpu or layers):
            return True
        full = self.full_batch(self.device)
        lengths = range(16, self._prompt_length() + 16, 16)
        for index, length in enumerate(lengths):
            begun = time.perf_counter()
            prompt = full.prompt[:, :length]
            prompt_mask = full.prompt_mask[:, :length]
            self.sample_actions(replace(full, prompt=prompt, prompt_mask=prompt_mask))
            took = time.perf_counter() - begun
            report(
                f"prompts of {length} tokens are ready: {index + 1} of {len(lengths)}, {took:.1f} s"
            )
        return True

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

    def predict_chunk(
        self,
        batch: Batch,
        episodes: Sequence[Episode],
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """A chunk for the batch of `observation`, with the episodes' memories."""
        memory = self.encode_memories(episodes, batch)
        return self.sample_actions(batch, noise, steps, memory=memory)

    @torch.no_grad()
    def encode_memories(
        self, episodes: Sequence[Episode], batch: Batch | None = None
    ) -> MemoryTokens | None:
        """Memory tokens of running episodes, from their histories and streams.

        Args:
            batch: of `observation`, whose prompts the backbone may read stored tokens with; made
                by default.
        """
        if self.memory is None:
            return None
        if batch is None:
            batch = self.observation(episodes)
        with self.autocast():
            histories = []
            for i, episode in enumerate(episodes):
                with_prompt = self.model.prompt_condition(batch.rows(slice(i, i + 1)))
                history = PromptConditionedHistory(episode.required_history(), with_prompt)
                if type(self.backbone).condition_on_prompt is not Backbone.condition_on_prompt:
                    episode.renew_stream(batch.prompt[i, batch.prompt_mask[i]])
                episode.read = history
                histories.append(history)
            return self.memory.encode(histories, [episode.stream for episode in episodes])

    @property
    def memory_tower(self) -> MemoryTower:
        return MemoryTower(
            self.backbone.vision,
            self.backbone.encode_images,
            self.backbone.vision_width,
            self.backbone.image_size,
        )

    def full_batch(self, device: torch.device | str = "cpu") -> Batch:
        """A batch of one without content: all views, the longest prompt without padding, and a
        memory that is full.
        """
        size = self.backbone.image_size
        views = len(self.embodiment.cameras)
        length = self._prompt_length()
        batch = Batch(
            images=torch.zeros(1, views, 3, size, size, dtype=torch.uint8, device=device),
            image_mask=torch.ones(1, views, dtype=torch.bool, device=device),
            prompt=torch.full((1, length), 5, device=device),
            prompt_mask=torch.ones(1, length, dtype=torch.bool, device=device),
            actions=torch.zeros(1, self.horizon, self.action_dim, device=device),
        )
        if self.memory is not None:
            batch.history = full_history(self.memory, self.backbone.vision_width, device)
            batch.past = full_past(self.memory.past_view_spec, views, size, device)
        return batch

    def _prompt_length(self) -> int:
        words = int(PolicySections.of(self.config).processor["prompt_length"])
        return words + self.embodiment.action.options_length

    @property
    def finetune_spec(self) -> FineTuneSpec:
        """The backbone's components in its order; memory, integration and its experts are the
        component `memory`.
        """
        spec = self.backbone.finetune_spec
        components = {}
        for name, pattern in spec.components.items():
            components[name] = rf"backbone\.(?:{pattern})"
        of_memory = r"memory\.|integration\."
        if "memory" in components:
            of_memory += f"|{components['memory']}"
        components["memory"] = of_memory
        frozen = None if spec.frozen is None else rf"backbone\.(?:{spec.frozen})"
        return replace(spec, components=components, frozen=frozen)


def mme_of(policy: Policy, what: str) -> MMEPolicy:
    """The policy, where it is made of backbone, memory and integration."""
    if not isinstance(policy, MMEPolicy):
        raise UserError(
            f"{what} requires a policy of backbone, memory and integration; "
            f"{PolicySections.of(policy.config).name or 'this'} is a {type(policy).__name__}."
        )
    return policy
