"""`MMEModel`: a backbone, a memory and an integration as one network. Read this file first.

    images, prompt ── backbone.embed ──► blocks ─┐
    history ───────── memory ──────────► tokens ─┴─► integration.inject ──► Injection
    Injection, noise ─ backbone.loss or backbone.sample ──► loss [b, h] or chunk [b, h, a]

Data flows down once. The backbone knows of the integration an `Injection` alone, and neither knows
which memory made the tokens. It needs torch, numpy and timm; configuration, datasets and simulation
are in other packages.

From image to loss in the order of the calls, with FrameSamp and Modulator:

    MMEModel.loss              here: images, memory tokens, injection, loss
    PerceptualMemory.forward   memory/base.py: a token of each stored feature and its position
    Pi05Backbone.embed         backbone/pi05.py: blocks of images (siglip.py) and prompt
    Integration.inject         integration/base.py: what memory adds to the blocks
    Modulator.hook             integration/modulator.py: keys and values of memory, once a layer
    FlowHead.loss              backbone/flow.py: noisy actions, and the error of the prediction
    Pi05Backbone.predict       backbone/pi05.py: one pass over images, prompt and noisy actions
    JointTransformer.layout    backbone/gemma.py: who attends to whom, and positions (layers.py)
    JointTransformer.forward   backbone/gemma.py: layer after layer
    JointBlock.forward         backbone/gemma.py: experts project, attend as one, and run their MLPs
    ModulatorLayer.forward     integration/modulator.py: the hook, before the MLP
    masked_mean                here: the mean over steps and samples

A memory works in two steps. `select` (memory/base.py, of the frames that memory/framesamp.py names)
chooses stored tokens of a history (memory/history.py) and `MemoryModule.forward` encodes them. In
training the dataset selects, which makes `Batch.history`, and `memory_tokens` encodes. In an
episode `MMEPolicy.encode_memories` does both, and `Batch.history` is None. The stored tokens come
from the vision tower and `pool_grid` (`policy/network.py`, `encode_frames`), in training from the
vision cache.

Shapes: b batch · n tokens · d width · v views · h action horizon · a action width (types.py).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import torch
from torch import Tensor, nn

from mme_vla.backbone.base import Backbone, Injection
from mme_vla.backbone.layers import Block, autocast
from mme_vla.errors import UserError, check_integer, check_known
from mme_vla.integration.base import Integration
from mme_vla.memory.base import MemoryModule, encode_selection
from mme_vla.types import Batch, MemoryTokens, Noise, check_mask, to_unit_range


def unit_images(images: Tensor, augmentation: Tensor | None = None) -> Tensor:
    """Views [b, v, 3, s, s] uint8 → float32 in [−1, 1].

    Raises:
        ValueError: there are random numbers of an augmentation, which this function does not have.
    """
    if augmentation is not None:
        raise ValueError(
            "unit_images() does not augment, and got augmentation: leave it out, or construct"
            " MMEModel with another transform_images."
        )
    return to_unit_range(images)


class MMEModel(nn.Module):
    """One composition of backbone, memory and integration.

    Args:
        backbone: constructed with `integration.extra_experts()`.
        memory: None for the policy without memory.
        integration: the base class `Integration` adds nothing.
        compute_dtype: float32 or bfloat16, which runs matrix products under autocast over float32
            weights. An autocast around the model has no effect.
        transform_images: from views [b, v, 3, s, s] uint8, and in training the random numbers [b,
            …] of their augmentation, to views in [−1, 1] as the backbone reads them.

    >>> sizes = BackboneConfig()  # doctest: +SKIP
    >>> integration = Modulator(sizes)  # doctest: +SKIP
    >>> backbone = Pi05Backbone(sizes, integration.extra_experts())  # doctest: +SKIP
    >>> memory = FrameSamp(backbone.vision_width, integration.memory_width)  # doctest: +SKIP
    >>> model = MMEModel(backbone, memory, integration)  # doctest: +SKIP
    """

    memory: MemoryModule | None
    loss_weights: Mapping[str, float] = MappingProxyType({})
    """Weights of auxiliary losses by name (`train.losses`); 1 for those that are not named."""

    def __init__(
        self,
        backbone: Backbone,
        memory: MemoryModule | None,
        integration: Integration,
        compute_dtype: torch.dtype = torch.float32,
        transform_images: Callable[[Tensor, Tensor | None], Tensor] = unit_images,
    ) -> None:
        super().__init__()
        if compute_dtype not in (torch.float32, torch.bfloat16):
            raise ValueError(f"compute_dtype={compute_dtype}: choose float32 or bfloat16.")
        self.backbone = backbone
        self.register_module("memory", memory)
        self.integration = integration
        self.compute_dtype = compute_dtype
        self.transform_images = transform_images

    # The steps, in order

    def prepare_images(self, batch: Batch, augmentation: Tensor | None = None) -> Batch:
        """The batch with its views, past ones included, in [−1, 1] float32. Past views change as
        the current ones do.

        Args:
            batch: images uint8.
            augmentation: random numbers [b, …] of the image augmentation.

        Raises:
            ValueError: the images are not uint8, or `image_mask` does not say which of them count.
        """
        if batch.images.dtype != torch.uint8:
            raise ValueError(f"Batch.images must be uint8 0…255, got {batch.images.dtype}.")
        check_mask("Batch.image_mask", batch.image_mask, batch.images.shape[:2])
        images = self.transform_images(batch.images, augmentation)
        past = batch.past
        if past is None:
            return replace(batch, images=images)
        if augmentation is not None:
            augmentation = augmentation.repeat_interleave(past.images.shape[1], 0)
        frames = self.transform_images(past.images.flatten(0, 1), augmentation)
        past = replace(past, images=frames.unflatten(0, past.images.shape[:2]))
        return replace(batch, images=images, past=past)

    def prompt_condition(self, batch: Batch) -> Callable[[Tensor], Tensor]:
        """What makes stored tokens [b, n, d_vision] those that the backbone reads with the batch's
        prompts; for `pi05` the tokens as they are. A selection goes through it in `memory_tokens`,
        and an episode's tokens as they are gathered (`PromptConditionedHistory`).
        """
        return partial(
            self.backbone.condition_on_prompt, prompt=batch.prompt, prompt_mask=batch.prompt_mask
        )

    def memory_tokens(self, batch: Batch) -> MemoryTokens | None:
        """Memory tokens of the batch's selection, or None without memory."""
        if self.memory is None or batch.history is None:
            return None
        with self.autocast():
            history = self.memory.condition_on_prompt(batch.history, self.prompt_condition(batch))
            return encode_selection(self.memory, history)

    def inject(self, batch: Batch, memory: MemoryTokens | None) -> Injection:
        """The observation's blocks with memory added. The batch's images are prepared.

        Raises:
            ValueError: there are more memory tokens than the memory's budget, or they have not one
                row a sample or another width than the integration takes.
        """
        if memory is not None:
            check_tokens(memory, len(batch.prompt), self.memory, self.integration.memory_width)
        injection = self.integration.inject(self.backbone.embed(batch), memory)
        check_positions(injection.blocks, self.backbone)
        return injection

    # Loss and samples

    def loss(
        self,
        batch: Batch,
        noise: Mapping[str, Tensor],
        memory: MemoryTokens | None = None,
        augmentation: Tensor | None = None,
        metrics: dict[str, Tensor] | None = None,
    ) -> Tensor:
        """The mean loss of a batch: that of the actions, and in training the weighted auxiliary
        ones of the memory.

        Args:
            batch: with `actions`, on the model's device.
            noise: as `training_noise` makes it, on the same device.
            memory: memory tokens; by default those of `batch.history`.
            augmentation: random numbers [b, …] of the image augmentation; None augments nothing.
            metrics: receives what is worth logging, detached: `loss`, and if there are auxiliary
                losses `losses/<name>` of all, unweighted; `memory/<name>` of the memory's own.
        """
        check_noise(noise, len(batch.prompt))
        check_chunks(batch, noise)
        batch = self.prepare_images(batch, augmentation)
        if memory is None:
            memory = self.memory_tokens(batch)
        with self.autocast():
            step_losses = self.backbone.loss(batch, self.inject(batch, memory), noise)  # b h
        shape = (len(batch.prompt), *step_losses.shape[1:])
        check_shape(f"{type(self.backbone).__name__}.loss", step_losses, shape)
        action = masked_mean(step_losses, batch.action_mask, batch.weight)
        return self._add_auxiliary(action, memory, batch, metrics)

    def _add_auxiliary(
        self,
        action: Tensor,
        memory: MemoryTokens | None,
        batch: Batch,
        metrics: dict[str, Tensor] | None,
    ) -> Tensor:
        """The loss of the actions with the memory's own in training, and what is worth logging.

        Raises:
            UserError: `loss_weights` names another one.
            ValueError: one has not one number a sample.
        """
        # The means over the batch of the losses that memory tokens bring, unweighted.
        auxiliary: dict[str, Tensor] = {}
        if self.training:
            if memory is not None:
                for name, values in memory.losses.items():
                    if name == "action" or values.shape != batch.prompt.shape[:1]:
                        raise ValueError(
                            f"The auxiliary loss {name!r} has shape {list(values.shape)}: return"
                            f" one number a sample, [{len(batch.prompt)}], under another name than"
                            " 'action'."
                        )
                    auxiliary[name] = weighted_mean(values.float(), batch.weight)
            for name in self.loss_weights:
                check_known("auxiliary loss in train.losses:", name, list(auxiliary))
        total = action
        for name, value in auxiliary.items():
            weight = self.loss_weights.get(name, 1.0)
            if weight:  # 0 leaves one out
                total = total + weight * value
        if metrics is not None:
            metrics["loss"] = total.detach()
            if auxiliary:
                for name, value in {"action": action, **auxiliary}.items():
                    metrics[f"losses/{name}"] = value.detach()
            if memory is not None:
                metrics |= memory.logged()
        return total

    def forward(
        self,
        batch: Batch,
        noise: Mapping[str, Tensor],
        memory: MemoryTokens | None = None,
        augmentation: Tensor | None = None,
    ) -> Tensor:
        """The `loss`. What wraps a module (DDP, FSDP, `torch.compile`) acts when the module itself
        is called.
        """
        return self.loss(batch, noise, memory, augmentation)

    @torch.inference_mode(False)  # real-time chunking asks for a gradient
    @torch.no_grad()
    def sample(
        self,
        batch: Batch,
        noise: Mapping[str, Tensor],
        steps: int | None = None,
        memory: MemoryTokens | None = None,
    ) -> Tensor:
        """A normalised chunk [b, h, a].

        Args:
            noise: as `sampling_noise` makes it, with a batch axis, on the batch's device.
            steps: of an iterative sampler, such as Euler steps of a flow; None is the backbone's
                default.
            memory: memory tokens; by default those of `batch.history`.
        """
        if steps is not None:
            check_integer("steps", steps)
        check_noise(noise, len(batch.prompt))
        batch = self.prepare_images(batch)
        if memory is None:
            memory = self.memory_tokens(batch)
        with self.autocast():
            return self.backbone.sample(batch, self.inject(batch, memory), noise, steps)

    # Noise, device, precision

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """The random numbers for the losses of `count` samples, on the CPU; of π0.5 `noise` [n, h,
        a], `time` [n].
        """
        return self.backbone.training_noise(count, generator)

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The random numbers for one chunk, on the CPU, without a batch axis; of π0.5 the starting
        `noise` [h, a].
        """
        return self.backbone.sampling_noise(generator)

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def autocast(self) -> torch.autocast:
        """The autocast context of all network code."""
        return autocast(self.device, self.compute_dtype)


def check_positions(blocks: Sequence[Block], backbone: Backbone) -> None:
    """Raise an error if blocks bring positions to a backbone that numbers tokens itself."""
    for block in blocks:
        if block.positions is not None and "positions" not in backbone.supports:
            raise UserError(
                f"The block {block.name!r} has positions {list(block.positions.shape)}, and"
                f" {type(backbone).__name__} counts tokens in causal order. Allowed here is"
                " Block.positions=None. A backbone whose `supports` has 'positions', such as"
                " backbone=pi05, takes others."
            )


def check_shape(what: str, values: Tensor | None, shape: Sequence[int]) -> None:
    """Raise an error unless a tensor, if there is one, has a shape: one row for all samples would
    be broadcast silently.
    """
    if values is not None and values.shape != tuple(shape):
        raise ValueError(f"{what} has shape {list(values.shape)}: it must be {list(shape)}.")


def check_tokens(
    tokens: MemoryTokens, samples: int, memory: MemoryModule | None, width: int
) -> None:
    """Raise an error unless memory tokens have one row a sample and the width that the integration
    takes, and are within the budget of the memory, if there is one.
    """
    n_tokens = tokens.tokens.shape[1]
    what = "MemoryTokens.tokens, [samples, tokens, integration.memory_width],"
    check_shape(what, tokens.tokens, (samples, n_tokens, width))
    if memory is not None and n_tokens > memory.budget:
        raise ValueError(
            f"{type(memory).__name__} returned {n_tokens} memory tokens; its budget is"
            f" {memory.budget}."
        )


def check_noise(noise: Mapping[str, Tensor], samples: int) -> None:
    """Raise an error unless random numbers have names and one row a sample."""
    if not isinstance(noise, Mapping):
        raise ValueError(
            f"The noise is a {type(noise).__name__}: give tensors by name, as training_noise() and"
            ' sampling_noise() do, such as {"noise": …}.'
        )
    for name, values in noise.items():
        check_shape(f"The noise {name!r}", values, (samples, *values.shape[1:]))


def check_chunks(batch: Batch, noise: Mapping[str, Tensor]) -> None:
    """Raise an error unless a batch has recorded chunks, of the shape of its noise, and marks and
    weights of theirs.
    """
    if batch.actions is None:
        raise ValueError("A loss needs the recorded chunks: Batch.actions is None.")
    chunks = batch.actions
    check_shape("Batch.action_mask", batch.action_mask, chunks.shape[:2])
    check_shape("Batch.weight", batch.weight, chunks.shape[:1])
    random = noise.get("noise")
    # Of another number of dimensions they are added to no chunk: a backbone's own.
    if random is not None and random.ndim == chunks.ndim and random.shape != chunks.shape:
        shapes = f"{list(chunks.shape)} and noise {list(random.shape)}"
        raise ValueError(
            f"Batch.actions {shapes} differ in shape: pad actions with zeros to the network's, and"
            " give training_noise() the number of samples."
        )


def masked_mean(losses: Tensor, counted: Tensor | None, weight: Tensor | None = None) -> Tensor:
    """The mean of losses [b, h], over the counted steps of each sample first, so that it is
    independent of the batch.

    Args:
        counted: [b, h] bool; None counts all (`data.mask_padding`).
        weight: of each sample, [b] (`data.weights`).
    """
    if counted is None and weight is None:
        return losses.mean()
    if counted is None:
        return weighted_mean(losses.mean(1), weight)
    counts = counted.to(losses.dtype)
    sample_means = (losses * counts).sum(1) / counts.sum(1).clamp(min=1)
    return weighted_mean(sample_means, weight)


def weighted_mean(losses: Tensor, weight: Tensor | None) -> Tensor:
    """The mean over a batch of each sample's loss [b] times its weight [b]; None
    weighs all with 1.
    """
    if weight is None:
        return losses.mean()
    return (losses * weight).mean()
