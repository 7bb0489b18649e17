"""nano: a backbone of under five million parameters. Action tokens read images, words and memory; nothing else moves.

The prefix is not processed in layers: each layer of the action column attends to the context as it is. That makes a
training step on stored tokens cheap enough for a laptop, and leaves memory as many doors as it needs.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn

from mme_vla.backbone import flow
from mme_vla.backbone.attention import additive_mask, attend
from mme_vla.backbone.base import Backbone, Hook, Inject, Injection, Noise
from mme_vla.backbone.blocks import Block
from mme_vla.backbone.config import ExpertConfig, check_positive
from mme_vla.backbone.layers import AdaRMSNorm, RMSNorm
from mme_vla.backbone.nano_vision import CLASSES, ConvTower, load_shipped
from mme_vla.backbone.pi05 import initialise
from mme_vla.backbone.siglip import pool_grid
from mme_vla.errors import UserError
from mme_vla.registry import BACKBONES
from mme_vla.speed.recompute import Recompute
from mme_vla.speed.rtc import rtc_guidance
from mme_vla.types import Batch


@dataclass(frozen=True)
class TowerConfig:
    """The convolutional vision tower: channels of its stages over 32×32, 16×16 and 8×8 places of a 128-pixel image.

    `blocks_…` are residual blocks. `pretrained` takes the weights that ship with the library.
    """

    image_size: int = 128
    width_32: int = 48
    width_16: int = 96
    width_8: int = 160
    blocks_32: int = 1
    blocks_16: int = 1
    blocks_8: int = 2
    pretrained: bool = True

    def __post_init__(self) -> None:
        check_positive(self, "vision.")
        if self.image_size % 16:
            raise UserError(f"vision.image_size={self.image_size} must be a multiple of 16.")
        for width in (self.width_32, self.width_16, self.width_8):
            if width % 8:
                raise UserError(f"vision: {width} channels cannot be normalised in 8 groups; take a multiple of 8.")


@dataclass(frozen=True)
class NanoConfig:
    """A vision tower, a column of context tokens (`vlm`) and a column of action tokens that reads them (`action`)."""

    vision: TowerConfig = field(default_factory=TowerConfig)
    vlm: ExpertConfig = field(default_factory=lambda: ExpertConfig(128, 256))
    action: ExpertConfig = field(default_factory=lambda: ExpertConfig(128, 256))
    depth: int = 2
    num_heads: int = 4
    head_dim: int = 32
    state_dim: int = 8
    vocab_size: int = 2048
    action_dim: int = 8
    horizon: int = 4
    draws: int = 4
    time_distribution: str = "beta"

    def __post_init__(self) -> None:
        check_positive(self, "backbone.")
        if self.action.width % 2 or self.head_dim % 2:
            raise UserError("backbone.action.width and backbone.head_dim must be even.")
        if self.time_distribution not in ("beta", "uniform"):
            raise UserError(f"time_distribution={self.time_distribution!r}: choose 'beta' or 'uniform'.")


EULER_STEPS = 10
MAX_VIEWS, MAX_WORDS = 4, 256
FIRST = CLASSES.index("red cube") - 1
"""Where, among the classes of a token, what the goal names stands."""
STATE_FREQUENCIES = (1.0, 4.0, 16.0, 64.0)
"""Per radian or metre: a finger's four centimetres count as well as a joint's turn."""


class Reader(nn.Module):
    """One layer of the action column: attention among a chunk's actions, attention to the context, and an MLP."""

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        width, inner = config.action.width, config.num_heads * config.head_dim
        self.head_dim = config.head_dim
        self.norm = AdaRMSNorm(width, width)
        self.qkv = nn.Linear(width, 3 * inner, bias=False)
        self.out = nn.Linear(inner, width, bias=False)
        self.read_norm = AdaRMSNorm(width, width)
        self.read_q = nn.Linear(width, inner, bias=False)
        self.read_gate = nn.Linear(width, inner)
        self.read_out = nn.Linear(inner, width, bias=False)
        self.mlp_norm = AdaRMSNorm(width, width)
        self.up = nn.Linear(width, 2 * config.action.mlp_dim)
        self.down = nn.Linear(config.action.mlp_dim, width)

    def forward(
        self, x: Tensor, condition: Tensor, k: Tensor, v: Tensor, mask: Tensor, draws: int, hook: Hook | None, at: int
    ) -> Tensor:
        """The action tokens [b·r, h, d] after this layer.

        Args:
            condition: [b·r, d]. k, v: of the context, [b, n, N, h]; mask: additive [b, 1, 1, n]. draws: r.
            hook: what changes the MLP's input. at: the layer's number.
        """
        normed, gate = self.norm(x, condition)
        q, new_k, new_v = self.qkv(normed).unflatten(-1, (-1, self.head_dim)).chunk(3, dim=-2)
        x = x + (1 + gate) * self.out(attend(q, new_k, new_v, None))
        normed, gate = self.read_norm(x, condition)
        q = self.read_q(normed).unflatten(-1, (-1, self.head_dim))
        # The draws of a sample read the same context: they stand side by side as its queries.
        together = q.unflatten(0, (-1, draws)).flatten(1, 2)
        read = attend(together, k, v, mask).unflatten(1, (draws, -1)).flatten(0, 1)
        # What the goal asks for decides what of it counts: products are learned sooner here than behind the MLP.
        x = x + (1 + gate) * self.read_out(read * self.read_gate(condition)[:, None])
        if hook is not None:
            rows = x.unflatten(0, (-1, draws)).unbind(1)
            x = torch.stack([hook(at, row) for row in rows], 1).flatten(0, 1)
        normed, gate = self.mlp_norm(x, condition)
        inner, opening = self.up(normed).chunk(2, dim=-1)
        return x + (1 + gate) * self.down(nn.functional.gelu(inner) * opening)


class Column(nn.Module):
    """What a block of context becomes for the action column: keys and values of every layer, in one product."""

    def __init__(self, width: int, config: NanoConfig) -> None:
        super().__init__()
        self.shape = (config.depth, 2, config.num_heads, config.head_dim)
        self.norm = RMSNorm(width)
        self.kv = nn.Linear(width, math.prod(self.shape), bias=False)

    def forward(self, tokens: Tensor) -> Tensor:
        """[b, n, d] → [layers, 2, b, n, N, h]."""
        return self.kv(self.norm(tokens)[0]).unflatten(-1, self.shape).movedim((2, 3), (0, 1))


@BACKBONES.register("nano")
class NanoBackbone(Backbone):
    """A pretrained convolutional tower, and layers of action tokens that read the context; chunks by flow matching.

    The network predicts the chunk without its noise, and the velocity follows. The loss takes several noisy versions of
    each sample, which share the context.
    """

    vision: ConvTower
    Config = NanoConfig
    supports = frozenset({"blocks", "expert", "hook"})
    supports_rtc = True
    lora_targets = ("qkv", "read_q", "out", "read_out", "up", "down")
    heads = ("action_in", "action_out", "state_in", "prompt_in")
    lora_exclude = r"\.\w*norm\.dense$"
    PARTS: ClassVar[Mapping[str, str]] = {
        "vision": r"vision\.",
        "vlm": r"embedding\.|places\.|views\.|positions\.|see\.|see_in\.|prompt_in\.|columns\.vlm\.",
        "memory": r"columns\.",
        "action": "",
    }

    def __init__(self, config: NanoConfig, extra_experts: Mapping[str, ExpertConfig] | None = None) -> None:
        super().__init__(config, extra_experts)
        self.config = config
        tower, width, action_width = config.vision, config.vlm.width, config.action.width
        self.token_width = width
        self.output_width = action_width
        self.depth, self.head_dim = config.depth, config.head_dim
        self.image_size, self.grid = tower.image_size, tower.image_size // 16
        self.horizon, self.action_dim = config.horizon, config.action_dim
        # The tower comes first: with one seed it is the same in every variant, and so is a cache made by it.
        self.vision = ConvTower(
            (tower.width_32, tower.width_16, tower.width_8), (tower.blocks_32, tower.blocks_16, tower.blocks_8), width
        )
        self.vision_width = self.vision.token_width
        initialise(self.vision)
        if tower.pretrained and self.device.type != "meta":
            load_shipped(self.vision)
        self.places = nn.Embedding(self.grid**2, width)
        self.views = nn.Embedding(MAX_VIEWS, width)
        self.see_in = nn.Linear(self.vision_width, width)
        self.see = nn.Sequential(nn.Linear(width, config.vlm.mlp_dim), nn.GELU(), nn.Linear(config.vlm.mlp_dim, width))
        self.embedding = nn.Embedding(config.vocab_size, width)
        self.positions = nn.Embedding(MAX_WORDS, width)
        self.prompt_in = nn.Sequential(nn.Linear(width, action_width), nn.GELU(), nn.Linear(action_width, action_width))
        self.state_in = nn.Linear(2 * len(STATE_FREQUENCIES) * config.state_dim, action_width)
        self.time_in = nn.Sequential(
            nn.Linear(action_width, action_width), nn.SiLU(), nn.Linear(action_width, action_width)
        )
        self.action_in = nn.Linear(config.action_dim, action_width)
        self.steps = nn.Embedding(config.horizon, action_width)
        contexts = {**(extra_experts or {}), "vlm": config.vlm}
        self.columns = nn.ModuleDict({name: Column(expert.width, config) for name, expert in contexts.items()})
        self.layers = nn.ModuleList(Reader(config) for _ in range(config.depth))
        self.final = RMSNorm(action_width)
        self.action_out = nn.Linear(action_width, config.action_dim)
        for name, module in self.named_children():
            if name != "vision":
                initialise(module)

    def init_experts(self, names: Sequence[str]) -> None:
        """Give the columns of these experts fresh weights."""
        for name in names:
            initialise(self.columns[name])

    def compile(self, **options: object) -> None:
        """Compile the tower and every layer in place."""
        for module in (self.vision, *self.layers):
            module.compile(**options)

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → tokens [n, 64, d]; no graph is kept while the tower is frozen."""
        frozen = not any(p.requires_grad for p in self.vision.parameters())
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            tokens: Tensor = self.vision(images)
            return tokens

    def pooled_tokens(self, images: Tensor, grid: int, pooling: str) -> Tensor:
        """Tokens [n, grid², d] as memories store them."""
        return pool_grid(self.encode_images(images), grid, pooling)

    def mark(self, tokens: Tensor, prompt: Tensor, prompt_mask: Tensor) -> Tensor:
        """The class that the prompt names first changes places with the first cube: one place holds what is asked.

        Which word names which class is part of the tower's weights (`ConvTower.words`).
        """
        named = self.vision.words[prompt].bool() & prompt_mask[..., None]  # b l classes
        places = torch.where(named.any(1), named.int().argmax(1), prompt.shape[1])
        first = torch.where(named.any(2).any(1), places.argmin(1), FIRST)  # b
        order = torch.arange(named.shape[2], device=prompt.device).repeat(len(prompt), 1)
        order = torch.where(order == first[:, None], FIRST, order)
        order[:, FIRST] = first
        groups = torch.cat([order + group * order.shape[1] for group in range(4)], 1)
        remaining = torch.arange(groups.shape[1], tokens.shape[-1], device=prompt.device).expand(len(prompt), -1)
        permutation = torch.cat([groups, remaining], 1)
        return tokens.gather(-1, permutation.view(len(prompt), *[1] * (tokens.ndim - 2), -1).expand_as(tokens))

    def observation_blocks(self, batch: Batch, images: Tensor) -> list[Block]:
        """`images`, the tokens of all views (`batch.view_tokens` where they were made beforehand), and `prompt`."""
        views = images.shape[1]
        if batch.view_tokens is None:
            tokens = self.encode_images(images.flatten(0, 1)).unflatten(0, (-1, views))
        else:
            tokens = batch.view_tokens.to(self.places.weight.dtype)
        tokens = self.mark(tokens, batch.prompt, batch.prompt_mask)
        placed = self.see_in(tokens) + self.places.weight + self.views.weight[:views, None]  # b v n d
        encoded = placed + self.see(placed)
        image_mask = batch.image_mask[:, :, None].expand(tokens.shape[:3]).flatten(1)
        words = self.embedding(batch.prompt) + self.positions.weight[: batch.prompt.shape[1]]
        return [
            Block("images", encoded.flatten(1, 2), image_mask, "vlm"),
            Block("prompt", words, batch.prompt_mask, "vlm"),
        ]

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """`noise` [n, r, h, a] and flow times `time` [n, r], r versions a sample."""
        r = self.config.draws
        noise = torch.randn(count, r, self.horizon, self.action_dim, generator=generator)
        time = flow.sample_time(count * r, self.config.time_distribution, noise.device, generator)
        return {"noise": noise, "time": time.view(count, r)}

    def loss(self, batch: Batch, images: Tensor, inject: Inject, draws: Mapping[str, Tensor]) -> Tensor:
        """Squared error [b, h] of the chunk without its noise, the mean over its noisy versions."""
        assert batch.actions is not None
        versions = draws["noise"].shape[1]
        actions = batch.actions.float().repeat_interleave(versions, 0)
        noise, time = draws["noise"].flatten(0, 1), draws["time"].flatten()
        noisy, _ = flow.interpolate(actions, noise, time)
        clean = self._clean(batch, *self._prepare(batch, images, inject), noisy, time, versions)
        return flow.step_loss(clean, actions).unflatten(0, (-1, versions)).mean(1)

    def recompute(self, mode: Recompute) -> None:
        """There is nothing worth recomputing: a layer's activations are a chunk's few tokens."""

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The starting `noise` [h, a]."""
        return {"noise": torch.randn(self.horizon, self.action_dim, generator=generator)}

    @torch.no_grad()
    def sample(
        self, batch: Batch, images: Tensor, inject: Inject, draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        """A normalised chunk [b, h, a] in so many Euler steps, 10 by default."""
        steps = steps or EULER_STEPS
        prepared = self._prepare(batch, images, inject)
        times = flow.euler_times(steps, self.device)

        def velocity(x: Tensor, index: int) -> Tensor:
            time = times[index].expand(len(x))
            return (x - self._clean(batch, *prepared, x, time, 1)) / time[:, None, None].clamp(min=1 / steps)

        return flow.euler(draws["noise"], steps, rtc_guidance(velocity, batch.overlap, times))

    def _prepare(self, batch: Batch, images: Tensor, inject: Inject) -> tuple[Tensor, Tensor, Tensor, Injection]:
        """What does not depend on the noise: each layer's keys and values, their mask, what the goal says."""
        observation = self.observation_blocks(batch, images)
        injection = inject(observation)
        visible = [block for block in injection.blocks if block.name in injection.visibility["action"]]
        cached = torch.cat([self.columns[block.expert](block.tokens) for block in visible], 3)
        mask = additive_mask(torch.cat([block.mask for block in visible], 1)[:, None], cached.dtype)
        words = self.prompt_in(observation[1].tokens) * batch.prompt_mask[..., None]
        prompt_mean = words.sum(1) / batch.prompt_mask.sum(1, keepdim=True).clamp(min=1)
        return cached, mask, prompt_mean, injection

    def _clean(
        self,
        batch: Batch,
        cached: Tensor,
        mask: Tensor,
        prompt_mean: Tensor,
        injection: Injection,
        noisy: Tensor,
        time: Tensor,
        versions: int,
    ) -> Tensor:
        """The chunks [b·r, h, a] without their noise, from noisy ones at times [b·r]."""
        condition = self.time_in(flow.time_embedding(time, self.config.action.width))
        known = prompt_mean if batch.state is None else prompt_mean + self.state_in(_waves(batch.state.float()))
        condition = condition + known.repeat_interleave(versions, 0)
        x = self.action_in(noisy) + self.steps.weight + condition[:, None]
        for at, layer in enumerate(self.layers):
            x = layer(x, condition, *cached[at], mask, versions, injection.hook, at)
        output: Tensor = self.action_out(self.final(x)[0]).float()
        return output

    def parts(self) -> Mapping[str, str]:
        """Tower; words and images; columns that an integration asked for; all else acts."""
        return self.PARTS


def _waves(state: Tensor) -> Tensor:
    """Sin and cos of a state [b, s] at several frequencies, [b, 8·s]."""
    angles = state[..., None] * torch.tensor(STATE_FREQUENCIES, device=state.device)
    return torch.cat([angles.sin(), angles.cos()], -1).flatten(1)
