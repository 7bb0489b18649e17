"""`check_backbone`: does a backbone take memory, train and sample as the library expects?"""

import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import fields, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mme_vla.backbone.base import Backbone, Injection
from mme_vla.backbone.layers import Block
from mme_vla.backbone.siglip import pool_grid
from mme_vla.config.sections import read_section
from mme_vla.registry import BACKBONES
from mme_vla.types import Batch, Noise, stack_noise

TOLERANCE = 1e-4
MEMORY_TOKENS = 5


def check_backbone(name: str, unused: str | None = None, **sizes: Any) -> None:
    """Run every check on the backbone that is registered under `name`, and print a line for each
    that passed.

    Args:
        name: the key in `BACKBONES`.
        unused: pattern of parameters that a released checkpoint has and the loss does not read.
        sizes: small ones, as its YAML would give them.
    """
    kind: type[Backbone] = BACKBONES[name]
    config = read_section(kind.Config, sizes, "backbone")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        backbone = kind(config).eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in backbone.parameters():
            # A gate that starts at zero would hide what is behind it.
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    size = backbone.image_size
    prompt_mask = torch.tensor([[True] * 6 + [False] * 2, [True] * 8])
    batch = Batch(
        images=torch.randint(0, 256, (2, 2, 3, size, size), generator=generator) / 127.5 - 1,
        image_mask=torch.ones(2, 2, dtype=torch.bool),
        prompt=torch.randint(1, 16, (2, 8), generator=generator) * prompt_mask,
        prompt_mask=prompt_mask,
        actions=torch.randn(2, backbone.horizon, backbone.action_dim, generator=generator),
    )
    state_dim = getattr(config, "state_dim", 0)
    if state_dim:
        state = torch.randn(2, state_dim, generator=generator)
        batch = replace(batch, state=state, proprio=state)
    check_tokens(backbone, batch.images)
    print(f"{name}: vision tokens have the right shapes, and do not depend on the batch")
    check_loss(backbone, batch)
    print(
        f"{name}: the loss is finite, repeats with the same random numbers, and ignores padding and"
        " other samples"
    )
    check_sample(backbone, batch)
    print(
        f"{name}: a sampled chunk is {backbone.horizon} x {backbone.action_dim}, finite, repeats,"
        " and follows the images"
    )
    if "blocks" in backbone.supports:
        sees_everything = getattr(config, "everything_sees_everything", False)
        check_injection(backbone, batch, has_table=not sees_everything)
        print(f"{name}: an injected block reaches the actions where the visibility table allows it")
    check_parts(backbone)
    print(f"{name}: finetune_spec covers every parameter, vision and action among them")
    check_training(backbone, batch, unused)
    print(f"{name}: a gradient reaches every parameter")


def embedded(backbone: Backbone, batch: Batch) -> list[Block]:
    """The observation's blocks."""
    before = batch.images.clone()
    blocks = backbone.embed(batch)
    assert torch.equal(batch.images, before), "embed changed batch.images in place: change a copy."
    return blocks


def injection_of(
    blocks: list[Block], memory: Tensor | None = None, hidden: bool = False
) -> Injection:
    """Every block of the observation attends to the observation and to memory, actions
    attend to all.

    Args:
        blocks: the observation's.
        memory: tokens [b, n, d] of a block of memory, of which the last is padding.
        hidden: no other block may attend to memory.
    """
    names = {block.name for block in blocks}
    visible = set(names)
    if memory is not None:
        mask = torch.ones(memory.shape[:2], dtype=torch.bool)
        mask[:, -1] = False
        blocks = [Block("memory", memory, mask, blocks[0].expert), *blocks]
        if not hidden:
            visible.add("memory")
    visibility = {
        **dict.fromkeys(names, visible),
        "memory": {"memory"},
        "action": visible | {"action"},
    }
    return Injection(blocks, visibility)


def _loss(backbone: Backbone, batch: Batch, noise: Noise) -> Tensor:
    return backbone.loss(batch, injection_of(embedded(backbone, batch)), noise)


def _sample(backbone: Backbone, batch: Batch, noise: Noise) -> Tensor:
    return backbone.sample(batch, injection_of(embedded(backbone, batch)), noise, steps=1)


def _noise(backbone: Backbone) -> tuple[Noise, Noise]:
    """Of the losses and of the chunks of two samples."""
    generators = [torch.Generator().manual_seed(seed) for seed in range(2)]
    chunks = stack_noise([backbone.sampling_noise(generator) for generator in generators])
    return backbone.training_noise(2, torch.Generator().manual_seed(0)), chunks


@torch.no_grad()
def check_tokens(backbone: Backbone, images: Tensor) -> None:
    """Pooled tokens have the sizes that caches and memories are made for, image by image."""
    flat = images.flatten(0, 1)
    before = flat.clone()
    for pooled in (backbone.grid, 1):
        tokens = pool_grid(backbone.encode_images(flat), pooled)
        shape = (len(flat), pooled**2, backbone.vision_width)
        assert tokens.shape == shape, (
            f"encode_images pooled to grid {pooled} must be {shape}; got {tuple(tokens.shape)}."
        )
    assert torch.equal(flat, before), "encode_images changed images in place: change a copy."
    for row in range(len(flat)):
        alone = pool_grid(backbone.encode_images(flat[row : row + 1]), 1)
        error = float((alone - tokens[row : row + 1]).abs().max())
        assert error <= TOLERANCE, f"an image's tokens depend on its batch (by {error:.2g})."


@torch.no_grad()
def check_loss(backbone: Backbone, batch: Batch) -> None:
    """The loss is one number a step, repeats with the same noise, and reads neither padding nor
    other samples.
    """
    noise, _ = _noise(backbone)
    assert all(len(value) == 2 for value in noise.values()), (
        "every value of training_noise(n) must have n rows."
    )
    again, _ = _noise(backbone)
    assert all(torch.equal(noise[key], again[key]) for key in noise), (
        "training_noise must follow its generator alone."
    )
    before = deepcopy(batch)
    loss = _loss(backbone, batch, noise)
    assert loss.shape == (2, backbone.horizon), f"loss must be [b, h]; got {tuple(loss.shape)}."
    assert torch.isfinite(loss).all() and (loss > 0).any(), (
        "the loss of random actions must be finite and not zero."
    )
    for field in fields(batch):
        expected, value = getattr(before, field.name), getattr(batch, field.name)
        assert not isinstance(value, Tensor) or torch.equal(value, expected), (
            f"loss changed batch.{field.name} in place: change a copy."
        )
    assert torch.equal(loss, _loss(backbone, batch, noise)), (
        "the same noise must give the same loss."
    )
    other = replace(batch, prompt=batch.prompt.masked_fill(~batch.prompt_mask, 3))
    error = float((_loss(backbone, other, noise) - loss).abs().max())
    assert error <= TOLERANCE, f"tokens in the prompt's padding changed the loss by {error:.2g}."
    check_views(backbone, batch, noise)
    check_rows(partial(_loss, backbone), batch, noise, "loss")


def check_views(backbone: Backbone, batch: Batch, noise: Noise) -> None:
    """A view that `image_mask` hides does not change the loss."""
    masked = replace(batch, image_mask=torch.tensor([[True, False]] * 2))
    images = batch.images.clone()
    images[:, 1] *= -1
    hidden = _loss(backbone, replace(masked, images=images), noise)
    error = float((hidden - _loss(backbone, masked, noise)).abs().max())
    assert error <= TOLERANCE, (
        f"a view that image_mask hides changed the loss by {error:.2g}: its tokens' mask in the"
        " block of `embed` must be False."
    )


def check_rows(
    compute: Callable[[Batch, Noise], Tensor], batch: Batch, noise: Noise, what: str
) -> None:
    """Every sample has the loss, or the chunk, that it has alone."""
    together = compute(batch, noise)
    for row in range(2):
        rows = slice(row, row + 1)
        row_noise = {name: value[rows] for name, value in noise.items()}
        error = float((compute(batch.rows(rows), row_noise) - together[rows]).abs().max())
        assert error <= TOLERANCE, (
            f"beside another sample the {what} differs by {error:.2g}: compute each sample by"
            " itself, without means over the batch."
        )


@torch.no_grad()
def check_sample(backbone: Backbone, batch: Batch) -> None:
    """A sample is a chunk, repeats with the same noise, and depends on its own images alone."""
    _, noise = _noise(backbone)
    chunk = _sample(backbone, batch, noise)
    shape = (2, backbone.horizon, backbone.action_dim)
    assert chunk.shape == shape, f"sample must be {shape}; got {tuple(chunk.shape)}."
    assert torch.isfinite(chunk).all(), "a sampled chunk is not finite."
    assert torch.equal(chunk, _sample(backbone, batch, noise)), (
        "the same noise must give the same chunk."
    )
    other = _sample(backbone, replace(batch, images=-batch.images), noise)
    assert not torch.equal(chunk, other), (
        "other images give the same chunk: the observation does not reach the actions."
    )
    check_rows(partial(_sample, backbone), batch, noise, "chunk")


@torch.no_grad()
def check_injection(backbone: Backbone, batch: Batch, has_table: bool) -> None:
    """A block of memory changes loss and chunk, its padding does not, and it does nothing where no
    block may attend to it.

    Args:
        has_table: the backbone follows `Injection.visibility`.
    """
    blocks = embedded(backbone, batch)
    width = blocks[0].tokens.shape[-1]
    generator = torch.Generator().manual_seed(0)
    memory = torch.randn(2, MEMORY_TOKENS, width, generator=generator)
    padded = memory.clone()
    padded[:, -1] = 100
    training, sampling = _noise(backbone)

    def outputs(tokens: Tensor, hidden: bool = False) -> dict[str, Tensor]:
        injection = injection_of(blocks, tokens, hidden)
        return {
            "loss": backbone.loss(batch, injection, training),
            "chunk": backbone.sample(batch, injection, sampling, steps=1),
        }

    def change(first: dict[str, Tensor], second: dict[str, Tensor]) -> dict[str, float]:
        return {name: float((first[name] - second[name]).abs().max()) for name in first}

    results = outputs(memory)
    for name, error in change(results, outputs(-memory)).items():
        assert error > 0, (
            f"an injected block does not change the {name}: read every block of injection.blocks,"
            " or leave 'blocks' out of `supports`."
        )
    for name, error in change(results, outputs(padded)).items():
        assert error <= TOLERANCE, (
            f"what an injected block's mask hides changed the {name} by {error:.2g}."
        )
    if not has_table:
        return
    for name, error in change(outputs(memory, True), outputs(-memory, True)).items():
        assert error <= TOLERANCE, (
            f"a block that injection.visibility hides changed the {name} by {error:.2g}: follow the"
            " table (`attention_mask` of mme_vla.backbone.layers makes a mask of it)."
        )


def check_parts(backbone: Backbone) -> None:
    """Every parameter belongs to a component; those that fine-tuning freezes have parameters."""
    spec = backbone.finetune_spec
    parts = set()
    for name, _ in backbone.named_parameters():
        try:
            parts.add(spec.component_of(name))
        except ValueError as error:
            raise AssertionError(str(error)) from None
    assert {"vision", "action"} <= parts, (
        "the components of finetune_spec must name 'vision' and 'action'; parameters fall into"
        f" {parts}."
    )
    names = [name for name, _ in backbone.named_modules()]
    for end in (*spec.lora_targets, *spec.full_train):
        assert any(f".{name}".endswith(f".{end}") for name in names), (
            f"{end!r} ends no module's name."
        )


def check_training(backbone: Backbone, batch: Batch, unused: str | None) -> None:
    """In training mode samples are independent, and the loss has a gradient by every parameter.

    Args:
        unused: pattern of the names of those that may have none.
    """
    backbone.train().requires_grad_(True)
    noise, _ = _noise(backbone)
    with torch.no_grad():
        loss = _loss(backbone, batch, noise)
        # A backbone may draw numbers in training, as dropout does.
        if torch.equal(loss, _loss(backbone, batch, noise)):
            check_rows(partial(_loss, backbone), batch, noise, "loss in training mode")
    loss = _loss(backbone, batch, noise)
    assert loss.requires_grad, "the loss has no gradient: compute it without no_grad or detach()."
    loss.mean().backward()
    idle = []
    for name, parameter in backbone.named_parameters():
        # A bias that a normalisation subtracts again has a gradient of 0.
        is_bias = name.endswith("bias")
        has_gradient = parameter.grad is not None and (is_bias or bool(parameter.grad.any()))
        if not has_gradient and (unused is None or not re.match(unused, name)):
            idle.append(name)
    assert not idle, (
        f"no gradient reaches {', '.join(idle)}: use them, remove them, or give"
        " check_backbone(unused=…) the pattern of those that are only loaded."
    )
