"""π0.5: embed images and prompt, the flow-matching loss, and the sampler, in this order."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.backbone.base import (
    Backbone,
    BackboneConfig,
    ExpertConfig,
    FineTuneSpec,
    HasExtraExperts,
    Injection,
)
from mme_vla.backbone.flow import HasFlowHead, Predict, build_head, time_embedding
from mme_vla.backbone.gemma import JointTransformer, TimeModulations, read_out
from mme_vla.backbone.layers import AdaRMSNorm, Block, RMSNorm, check_backend, float32_linear
from mme_vla.backbone.siglip import VisionTower
from mme_vla.registry import BACKBONES
from mme_vla.speed import (
    SAMPLING_OPTIONS,
    CapturableSampling,
    HasAttentionBackends,
    Recompute,
    Recomputes,
)
from mme_vla.types import Batch, Noise, PastViews


@BACKBONES.register("pi05")
class Pi05Backbone(
    Backbone,
    HasFlowHead,
    HasExtraExperts,
    HasAttentionBackends,
    Recomputes,
    CapturableSampling,
):
    """Vision tower, VLM expert and action expert under joint attention; chunks by flow matching.

    Extra experts are more columns of the same joint attention.
    """

    Config = BackboneConfig
    supports = frozenset({"blocks", "expert", "hook", "condition", "beside", "positions", "past"})
    finetune_spec = FineTuneSpec(
        {
            "vision": r"vision\.",  # tower and projector
            "vlm": r"embedding\.|.*\.experts\.vlm\.",
            "memory": r".*\.experts\.(?!action\.)",  # extra experts of an integration
            "action": "",
        },
        # The VLM's last layer has `kv` in place of `qkv`.
        lora_targets=(
            "experts.vlm.qkv",
            "experts.vlm.kv",
            "experts.vlm.out",
            "experts.vlm.mlp.gate_up",
            "experts.vlm.mlp.down",
            "experts.action.qkv",
            "experts.action.out",
            "experts.action.mlp.gate_up",
            "experts.action.mlp.down",
        ),
        full_train=("action_in", "action_out", "time_in", "time_out"),
        # These are computed in float32 from their weight, without calling an adapter that wraps
        # them.
        lora_exclude=r"\.(action_in|action_out|time_in|time_out|\w*norm\.dense)$",
    )

    def __init__(
        self, config: BackboneConfig, extra_experts: Mapping[str, ExpertConfig] | None = None
    ) -> None:
        super().__init__(config, extra_experts)
        self.config = config
        width = config.action.width
        self.vision_width = config.vlm.width
        self.image_size = config.vision.image_size
        self.grid = config.vision.image_size // config.vision.patch_size
        self.horizon = config.horizon
        self.action_dim = config.action_dim
        # The vision tower comes first: with one seed it is the same in every variant, and so is a
        # cache made by it.
        self.vision = VisionTower(config.vision, config.vlm.width)
        initialise(self.vision)
        self.embedding = nn.Embedding(config.vocab_size, config.vlm.width)
        self.embedding.shard_alone = True  # type: ignore[assignment]  # see `shard_groups`
        experts = {**(extra_experts or {}), "vlm": config.vlm, "action": config.action}
        self.transformer = JointTransformer(config, experts)
        self._float32_linear: Callable[[nn.Linear, Tensor], Tensor] = float32_linear
        self.keep_times = False
        self._cached: dict[tuple[int, torch.dtype], TimeModulations] = {}
        self._cached_stamp: tuple[object, ...] = ()
        self.action_in = nn.Linear(config.action_dim, width)
        self.action_out = nn.Linear(width, config.action_dim)
        self.time_in = nn.Linear(width, width)
        self.time_out = nn.Linear(width, width)
        for module in (
            self.embedding,
            self.transformer,
            self.action_in,
            self.action_out,
            self.time_in,
            self.time_out,
        ):
            initialise(module)
        self.head = build_head(config)

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → tokens [n, 256, d]; no graph is kept while the tower is
        frozen.
        """
        return self._through_tower(images)

    def _through_tower(self, images: Tensor, *clips: Any) -> Tensor:
        frozen = not any(p.requires_grad for p in self.vision.parameters())
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            return self.vision(images, *clips)

    def view_tokens(self, images: Tensor, past: PastViews | None) -> Tensor:
        """Tokens [b, v, n, d] of current views [b, v, 3, s, s], which attend to past ones if there
        are any.
        """
        if past is None:
            return self.encode_images(images.flatten(0, 1)).unflatten(0, images.shape[:2])
        clips = torch.cat([past.images, images[:, None]], 1).transpose(1, 2)  # b v t 3 s s
        frame_mask = functional.pad(past.mask, (0, 1), value=True)[:, None].expand(clips.shape[:3])
        return self._through_tower(
            clips.flatten(0, 1), frame_mask.flatten(0, 1), past.every
        ).unflatten(0, clips.shape[:2])

    def embed(self, batch: Batch) -> list[Block]:
        """Blocks `images`, of the current views, and `prompt`."""
        tokens = self.view_tokens(batch.images, batch.past)
        image_mask = batch.image_mask[:, :, None].expand(tokens.shape[:3]).flatten(1)
        # Token embeddings are scaled by √d, image tokens are not.
        words = self.embedding(batch.prompt) * self.config.vlm.width**0.5
        return [
            Block("images", tokens.flatten(1, 2), image_mask, "vlm"),
            Block("prompt", words, batch.prompt_mask, "vlm"),
        ]

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """`noise` [n, h, a] and flow times `time` [n]."""
        return self.head.training_noise(count, generator)

    def loss(self, batch: Batch, injection: Injection, noise: Mapping[str, Tensor]) -> Tensor:
        """The flow-matching loss [b, h]."""
        assert batch.actions is not None
        return self.head.loss(self.predictor(batch, injection), batch.actions, noise)

    def predictor(self, batch: Batch, injection: Injection) -> Predict:
        return partial(self.predict, injection)

    def predict(self, injection: Injection, x_t: Tensor, time: Tensor) -> Tensor:
        """The network's output [b, h, a] at noisy chunks x_t [b, h, a] and times [b], in one joint
        pass.
        """
        blocks = [*injection.blocks, *injection.beside, self.action_block(x_t)]
        layout = self.transformer.layout(blocks, injection.visibility)
        condition = self.time_condition(time)
        if injection.condition is not None:
            condition = injection.condition(condition)
        hidden = self.transformer(blocks, layout, condition, injection.hook)
        return self.project_actions(hidden)

    def action_block(self, x_t: Tensor) -> Block:
        """The noisy chunk [b, h, a] as the block of the action expert."""
        mask = torch.ones(x_t.shape[:2], dtype=torch.bool, device=x_t.device)
        return Block("action", self._float32_linear(self.action_in, x_t), mask, "action")

    def time_condition(self, time: Tensor) -> Tensor:
        """Condition [b, d_action] of the adaptive norms for flow times [b], in float32."""
        x = time_embedding(time, self.config.action.width)
        for layer in (self.time_in, self.time_out):
            x = nn.functional.silu(float32_linear(layer, x))
        return x

    def project_actions(self, hidden: Tensor) -> Tensor:
        """The network's output [b, h, a] in float32, which its head reads. The last h tokens of [b,
        n, d] are the actions.
        """
        return self._float32_linear(self.action_out, hidden[:, -self.horizon :])

    # Sampling

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The starting `noise` [h, a]."""
        return self.head.sampling_noise(generator)

    @torch.no_grad()
    def sample(
        self,
        batch: Batch,
        injection: Injection,
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """Integrate the flow from noise to a chunk [b, h, a], in `steps` Euler steps (10 by
        default).

        All that does not depend on x is computed once: keys and values of the prefix, and every
        layer's modulations of all times. A step runs the action block and the blocks beside it.
        Memory tokens are encoded before, by the model or the policy, and the modulator's keys and
        values of them come with `injection`.
        """
        steps = self.head.steps if steps is None else steps
        x = self.head.start(noise, steps, batch.overlap)
        times = self.head.times(steps, x.device)

        # Prefill: one pass over images, prompt and memory blocks leaves their keys and values in a
        # cache with space for a step's own.
        step_blocks = [*injection.beside, self.action_block(x)]  # only lengths and masks are read
        step_length = sum(len(block) for block in step_blocks)
        space = self.transformer.cache_space(injection.blocks, step_length)
        prefix_layout = self.transformer.layout(injection.blocks, injection.visibility)
        self.transformer(injection.blocks, prefix_layout, past=space)
        prefix = space.after(prefix_layout)

        # What all steps share: mask and angles, and the time modulations of every layer.
        step_layout = self.transformer.layout(step_blocks, injection.visibility, prefix)
        if injection.condition is None:
            rows = 1
            modulations = self.time_modulations(len(times), step_layout.dtype)
        else:  # as memory changes it for each sample
            rows = len(x)
            conditions = self.changed_conditions(injection.condition, times, rows)
            modulations = self.transformer.time_modulations(conditions, step_layout.dtype)

        def predict_at(x_t: Tensor, index: int) -> Tensor:
            # Its keys and values go behind the prefix, where the next step overwrites them.
            blocks = [*injection.beside, self.action_block(x_t)]
            condition = modulations.at(index, rows)
            hidden = self.transformer(blocks, step_layout, condition, injection.hook, prefix)
            return self.project_actions(hidden)

        velocity = self.head.velocity(predict_at, times, noise)
        if batch.overlap is not None:
            from mme_vla.speed.rtc import rtc_guidance

            velocity = rtc_guidance(velocity, batch.overlap, times)

        # Euler steps from noise to actions.
        increments = noise.get("increments")
        for index in range(len(times)):
            scaled = None if increments is None else self.head.deviation * increments[:, index]
            x = self.head.step(x, velocity(x, index), len(times), scaled)
        return x

    def changed_conditions(
        self, change: Callable[[Tensor], Tensor], times: Tensor, rows: int
    ) -> Tensor:
        """The condition of every time, changed for each sample [times·rows, c]."""
        changed = []
        for condition in self.time_condition(times):
            changed.append(change(condition.expand(rows, -1)))
        return torch.cat(changed)

    def time_modulations(self, steps: int, dtype: torch.dtype) -> TimeModulations:
        """Every layer's time modulations at the times of so many steps; kept for the next chunk
        while `keep_times`.
        """
        stamp = self.sampling_stamp() if self.keep_times else ()
        key = steps, dtype
        if self.keep_times and stamp == self._cached_stamp and key in self._cached:
            return self._cached[key]
        times = self.head.times(steps, next(self.parameters()).device)
        modulations = self.transformer.time_modulations(self.time_condition(times), dtype)
        if self.keep_times:
            if stamp != self._cached_stamp:
                self._cached = {}
                self._cached_stamp = stamp
            self._cached[key] = modulations
        return modulations

    # Optional capabilities

    def init_experts(self, names: Sequence[str]) -> None:
        """Initialise these experts in every layer."""
        for block in self.transformer.layers:
            for name in names:
                initialise(block.experts[name])  # type: ignore[index, arg-type]

    def compile(self, **options: Any) -> None:
        """Compile the vision tower and every layer in place, each by itself: quick to compile, and
        shardable still.

        Lengths are symbols, so that prompts and batches of any length share their code. `fullgraph`
        reports what would fall back to eager. `options` are `torch.compile`'s and override these.
        """
        # Layers share one code: each passes it in training, prefill and denoising, with and without
        # gradients. Where lengths are no symbols it is compiled for every length of prompt and size
        # of batch, and beyond the limit `fullgraph` raises an error.
        limit = 64 if options.get("dynamic", True) else 1024
        for name in ("recompile_limit", "accumulated_recompile_limit"):
            setattr(torch._dynamo.config, name, max(getattr(torch._dynamo.config, name), limit))
        for module in (self.vision, *self.transformer.layers):
            module.compile(**{"fullgraph": True, "dynamic": True, **options})

    def set_attention_backend(self, name: str) -> None:
        self.transformer.attention = check_backend(name)

    def recompute(self, mode: Recompute) -> None:
        """Recompute layers in the backward pass (activation checkpointing)."""
        self.transformer.gradient_checkpointing = mode

    def compile_sampling(self, layers: bool = False) -> Callable[[], object]:
        """Keep the time modulations between chunks.

        Args:
            layers: compile tower and layers, and what is around the layers in an Euler step.
        """
        self.keep_times = True
        if layers:
            self.compile(**SAMPLING_OPTIONS)
            compiled = partial(torch.compile, fullgraph=True, **SAMPLING_OPTIONS)
            self._float32_linear = compiled(float32_linear)
            self.transformer.read_out = compiled(read_out)
        return self.sampling_stamp

    def sampling_stamp(self) -> tuple[object, ...]:
        """Place and version of the weights that time modulations are computed from, and the
        precision.
        """
        layers = self.transformer.time_norms()
        device = self.time_in.weight.device
        stamp: list[object] = [torch.is_autocast_enabled(device.type)]
        for module in (self.time_in, self.time_out, *layers):
            for parameter in module.parameters():
                stamp.append((parameter.data_ptr(), parameter._version))
        return tuple(stamp)


def initialise(module: nn.Module) -> None:
    """Fresh weights: LeCun normal matrices, zero biases, unit-variance embeddings; adaptive norms
    keep their zeros.
    """
    adaptive = {id(m.dense) for m in module.modules() if isinstance(m, AdaRMSNorm)}
    for m in module.modules():
        if isinstance(m, RMSNorm):
            nn.init.zeros_(m.scale)
        elif id(m) in adaptive:
            for parameter in m.parameters():
                nn.init.zeros_(parameter)
        elif isinstance(m, nn.Linear | nn.Conv2d):
            fan_in = m.weight[0].numel()
            nn.init.normal_(m.weight, std=fan_in**-0.5)
            if m.bias is not None:
                nn.init.zeros_(m.bias)
        elif isinstance(m, nn.Embedding):
            nn.init.normal_(m.weight, std=m.embedding_dim**-0.5)
    if isinstance(module, VisionTower):
        assert module.vit.pos_embed is not None
        nn.init.normal_(module.vit.pos_embed, std=0.02)
