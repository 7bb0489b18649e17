"""nano: a backbone of under five million parameters, whose action tokens read images, words and
memory.

The prefix is not processed in layers: each layer of the action column attends to the context as it
is. That makes a training step on stored tokens cheap enough for a laptop.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from mme_vla.backbone.base import (
    Backbone,
    ExpertConfig,
    FineTuneSpec,
    HasExtraExperts,
    Hook,
    Injection,
    bind_hook,
    check_positive,
)
from mme_vla.backbone.flow import HasFlowHead, Predict, build_head, time_embedding
from mme_vla.backbone.layers import AdaRMSNorm, Block, RMSNorm, additive_mask, attend
from mme_vla.backbone.pi05 import initialise
from mme_vla.errors import check_choice, check_multiple, require
from mme_vla.extras.nano.pointer import Pointer
from mme_vla.extras.nano.tower import CLASSES as OBJECT_CLASSES
from mme_vla.extras.nano.tower import PlaceTower, TowerConfig, by_class, load_shipped
from mme_vla.extras.nano.vision import CLASSES, ConvTower
from mme_vla.extras.trajectories.choice import ChoiceHead
from mme_vla.registry import BACKBONES
from mme_vla.speed import Recompute, Recomputes
from mme_vla.speed.rtc import rtc_guidance
from mme_vla.types import Batch, Noise, map_noise


@dataclass(frozen=True)
class NanoConfig:
    """A vision tower, a column of context tokens (`vlm`) and a column of action tokens that reads
    them (`action`).
    """

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
    head: Mapping[str, Any] = field(default_factory=lambda: {"name": "clean_flow"}, hash=False)
    goal: str = "swap"
    """How vision tokens are read with the goal: see `NanoBackbone.condition_on_prompt`. Checkpoints
    without it swap.
    """
    point: str = "regression"
    """Where a choice's point comes from: `regression`, or `objects` (`Pointer`). Checkpoints
    without it regress.
    """

    def __post_init__(self) -> None:
        check_positive(self, "backbone.")
        check_positive(self.vlm, "backbone.vlm.")
        check_positive(self.action, "backbone.action.")
        check_choice("backbone.goal", self.goal, ("text", "swap"))
        require(
            (self.goal == "swap") == (self.vision.layout == "segments"),
            f"backbone.goal={self.goal}: backbone.vision.layout={self.vision.layout} needs "
            f"{'swap' if self.vision.layout == 'segments' else 'text'}.",
        )
        check_choice("backbone.point", self.point, ("objects", "regression"))
        require(
            self.point == "regression" or self.vision.layout == "places",
            f"backbone.vision.layout={self.vision.layout}: backbone.point=objects needs places; use"
            " backbone.point=regression.",
        )
        check_multiple("backbone.", "action.width", self.action.width, "pairs", 2)
        check_multiple("backbone.", "head_dim", self.head_dim, "pairs", 2)
        check_choice("backbone.time_distribution", self.time_distribution, ("beta", "uniform"))


MAX_VIEWS, MAX_WORDS = 4, 256
GOAL_QUERIES = 6
PREFERENCE = (
    1.0  # standard deviation of a fresh query's preferences: each begins with a few classes
)
VOTE = 16.0  # of a word's number for a class: votes are learned sooner than what uses them
WORDS_APART = 16.0  # a word so many places later counts e times less for a query with decay 1
FIRST = CLASSES.index("red cube") - 1
"""Index, among the classes of a token, of the class that the goal names."""
STATE_FREQUENCIES = (1.0, 4.0, 16.0, 64.0)
"""Per radian or metre: a finger's four centimetres count as well as a joint's turn."""


class Reader(nn.Module):
    """One layer of the action column: attention among a chunk's actions, attention to the context,
    and an MLP.
    """

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
        self,
        x: Tensor,
        condition: Tensor,
        k: Tensor,
        v: Tensor,
        mask: Tensor,
        versions: int,
        hook: Callable[[Tensor], Tensor] | None,
    ) -> Tensor:
        """The action tokens [b·r, h, d] after this layer.

        Args:
            condition: [b·r, d].
            k, v: of the context, [b, n, N, e].
            mask: additive [b, 1, 1, n].
            versions: r.
            hook: changes the MLP's input.
        """
        normed, gate = self.norm(x, condition)
        q, new_k, new_v = self.qkv(normed).unflatten(-1, (-1, self.head_dim)).chunk(3, dim=-2)
        x = x + (1 + gate.to(x.dtype)) * self.out(attend(q, new_k, new_v, None))
        normed, gate = self.read_norm(x, condition)
        q = self.read_q(normed).unflatten(-1, (-1, self.head_dim))
        # The versions of a sample read the same context: they are side by side as its queries.
        together = q.unflatten(0, (-1, versions)).flatten(1, 2)
        read = attend(together, k, v, mask).unflatten(1, (versions, -1)).flatten(0, 1)
        # The goal gates what is read: products are learned sooner here than behind the MLP.
        x = x + (1 + gate.to(x.dtype)) * self.read_out(read * self.read_gate(condition)[:, None])
        if hook is not None:
            rows = x.unflatten(0, (-1, versions)).unbind(1)
            x = torch.stack([hook(row) for row in rows], 1).flatten(0, 1)
        normed, gate = self.mlp_norm(x, condition)
        inner, opening = self.up(normed).chunk(2, dim=-1)
        return x + (1 + gate.to(x.dtype)) * self.down(nn.functional.gelu(inner) * opening)


class GoalReader(nn.Module):
    """Reads the goal as text: each of its words votes for classes of objects, and q queries select
    by the votes.

    Features of the selected classes always have the same place in a token. So what is learned of
    the object that a goal names holds for objects of every class. Votes are a number for each word
    and class, which all tasks share. A query prefers some classes to others, and half of the
    queries count earlier words more.
    """

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        kinds = len(OBJECT_CLASSES)
        self.votes = nn.Embedding(config.vocab_size, kinds)
        self.preference = nn.Parameter(PREFERENCE * torch.randn(GOAL_QUERIES, kinds))
        self.decay = nn.Parameter((torch.arange(GOAL_QUERIES) % 2).float())
        self.condition = nn.Linear(GOAL_QUERIES * kinds, config.action.width)

    def forward(self, prompt: Tensor, mask: Tensor) -> Tensor:
        """The share of each class in what a query selects [b, q, K], of a prompt [b, l]; a query's
        add up to 1.
        """
        places = torch.arange(prompt.shape[1], device=prompt.device) / WORDS_APART
        weights = (-self.decay[:, None] * places).exp()
        votes = VOTE * self.votes(prompt) * mask[..., None]
        return (torch.einsum("ql,blk->bqk", weights, votes) + self.preference).softmax(-1)


class Column(nn.Module):
    """What a block of context becomes for the action column: keys and values of every layer, in one
    product.
    """

    def __init__(self, width: int, config: NanoConfig) -> None:
        super().__init__()
        self.shape = (config.depth, 2, config.num_heads, config.head_dim)
        self.norm = RMSNorm(width)
        self.kv = nn.Linear(width, math.prod(self.shape), bias=False)

    def forward(self, tokens: Tensor) -> Tensor:
        """[b, n, d] → [layers, 2, b, n, N, e]."""
        return self.kv(self.norm(tokens)[0]).unflatten(-1, self.shape).movedim((2, 3), (0, 1))


class Context(NamedTuple):
    """What a chunk reads in every step: keys and values [layers, 2, b, n, N, e], their mask, the
    condition [b, d].

    pointing: what the pointer reads: tokens of the first view [b, n, D], and the share of each
        class in what the goal selects [b, q, K]. None without a pointer.
    has_memory: whether an integration adds one.
    """

    keys_values: Tensor
    mask: Tensor
    condition: Tensor
    hook: Hook | None
    pointing: tuple[Tensor, Tensor] | None
    has_memory: bool


@BACKBONES.register("nano")
class NanoBackbone(Backbone, HasFlowHead, HasExtraExperts, Recomputes):
    """A pretrained convolutional tower, and layers of action tokens that read the context; chunks
    by flow matching.

    The network predicts the chunk without its noise, and the velocity follows. The loss takes
    several noisy versions of each sample, which share the context.
    """

    vision: ConvTower | PlaceTower
    Config = NanoConfig
    supports = frozenset({"blocks", "expert", "hook"})
    finetune_spec = FineTuneSpec(
        {
            "vision": r"vision\.",
            "vlm": (  # words and images
                r"embedding\.|goal_reader\.|places\.|views\.|positions\.|see\.|see_in\.|prompt_in\.|columns\.vlm\."
            ),
            "memory": r"columns\.",  # of an integration's extra experts
            "action": "",
        },
        lora_targets=("qkv", "read_q", "out", "read_out", "up", "down"),
        full_train=("action_in", "action_out", "state_in", "prompt_in"),
        lora_exclude=r"\.\w*norm\.dense$",
    )

    def __init__(
        self, config: NanoConfig, extra_experts: Mapping[str, ExpertConfig] | None = None
    ) -> None:
        super().__init__(config, extra_experts)
        self.config = config
        tower, width, action_width = config.vision, config.vlm.width, config.action.width
        self.image_size, self.grid = tower.image_size, tower.image_size // 16
        self.horizon, self.action_dim = config.horizon, config.action_dim
        # The tower comes first: with one seed it is the same in every variant, and so is a cache
        # made by it.
        sizes = tower.widths, tower.blocks
        if tower.layout == "places":
            self.vision = PlaceTower(*sizes, tower.in_use)
        else:
            self.vision = ConvTower(*sizes, width)
        self.goal_reader = GoalReader(config) if config.goal == "text" else None
        self.spare = 0
        if self.goal_reader is not None:
            self.spare = GOAL_QUERIES * self.vision.token_width // len(OBJECT_CLASSES)
        self.vision_width = self.vision.token_width + self.spare
        initialise(self.vision)
        if tower.pretrained and self.vision.out.weight.device.type != "meta":
            load_shipped(self.vision, tower.layout)
        self.places = nn.Embedding(self.grid**2, width)
        self.views = nn.Embedding(MAX_VIEWS, width)
        self.see_in = nn.Linear(self.vision_width, width)
        self.see = nn.Sequential(
            nn.Linear(width, config.vlm.mlp_dim), nn.GELU(), nn.Linear(config.vlm.mlp_dim, width)
        )
        self.embedding = nn.Embedding(config.vocab_size, width)
        self.positions = nn.Embedding(MAX_WORDS, width)
        self.prompt_in = nn.Sequential(
            nn.Linear(width, action_width), nn.GELU(), nn.Linear(action_width, action_width)
        )
        self.state_in = nn.Linear(2 * len(STATE_FREQUENCIES) * config.state_dim, action_width)
        self.time_in = nn.Sequential(
            nn.Linear(action_width, action_width), nn.SiLU(), nn.Linear(action_width, action_width)
        )
        self.action_in = nn.Linear(config.action_dim, action_width)
        self.steps = nn.Embedding(config.horizon, action_width)
        self.columns = nn.ModuleDict()
        for name, expert in {**(extra_experts or {}), "vlm": config.vlm}.items():
            self.columns[name] = Column(expert.width, config)
        self.layers = nn.ModuleList(Reader(config) for _ in range(config.depth))
        self.final = RMSNorm(action_width)
        self.action_out = nn.Linear(action_width, config.action_dim)
        for name, module in self.named_children():
            if name != "vision":
                initialise(module)
        if self.goal_reader is not None:
            nn.init.zeros_(self.goal_reader.votes.weight)  # every word begins without a vote
        # The pointer has its own fresh weights.
        self.pointer = (
            Pointer(action_width, width, GOAL_QUERIES) if config.point == "objects" else None
        )
        self.head = build_head(config)
        require(
            self.pointer is None
            or (isinstance(self.head, ChoiceHead) and len(self.head.numbers) == 2),
            "backbone.point=objects is of choices with a point: set backbone=nano_choice and "
            "embodiment=robomme_choice_front, or backbone.point=regression.",
        )

    def init_experts(self, names: Sequence[str]) -> None:
        """Give the columns of these experts fresh weights."""
        for name in names:
            initialise(self.columns[name])

    def compile(self, **options: object) -> None:
        """Compile the tower and every layer in place."""
        for module in (self.vision, *self.layers):
            module.compile(**options)

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → tokens [n, 64, d]; no graph is kept while the tower is
        frozen.

        The last `spare` numbers are 0 until `condition_on_prompt` fills them.
        """
        frozen = not any(p.requires_grad for p in self.vision.parameters())
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            return nn.functional.pad(self.vision(images), (0, self.spare))

    def condition_on_prompt(self, tokens: Tensor, prompt: Tensor, prompt_mask: Tensor) -> Tensor:
        """Vision tokens [b, …, d] as they are read with a prompt.

        With `goal=text` their last numbers are the features of the classes that each query of
        `GoalReader` selects. `goal=swap` is of the shipped policy `checkpoint=nano`: the class of
        cubes that the prompt names first and the first class are exchanged, so that one index holds
        the requested one. `ConvTower.words`, part of the tower's weights, says which word names
        which.
        """
        if self.goal_reader is not None:
            selected = self.goal_reader(prompt, prompt_mask).to(tokens.dtype)
            features = torch.einsum("bqk,b...kf->b...qf", selected, by_class(tokens))
            return torch.cat([tokens[..., : -self.spare], features.flatten(-2)], -1)
        assert isinstance(self.vision, ConvTower)  # as `NanoConfig` says
        named = self.vision.words[prompt].bool() & prompt_mask[..., None]  # b l classes
        places = torch.where(named.any(1), named.int().argmax(1), prompt.shape[1])
        first = torch.where(named.any(2).any(1), places.argmin(1), FIRST)  # b
        order = torch.arange(named.shape[2], device=prompt.device).repeat(len(prompt), 1)
        order = torch.where(order == first[:, None], FIRST, order)
        order[:, FIRST] = first
        groups = torch.cat([order + group * order.shape[1] for group in range(4)], 1)
        remaining = torch.arange(groups.shape[1], tokens.shape[-1], device=prompt.device).expand(
            len(prompt), -1
        )
        permutation = torch.cat([groups, remaining], 1)
        return tokens.gather(
            -1, permutation.view(len(prompt), *[1] * (tokens.ndim - 2), -1).expand_as(tokens)
        )

    def embed(self, batch: Batch) -> list[Block]:
        """Blocks `images`, of all views (`batch.view_tokens` where they were encoded before), and
        `prompt`.
        """
        views, n_words = batch.images.shape[1], batch.prompt.shape[1]
        require(
            views <= MAX_VIEWS,
            f"backbone=nano takes {MAX_VIEWS} cameras; embodiment.cameras names {views}.",
        )
        require(
            n_words <= MAX_WORDS,
            f"backbone=nano reads {MAX_WORDS} tokens of a prompt, and this one has {n_words}:"
            " shorten the prompt format.",
        )
        tokens = self.condition_on_prompt(
            self._view_tokens(batch, views), batch.prompt, batch.prompt_mask
        )
        # b v n d
        located = self.see_in(tokens) + self.places.weight + self.views.weight[:views, None]
        encoded = located + self.see(located)
        image_mask = batch.image_mask[:, :, None].expand(tokens.shape[:3]).flatten(1)
        words = self.embedding(batch.prompt) + self.positions.weight[:n_words]
        return [
            Block("images", encoded.flatten(1, 2), image_mask, "vlm"),
            Block("prompt", words, batch.prompt_mask, "vlm"),
        ]

    def _view_tokens(self, batch: Batch, views: int) -> Tensor:
        """The tower's tokens of the first views [b, v, n, D]."""
        if batch.view_tokens is None:
            return self.encode_images(batch.images[:, :views].flatten(0, 1)).unflatten(
                0, (-1, views)
            )
        return batch.view_tokens[:, :views].to(self.places.weight.dtype)

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """`noise` [n, r, h, a] and flow times `time` [n, r], for r noisy versions a sample."""
        versions = self.config.draws
        noise = self.head.training_noise(count * versions, generator)
        return map_noise(noise, lambda value: value.unflatten(0, (count, versions)))

    def loss(self, batch: Batch, injection: Injection, noise: Mapping[str, Tensor]) -> Tensor:
        """The head's loss [b, h] of the chunk without its noise, the mean over its noisy versions.

        Training adds the localization loss of a policy that points at objects
        (`Pointer.localization_loss`).
        """
        assert batch.actions is not None
        versions = noise["noise"].shape[1]
        context = self.read_context(batch, injection)
        actions = batch.actions.repeat_interleave(versions, 0)
        flat = map_noise(noise, lambda value: value.flatten(0, 1))
        losses = self.head.loss(
            lambda x_t, time: self.denoise(context, x_t, time, versions), actions, flat
        )
        loss = losses.unflatten(0, (-1, versions)).mean(1)

        # The localization loss is of policies that point and whose memory reads images.
        history = batch.history
        if (
            not self.training
            or self.pointer is None
            or history is None
            or history.features.shape[-1] != self.vision_width
        ):
            return loss
        assert context.pointing is not None
        time = torch.ones(len(batch.prompt), device=batch.prompt.device)
        start = time.new_zeros(len(time), self.horizon, self.action_dim)
        pointed = self.act(context, start, time, 1)
        return loss + self.pointer.localization_loss(pointed, history, context.pointing[1])[:, None]

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
        """A normalised chunk [b, h, a] in so many Euler steps, 10 by default."""
        steps = steps or self.head.steps
        context = self.read_context(batch, injection)
        x = self.head.start(noise, steps, batch.overlap)
        times = self.head.times(steps, x.device)
        velocity = self.head.velocity(
            lambda x, index: self.denoise(context, x, times[index].expand(len(x)), 1), times, noise
        )
        if batch.overlap is not None:
            velocity = rtc_guidance(velocity, batch.overlap, times)
        increments = noise.get("increments")
        for index in range(len(times)):
            scaled = None if increments is None else self.head.deviation * increments[:, index]
            x = self.head.step(x, velocity(x, index), len(times), scaled)
        return x

    def predictor(self, batch: Batch, injection: Injection) -> Predict:
        context = self.read_context(batch, injection)
        return lambda x_t, time: self.denoise(context, x_t, time, 1)

    def read_context(self, batch: Batch, injection: Injection) -> Context:
        """All that does not depend on the noise."""
        names = injection.visibility["action"]
        visible = [block for block in injection.blocks if block.name in names]
        keys_values = torch.cat([self.columns[block.expert](block.tokens) for block in visible], 3)
        block_mask = torch.cat([block.mask for block in visible], 1)
        mask = additive_mask(block_mask[:, None], keys_values.dtype)
        (prompt,) = (block for block in injection.blocks if block.name == "prompt")
        words = self.prompt_in(prompt.tokens) * batch.prompt_mask[..., None]
        condition = words.sum(1) / batch.prompt_mask.sum(1, keepdim=True).clamp(min=1)
        pointing = None
        if self.goal_reader is not None:
            selected = self.goal_reader(batch.prompt, batch.prompt_mask)
            condition = condition + self.goal_reader.condition(selected.flatten(1))
            if self.pointer is not None:
                pointing = self._view_tokens(batch, 1)[:, 0], selected
        added = {block.name for block in visible} - {"images", "prompt"}
        has_memory = injection.hook is not None or bool(added)
        if batch.state is not None:  # at several frequencies
            frequencies = torch.tensor(STATE_FREQUENCIES, device=batch.state.device)
            angles = batch.state.float()[..., None] * frequencies
            waves = torch.cat([angles.sin(), angles.cos()], -1).flatten(1)
            condition = condition + self.state_in(waves)
        return Context(keys_values, mask, condition, injection.hook, pointing, has_memory)

    def denoise(self, context: Context, x_t: Tensor, time: Tensor, versions: int) -> Tensor:
        """The chunks [b·r, h, a] without their noise, from noisy ones at times [b·r]; behind them
        what points.
        """
        x = self.act(context, x_t, time, versions)
        output: Tensor = self.action_out(x)
        if self.pointer is not None:
            assert context.pointing is not None
            tokens, selected = context.pointing
            components = self.pointer(
                x,
                tokens.repeat_interleave(versions, 0),
                selected.repeat_interleave(versions, 0),
                context.has_memory,
            )
            output = torch.cat([output, components], -1)
        return output.float()

    def act(self, context: Context, x_t: Tensor, time: Tensor, versions: int) -> Tensor:
        """The action tokens [b·r, h, d] behind all layers."""
        condition = self.time_in(time_embedding(time, self.config.action.width))
        condition = condition + context.condition.repeat_interleave(versions, 0)
        x = self.action_in(x_t) + self.steps.weight + condition[:, None]
        for i, layer in enumerate(self.layers):
            x = layer(
                x,
                condition,
                *context.keys_values[i],
                context.mask,
                versions,
                bind_hook(context.hook, i),
            )
        final: Tensor = self.final(x)[0]
        return final

    def recompute(self, mode: Recompute) -> None:
        """No effect: a layer's activations are a chunk's few tokens."""
