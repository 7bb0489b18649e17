"""π0.5: what turns images, prompt, noisy actions and flow time into blocks, and the answer into a velocity."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.backbone import flow
from mme_vla.backbone.attention import check_backend
from mme_vla.backbone.base import Backbone, Inject, Injection, Noise
from mme_vla.backbone.blocks import Block
from mme_vla.backbone.config import BackboneConfig, ExpertConfig
from mme_vla.backbone.gemma import Conditioning, JointTransformer, KVCache, Layout
from mme_vla.backbone.layers import AdaRMSNorm, RMSNorm, float32_linear
from mme_vla.backbone.siglip import VisionTower, pool_grid
from mme_vla.registry import BACKBONES
from mme_vla.speed.recompute import Recompute
from mme_vla.speed.rtc import rtc_guidance
from mme_vla.speed.sharding import ShardGroup
from mme_vla.types import Batch, PastViews

EULER_STEPS = 10  # as released


@BACKBONES.register("pi05")
class Pi05Backbone(Backbone):
    """Vision tower, VLM expert and action expert under joint attention; chunks by flow matching.

    It knows nothing of memory: extra experts are just more columns.
    """

    Config = BackboneConfig
    sample_steps = EULER_STEPS
    supports = frozenset({"blocks", "expert", "hook", "condition", "beside", "positions", "past"})
    supports_rtc = True
    compiles_sampling = True
    heads = ("action_in", "action_out", "time_in", "time_out")
    # `kv` is what the VLM's last layer has in place of `qkv`.
    lora_targets = tuple(
        f"experts.{expert}.{layer}"
        for expert in ("vlm", "action")
        for layer in ("qkv", *(("kv",) if expert == "vlm" else ()), "out", "mlp.gate_up", "mlp.down")
    )
    # These are computed in float32 from their weight alone, past any adapter that wraps them.
    lora_exclude = rf"\.({'|'.join(heads)}|\w*norm\.dense)$"
    PARTS: ClassVar[Mapping[str, str]] = {
        "vision": r"vision\.",
        "vlm": r"embedding\.|.*\.experts\.vlm\.",
        "memory": r".*\.experts\.(?!action\.)",
        "action": "",
    }

    def __init__(self, config: BackboneConfig, extra_experts: Mapping[str, ExpertConfig] | None = None) -> None:
        super().__init__(config, extra_experts)
        self.config = config
        self.vision_width = self.token_width = config.vlm.width
        self.output_width = width = config.action.width
        self.depth, self.head_dim = config.depth, config.head_dim
        self.vocab_size = config.vocab_size
        self.image_size, self.grid = config.vision.image_size, config.vision.image_size // config.vision.patch_size
        self.horizon, self.action_dim = config.horizon, config.action_dim
        # The vision tower comes first: with one seed it is the same in every variant, and so is a cache made by it.
        self.vision = VisionTower(config.vision, config.vlm.width)
        initialise(self.vision)
        self.embedding = nn.Embedding(config.vocab_size, config.vlm.width)
        experts = {**(extra_experts or {}), "vlm": config.vlm, "action": config.action}
        self.transformer = JointTransformer(config, experts)
        self.keep_times = False
        self._cached: dict[int, Conditioning] = {}
        self._cached_stamp: tuple[object, ...] = ()
        self.action_in = nn.Linear(config.action_dim, width)
        self.action_out = nn.Linear(width, config.action_dim)
        self.time_in = nn.Linear(width, width)
        self.time_out = nn.Linear(width, width)
        for module in (self.embedding, self.transformer, self.action_in, self.action_out, self.time_in, self.time_out):
            initialise(module)

    def init_experts(self, names: Sequence[str]) -> None:
        """Give these experts fresh weights in every layer."""
        for block in self.transformer.layers:
            for name in names:
                initialise(block.experts[name])  # type: ignore[index, arg-type]

    def compile(self, **options: Any) -> None:
        """Compile the vision tower and every layer in place, each by itself: quick to compile, and shardable still.

        Lengths are symbols, so that prompts and batches of any length share their code; nothing falls back to eager
        unnoticed (`fullgraph`). `options` are `torch.compile`'s and go before these.
        """
        # Layers share one code: each passes it in training, prefill and denoising, with and without gradients.
        torch._dynamo.config.recompile_limit = max(torch._dynamo.config.recompile_limit, 64)
        for module in (self.vision, *self.transformer.layers):
            module.compile(**{"fullgraph": True, "dynamic": True, **options})

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → tokens [n, 256, d]; no graph is kept while the tower is frozen."""
        return self._through_tower(images)

    def _through_tower(self, images: Tensor, *clips: Any) -> Tensor:
        frozen = not any(p.requires_grad for p in self.vision.parameters())
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            return self.vision(images, *clips)

    def view_tokens(self, images: Tensor, past: PastViews | None) -> Tensor:
        """Tokens [b, v, n, d] of current views [b, v, 3, s, s], which look back at past ones where there are any."""
        if past is None:
            return self.encode_images(images.flatten(0, 1)).unflatten(0, images.shape[:2])
        clips = torch.cat([past.images, images[:, None]], 1).transpose(1, 2)  # b v t 3 s s
        frame_mask = functional.pad(past.mask, (0, 1), value=True)[:, None].expand(clips.shape[:3])
        return self._through_tower(clips.flatten(0, 1), frame_mask.flatten(0, 1), past.every).unflatten(
            0, clips.shape[:2]
        )

    def pooled_tokens(self, images: Tensor, grid: int, pooling: str) -> Tensor:
        """Tokens [n, grid², d] as memories store them."""
        return pool_grid(self.encode_images(images), grid, pooling)

    def observation_blocks(self, batch: Batch, images: Tensor) -> list[Block]:
        """Blocks of the current views and the prompt.

        Args:
            batch: masks, prompt, and past views where there are any, in [−1, 1].
            images: [b, v, 3, s, s] in [−1, 1], augmented if need be.
        """
        tokens = self.view_tokens(images, batch.past)
        image_mask = batch.image_mask[:, :, None].expand(tokens.shape[:3]).flatten(1)
        # Token embeddings are scaled by √d, image tokens are not.
        words = self.embedding(batch.prompt) * self.config.vlm.width**0.5
        return [
            Block("images", tokens.flatten(1, 2), image_mask, "vlm"),
            Block("prompt", words, batch.prompt_mask, "vlm"),
        ]

    def action_block(self, x_t: Tensor) -> Block:
        """The noisy chunk [b, h, a] as the block that answers."""
        mask = torch.ones(x_t.shape[:2], dtype=torch.bool, device=x_t.device)
        return Block("action", float32_linear(self.action_in, x_t), mask, "action")

    def time_condition(self, time: Tensor) -> Tensor:
        """Condition [b, d_action] of the adaptive norms for flow times [b], in float32."""
        x = flow.time_embedding(time, self.config.action.width)
        for layer in (self.time_in, self.time_out):
            x = nn.functional.silu(float32_linear(layer, x))
        return x

    def read_velocity(self, hidden: Tensor) -> Tensor:
        """Read the velocity [b, h, a] off the answer [b, n, d], whose last h tokens are the actions; in float32."""
        return float32_linear(self.action_out, hidden[:, -self.horizon :])

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """`noise` [n, h, a] and flow times `time` [n]."""
        noise = torch.randn(count, self.horizon, self.action_dim, generator=generator)
        return {"noise": noise, "time": flow.sample_time(count, self.config.time_distribution, noise.device, generator)}

    def loss(self, batch: Batch, images: Tensor, inject: Inject, draws: Mapping[str, Tensor]) -> Tensor:
        """The flow-matching loss [b, h]."""
        assert batch.actions is not None
        x_t, target = flow.interpolate(batch.actions.float(), draws["noise"], draws["time"])
        return flow.step_loss(self.velocity(batch, images, inject, x_t, draws["time"]), target)

    def velocity(self, batch: Batch, images: Tensor, inject: Inject, x_t: Tensor, time: Tensor) -> Tensor:
        """Predicted velocity [b, h, a] at noisy chunks x_t [b, h, a] and times [b], in one joint pass."""
        injection = inject(self.observation_blocks(batch, images))
        blocks = [*injection.blocks, *injection.beside, self.action_block(x_t)]
        layout = self.transformer.layout(blocks, injection.visibility)
        condition = self.time_condition(time)
        condition = condition if injection.condition is None else injection.condition(condition)
        hidden, _ = self.transformer(blocks, layout, condition, injection.hook)
        return self.read_velocity(hidden)

    def set_attention_backend(self, backend: str) -> None:
        """See `Backbone`; all of them are for this one."""
        self.transformer.attention = check_backend(backend)

    def recompute(self, mode: Recompute) -> None:
        """Recompute layers in the backward pass (activation checkpointing)."""
        self.transformer.gradient_checkpointing = mode

    def shard_groups(self) -> Sequence[ShardGroup]:
        """Tower, token embedding, and every layer of all experts."""
        return [*super().shard_groups(), ShardGroup(self.embedding, full=True)]

    # Sampling

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The starting `noise` [h, a]."""
        return {"noise": torch.randn(self.horizon, self.action_dim, generator=generator)}

    @torch.no_grad()
    def sample(
        self, batch: Batch, images: Tensor, inject: Inject, draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        """Integrate the flow from noise to a chunk, in `steps` Euler steps (10 by default).

        All that does not depend on the flow time runs once: memory, prefix keys and values, the modulator's keys and
        values, and every layer's time modulation. A step runs the action block alone.
        """
        noise, steps = draws["noise"], EULER_STEPS if steps is None else steps
        prefix, injection = self.prefill(batch, images, inject)
        blocks = [*injection.beside, self.action_block(noise)]
        layout = self.transformer.layout(blocks, injection.visibility, prefix)
        past = prefix.preallocate(sum(map(len, blocks)))
        if injection.condition is None:
            conditions, rows = self.conditions(steps), 1
        else:  # what memory says differs from sample to sample: every time for each
            rows, condition = len(noise), self.time_condition(flow.euler_times(steps, noise.device))
            changed = torch.cat([injection.condition(one.expand(rows, -1)) for one in condition])
            conditions = self.transformer.conditioning(changed)

        def velocity(x: Tensor, i: int) -> Tensor:
            return self.denoise(x, conditions.at(i, rows), layout, past, injection)

        if batch.overlap is None:
            return flow.euler(noise, steps, velocity)
        times = flow.euler_times(steps, noise.device)
        return flow.euler(noise, steps, rtc_guidance(velocity, batch.overlap, times))

    def conditions(self, steps: int) -> Conditioning:
        """Every layer's time modulations at the times of so many steps; kept for the next chunk while `keep_times`."""
        if not self.keep_times:
            return self._conditions(steps)
        stamp = self.sampling_stamp()
        if stamp != self._cached_stamp:
            self._cached, self._cached_stamp = {}, stamp
        if steps not in self._cached:
            self._cached[steps] = self._conditions(steps)
        return self._cached[steps]

    def sampling_stamp(self) -> tuple[object, ...]:
        """What kept time modulations were computed from: the weights by place and version, and their precision."""
        layers = self.transformer.modulating()
        weights = [p for module in (self.time_in, self.time_out, *layers) for p in module.parameters()]
        return torch.is_autocast_enabled(self.device.type), *((p.data_ptr(), p._version) for p in weights)

    def _conditions(self, steps: int) -> Conditioning:
        return self.transformer.conditioning(self.time_condition(flow.euler_times(steps, self.device)))

    def compile_sampling(self) -> None:
        """Keep the time modulations; see `Backbone`."""
        self.keep_times = True

    def prefill(self, batch: Batch, images: Tensor, inject: Inject) -> tuple[KVCache, Injection]:
        """Run what a chunk's steps share: keys and values of the prefix, and what the memory injects."""
        injection = inject(self.observation_blocks(batch, images))
        layout = self.transformer.layout(injection.blocks, injection.visibility)
        _, prefix = self.transformer(injection.blocks, layout, keep=True)
        return prefix, injection

    def denoise(
        self, x_t: Tensor, condition: Tensor | Conditioning, layout: Layout, prefix: KVCache, injection: Injection
    ) -> Tensor:
        """The velocity at one flow time, from the cached prefix: what one Euler step costs."""
        blocks = [*injection.beside, self.action_block(x_t)]
        hidden, _ = self.transformer(blocks, layout, condition, injection.hook, past=prefix)
        return self.read_velocity(hidden)

    # Parts

    def parts(self) -> Mapping[str, str]:
        """Tower and projector; embedding and VLM expert; experts that an integration asked for; all else acts."""
        return self.PARTS


def initialise(module: nn.Module) -> None:
    """Fresh weights: LeCun normal matrices, zero biases, unit-variance embeddings; adaptive norms keep their zeros."""
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
