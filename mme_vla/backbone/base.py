"""`Backbone`: what a policy asks of a network that turns images, words and memory into actions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from mme_vla.backbone.attention import check_backend
from mme_vla.backbone.blocks import Block, Visibility
from mme_vla.errors import UserError
from mme_vla.speed.recompute import Recompute
from mme_vla.speed.sharding import ShardGroup, stacked_layers
from mme_vla.types import Batch

Hook = Callable[[int, Tensor], Tensor]
"""`hook(layer, x)`: what the answering expert's MLP of a layer reads instead of its residual stream x [b, h, d]."""


class LayerHooks:
    """A hook made of one callable a layer. Compiled layers share one code; any other hook makes each compile its own.

    layers: `layers[i](x)` is what layer i's MLP reads.
    """

    def __init__(self, layers: Sequence[Callable[[Tensor], Tensor]]) -> None:
        self.layers = list(layers)

    def __call__(self, layer: int, x: Tensor) -> Tensor:
        return self.layers[layer](x)


def bind_hook(hook: Hook | None, layer: int) -> Callable[[Tensor], Tensor] | None:
    """A hook with its layer already said."""
    return hook.layers[layer] if isinstance(hook, LayerHooks) else None if hook is None else partial(hook, layer)


Noise = dict[str, Tensor]
"""Random numbers by name, one row a sample: drawn by the caller, so that batching and sharding cannot change them."""


@dataclass(frozen=True)
class Injection:
    """How memory enters a backbone for one chunk: what an integration hands over (`Integration.inject`).

    blocks: the prefix in sequence order, the observation's own blocks among them.
    visibility: which block may look at which; rows for these blocks, for those beside the actions and for `action`.
    hook: see `Hook`. condition: what becomes of the condition [b, c] of the answering expert's norms.
    beside: blocks that run with the actions, before them, in every step.
    """

    blocks: Sequence[Block]
    visibility: Visibility
    hook: Hook | None = None
    condition: Callable[[Tensor], Tensor] | None = None
    beside: Sequence[Block] = ()


Inject = Callable[[Sequence[Block]], Injection]
"""An integration with the chunk's memory already bound: observation blocks → `Injection`."""


class Backbone(nn.Module):
    """A vision tower, a language model and a head that answers with actions. It knows nothing of memory.

    A subclass is made from its sizes and the experts that an integration asks for, and sets:
        Config: the dataclass of its sizes, read from the section `backbone`; integrations are built from it.
        vision_width: width d_vision of the tokens a memory stores. token_width: of the tokens in the prefix.
        answer_width: of the residual stream that a hook changes (0: there is none).
        depth: layers of that stream. head_dim: width of one attention head.
        grid: side of a view's token grid.
        horizon, action_dim: of the chunk [h, a] it answers with.
        sample_steps: of an iterative head, unless told otherwise.
        image_size: side of the square images it reads.
        vocab_size: words it knows; None where it does not say.
        agrees: whether its samples can agree with actions that are already promised (`Batch.overlap`).
        compiles_sampling: whether `sample` runs without waiting for the GPU, so that `compile_sampling` is for it.
        hosts: what an integration may use, of `blocks`, `expert`, `hook`, `condition`, `beside` and
            `positions` (blocks that stand at rotary positions of their own); and a memory, `past` (`Batch.past`: a
            tower that looks at past views along with the current ones).

    and implements the methods below. Losses and samples are its own affair (a flow, a regression, a diffusion): whoever
    trains or evaluates hands back the numbers it asked for in `training_noise` and `sampling_noise`.
    """

    Config: ClassVar[type[Any]]
    vision_width: int
    token_width: int
    output_width: int = 0
    depth: int
    head_dim: int
    grid: int
    horizon: int
    action_dim: int
    sample_steps: int = 1
    image_size: int
    vocab_size: int | None = None
    supports: frozenset[str] = frozenset({"blocks"})
    supports_rtc: bool = False
    compiles_sampling: bool = False

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def __init__(self, config: Any, extra_experts: Mapping[str, Any] | None = None) -> None:
        super().__init__()

    def init_experts(self, names: Sequence[str]) -> None:
        """Give fresh weights to what a checkpoint to start from may lack; all others wait for it.

        Such are the experts that an integration asked for, and heads of this backbone's own.
        """
        if names:
            raise NotImplementedError(f"{type(self).__name__} hosts no further experts.")

    # Observation

    vision: nn.Module
    """The vision tower: its weights decide what a cache of its tokens holds."""

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → the tower's tokens [n, grid², d_vision]."""
        raise NotImplementedError

    def pooled_tokens(self, images: Tensor, grid: int, pooling: str) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → tokens [n, grid², d_vision] as memories store them."""
        raise NotImplementedError

    def observation_blocks(self, batch: Batch, images: Tensor) -> list[Block]:
        """Blocks of the current views [b, v, 3, s, s] in [−1, 1] and of the batch's prompt."""
        raise NotImplementedError

    def mark(self, tokens: Tensor, prompt: Tensor, prompt_mask: Tensor) -> Tensor:
        """Stored tokens [b, n, d_vision] as they are read beside a prompt [b, l]; by default as they are."""
        return tokens

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """The random numbers that the losses of `count` samples take, on the CPU: each value [count, …]."""
        return {}

    def loss(self, batch: Batch, images: Tensor, inject: Inject, draws: Mapping[str, Tensor]) -> Tensor:
        """The loss [b, h] of every step of every chunk, under the caller's autocast.

        Args:
            batch: with `actions`. images: its views [b, v, 3, s, s] in [−1, 1], augmented where they shall be.
            inject: the memory's way in. draws: as `training_noise` made them, on the batch's device.
        """
        raise NotImplementedError

    def set_attention_backend(self, backend: str) -> None:
        """Compute attention with another backend than its own choice (`auto`); see `layers.attention.BACKENDS`.

        Raises:
            UserError: there is none of that name, or this backbone has no choice.
        """
        if check_backend(backend) != "auto":
            raise UserError(f"policy.attention={backend}: {type(self).__name__} has one attention; leave it at auto.")

    def recompute(self, mode: Recompute) -> None:
        """Keep no activations inside layers in training, and compute them again in the backward pass; or keep them."""
        raise NotImplementedError

    def shard_groups(self) -> Sequence[ShardGroup]:
        """What processes that share the weights gather together: by default the tower, and layer by layer the rest.

        All that is in no group is gathered for a whole pass, in float32.
        """
        tower = set(self.vision.modules())
        layers = [ShardGroup(layer) for layer in stacked_layers(self) if layer not in tower]
        return [ShardGroup(self.vision, full=True), *layers]

    # Sampling

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The random numbers that one sampled chunk takes, on the CPU, without a batch axis."""
        return {}

    def sample(
        self, batch: Batch, images: Tensor, inject: Inject, draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        """A normalised chunk [b, h, a], under the caller's autocast.

        Args:
            draws: as `sampling_noise` made them, with a batch axis, on the batch's device.
            steps: of an iterative head; its own number by default. Heads that answer at once take no notice.
        """
        raise NotImplementedError

    def compile_sampling(self) -> None:
        """Keep between chunks whatever depends on weights alone; `sample` can be captured as a CUDA graph from now on.

        Raises:
            UserError: this backbone cannot.
        """
        raise UserError(
            f"The backbone {type(self).__name__} has no sampler that can be compiled: leave sampling=eager."
        )

    def sampling_stamp(self) -> object:
        """What `sample` keeps between chunks was made from: where this changes, captured graphs are of no use."""
        return None

    # Parts

    def parts(self) -> Mapping[str, str]:
        """Part → pattern of its parameters' names inside this module, in order; the first that matches decides.

        The names are what fine-tuning speaks of: `vision`, `vlm`, `action`, and `memory` for the experts that an
        integration asked for.
        """
        raise NotImplementedError

    lora_targets: Sequence[str] = ()
    """Linear layers that LoRA wraps unless told otherwise, by the end of their name."""
    heads: Sequence[str] = ()
    """Modules that learn in full beside the adapters, by the end of their name."""
    lora_exclude: str | None = None
    """Pattern of linear layers whose weight is read past any adapter that wraps them."""


def named_noise(draws: Mapping[str, Tensor] | Tensor | None, **more: Tensor | None) -> dict[str, Tensor]:
    """Noise by name; a bare tensor is a flow's `noise`."""
    named = {"noise": draws} if isinstance(draws, Tensor) else dict(draws or {})
    return named | {name: value for name, value in more.items() if value is not None}


def stack_noise(rows: Sequence[Mapping[str, Tensor]], device: torch.device | None = None) -> Noise:
    """Single draws (`sampling_noise`) as those of a batch."""
    return {name: torch.stack([row[name] for row in rows]).to(device) for name in (rows[0] if rows else {})}


def map_noise(draws: Mapping[str, Tensor], change: Callable[[Tensor], Any]) -> Noise:
    """Every value through `change`: rows of a batch, another device."""
    return {name: change(value) for name, value in draws.items()}
