"""`Backbone`: a network that turns images, prompt and memory into actions, its sizes, and what an
integration injects into it.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from mme_vla.backbone.layers import Block, Visibility
from mme_vla.errors import brief, check_choice, check_multiple, require
from mme_vla.types import Batch, Noise

LARGEST, DEEPEST = 2**24, 2**10
"""Bounds of every size and of layers, far above any network here: a number of a damaged file
exceeds them.
"""


def check_positive(config: Any, prefix: str) -> None:
    """Raise an error if a number of a dataclass is not a possible size."""
    for name, value in vars(config).items():
        if isinstance(value, float):
            require(
                0 < value <= 1,
                f"{prefix}{name}={brief(value)} must be more than 0 and at most 1.",
            )
        if isinstance(value, int) and not isinstance(value, bool):
            most = DEEPEST if name in ("depth", "horizon") else LARGEST
            require(
                1 <= value <= most,
                f"{prefix}{name}={brief(value)} must be at least 1 and at most {most}.",
            )


@dataclass(frozen=True)
class VisionConfig:
    """SigLIP; its output width is the VLM's. `image_size` must be a multiple of `patch_size`."""

    image_size: int = 224
    patch_size: int = 14
    width: int = 1152
    depth: int = 27
    mlp_dim: int = 4304
    num_heads: int = 16

    def __post_init__(self) -> None:
        check_positive(self, "backbone.vision.")
        check_multiple(
            "backbone.vision.", "image_size", self.image_size, "patch_size", self.patch_size
        )


@dataclass(frozen=True)
class ExpertConfig:
    """One Gemma expert's own sizes; depth, heads and head width are shared by all (paper, section
    4.1).
    """

    width: int
    mlp_dim: int


@dataclass(frozen=True)
class BackboneConfig:
    """π0.5: a vision tower, a VLM expert and an action expert under joint attention."""

    vision: VisionConfig = field(default_factory=VisionConfig)
    vlm: ExpertConfig = field(default_factory=lambda: ExpertConfig(2048, 16384))
    action: ExpertConfig = field(default_factory=lambda: ExpertConfig(1024, 4096))
    depth: int = 18
    num_heads: int = 8
    num_kv_heads: int = 1
    head_dim: int = 256
    vocab_size: int = 257_152
    action_dim: int = 32
    horizon: int = 20
    time_distribution: str = (
        "beta"  # `beta`: 0.001 + 0.999·Beta(1.5, 1), as released; `uniform`: the paper's text
    )
    # a key of HEADS, its options
    head: Mapping[str, Any] = field(default_factory=lambda: {"name": "flow"}, hash=False)

    def __post_init__(self) -> None:
        check_positive(self, "backbone.")
        check_positive(self.vlm, "backbone.vlm.")
        check_positive(self.action, "backbone.action.")
        check_multiple("backbone.", "num_heads", self.num_heads, "num_kv_heads", self.num_kv_heads)
        check_multiple("backbone.", "head_dim", self.head_dim, "pairs", 2)  # of a rotation
        # sin and cos of the flow time
        check_multiple("backbone.", "action.width", self.action.width, "pairs", 2)
        check_choice("backbone.time_distribution", self.time_distribution, ("beta", "uniform"))


Hook = Callable[[int, Tensor], Tensor]
"""`hook(layer, x)`: what the norm before the action expert's MLP reads in a layer, made from its
residual stream x [b, h, d]. The residual stream itself stays x.
"""


class LayerHooks:
    """A hook made of one callable a layer. Compiled layers share one code; any other hook makes
    each compile its own.

    layers: `layers[i](x)` is what the norm before layer i's MLP reads.
    """

    def __init__(self, layers: Sequence[Callable[[Tensor], Tensor]]) -> None:
        self.layers = list(layers)

    def __call__(self, layer: int, x: Tensor) -> Tensor:
        return self.layers[layer](x)


def bind_hook(hook: Hook | None, layer: int) -> Callable[[Tensor], Tensor] | None:
    """The hook of one layer."""
    if hook is None:
        return None
    if isinstance(hook, LayerHooks):
        return hook.layers[layer]
    return partial(hook, layer)


@dataclass(frozen=True)
class Injection:
    """All that an integration adds for one chunk (`Integration.inject`).

    blocks: the prefix in sequence order, the observation's own blocks among them.
    visibility: which block attends to which; rows for these blocks, for those beside the actions
        and for `action`.
    hook: see `Hook`.
    condition: maps the condition [b, c] of the action expert's norms to a changed one.
    beside: blocks that run with the actions, before them, in every step.
    """

    blocks: Sequence[Block]
    visibility: Visibility
    hook: Hook | None = None
    condition: Callable[[Tensor], Tensor] | None = None
    beside: Sequence[Block] = ()


@dataclass(frozen=True)
class FineTuneSpec:
    """How a backbone or a policy can be fine-tuned.

    components: name → pattern of the parameters' names, in order; the first match counts, the last
        pattern must match the remaining ones. Usual names are `vision`, `vlm`, `action`, and
        `memory` (of a backbone: the extra experts of an integration).
    lora_targets: linear layers that LoRA wraps by default, by the end of their name.
    full_train: modules that train in full beside the adapters, by the end of their name.
    lora_exclude: pattern of linear layers whose weight is read past any adapter that wraps them.
    frozen: pattern of the parameters that never train.
    """

    components: Mapping[str, str]
    lora_targets: Sequence[str] = ()
    full_train: Sequence[str] = ()
    lora_exclude: str | None = None
    frozen: str | None = None

    def component_of(self, name: str) -> str:
        """The component of a parameter."""
        for component, pattern in self.components.items():
            if re.match(pattern, name):
                return component
        raise ValueError(
            f"No component has the parameter {name!r}; the last pattern must match the remaining"
            " names."
        )


class Backbone(nn.Module):
    """A vision tower, a language model and an action head. It has no dependency on memory.

    The model calls `embed`, lets the integration add memory to the blocks, and passes the result to
    `loss` or `sample`. Optional capabilities are classes to inherit from as well: `HasFlowHead`
    (backbone/flow.py), `HasExtraExperts`, and those of mme_vla/speed.

    A subclass is constructed from its sizes and the extra experts of an integration, and sets:
        Config: the dataclass of its sizes, read from the section `backbone`; integrations are built
            from it.
        supports: what an integration may use, of `blocks`, `expert`, `hook`, `condition`, `beside`,
            and `positions` (blocks at rotary positions of their own); and a memory, `past`
            (`Batch.past`).
        vision: the vision tower; its weights decide what a cache of its tokens holds.
        image_size: side of the square images, in pixels.
        grid: side of a view's token grid.
        vision_width: width d_vision of the tokens that a memory stores.
        horizon, action_dim: of the chunk [h, a].
        finetune_spec: the components of its parameters, by their names inside this module, and what
            LoRA adapts.
    """

    Config: ClassVar[type[Any]]
    supports: frozenset[str] = frozenset({"blocks"})
    vision: nn.Module
    image_size: int
    grid: int
    vision_width: int
    horizon: int
    action_dim: int
    finetune_spec: FineTuneSpec

    def __init__(self, config: Any, extra_experts: Mapping[str, Any] | None = None) -> None:
        super().__init__()

    def encode_images(self, images: Tensor) -> Tensor:
        """Images [n, 3, s, s] in [−1, 1] → the tower's tokens [n, grid², d_vision]."""
        raise NotImplementedError

    def condition_on_prompt(self, tokens: Tensor, prompt: Tensor, prompt_mask: Tensor) -> Tensor:
        """Stored tokens [b, n, d_vision] as the network reads them with a prompt [b, l]; by default
        unchanged.
        """
        return tokens

    def embed(self, batch: Batch) -> list[Block]:
        """Blocks of the current views, in [−1, 1] (`MMEModel.prepare_images`), and of
        the prompt.
        """
        raise NotImplementedError

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """The random numbers for the losses of `count` samples, on the CPU: each value
        [count, …].
        """
        return {}

    def loss(self, batch: Batch, injection: Injection, noise: Mapping[str, Tensor]) -> Tensor:
        """The loss [b, h] of every step of every chunk, under the caller's autocast.

        Args:
            batch: with `actions`.
            injection: the blocks of `embed` with memory added.
            noise: as `training_noise` makes it, on the batch's device.
        """
        raise NotImplementedError

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The random numbers for one sampled chunk, on the CPU, without a batch axis."""
        return {}

    def sample(
        self,
        batch: Batch,
        injection: Injection,
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """A normalised chunk [b, h, a], under the caller's autocast.

        Args:
            noise: as `sampling_noise` makes it, with a batch axis, on the batch's device.
            steps: of an iterative sampler; None is its default. Other backbones ignore it.
        """
        raise NotImplementedError


class HasExtraExperts:
    """Capability of a backbone: it runs extra experts, or has parts that a released checkpoint does
    not contain.
    """

    def init_experts(self, names: Sequence[str]) -> None:
        """Initialise these experts, and own heads that a checkpoint to start from lacks. All other
        weights wait.
        """
        raise NotImplementedError
