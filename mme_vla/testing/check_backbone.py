"""`check_backbone`: does a backbone take memory, train and sample as the library expects?"""

from typing import Any

import torch

from mme_vla.backbone.base import Backbone, Injection
from mme_vla.backbone.siglip import pool_grid
from mme_vla.config.sections import read_section
from mme_vla.registry import BACKBONES
from mme_vla.types import Batch

TOLERANCE = 1e-4


def check_backbone(name: str, **sizes: Any) -> None:
    """Run every check on the backbone that is registered under `name`, and print a line for each
    that passed.

    Args:
        name: the key in `BACKBONES`.
        sizes: small ones, as its YAML would give them.
    """
    kind: type[Backbone] = BACKBONES[name]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        backbone = kind(read_section(kind.Config, sizes, "backbone")).eval()
    generator = torch.Generator().manual_seed(0)
    size = backbone.image_size
    prompt_mask = torch.tensor([[True] * 6 + [False] * 2, [True] * 8])
    batch = Batch(
        images=torch.randint(0, 256, (2, 2, 3, size, size), generator=generator) / 127.5 - 1,
        image_mask=torch.ones(2, 2, dtype=torch.bool),
        prompt=torch.randint(1, 16, (2, 8), generator=generator) * prompt_mask,
        prompt_mask=prompt_mask,
        actions=torch.randn(2, backbone.horizon, backbone.action_dim, generator=generator),
    )
    check_tokens(backbone, batch.images)
    print(f"{name}: vision tokens have the right shapes, and do not depend on the batch")
    check_loss(backbone, batch)
    print(
        f"{name}: the loss is finite, repeats with the same random numbers, and ignores the"
        " prompt's padding"
    )
    check_sample(backbone, batch)
    print(
        f"{name}: a sampled chunk is {backbone.horizon} x {backbone.action_dim}, finite, and"
        " repeats"
    )
    check_parts(backbone)
    print(f"{name}: finetune_spec covers every parameter, vision and action among them")


def _inject(backbone: Backbone, batch: Batch) -> Injection:
    """No memory: every block of the observation attends to the observation, actions
    attend to all.
    """
    blocks = backbone.embed(batch)
    names = {block.name for block in blocks}
    return Injection(blocks, {**dict.fromkeys(names, names), "action": names | {"action"}})


@torch.no_grad()
def check_tokens(backbone: Backbone, images: torch.Tensor) -> None:
    """Pooled tokens have the sizes that caches and memories are made for, image by image."""
    flat = images.flatten(0, 1)
    for pooled in (backbone.grid, 1):
        tokens = pool_grid(backbone.encode_images(flat), pooled)
        shape = (len(flat), pooled**2, backbone.vision_width)
        assert tokens.shape == shape, (
            f"encode_images pooled to grid {pooled} must be {shape}; got {tuple(tokens.shape)}."
        )
    error = float((pool_grid(backbone.encode_images(flat[1:2]), 1) - tokens[1:2]).abs().max())
    assert error <= TOLERANCE, f"an image's tokens depend on its batch (by {error:.2g})."


@torch.no_grad()
def check_loss(backbone: Backbone, batch: Batch) -> None:
    """The loss is one number a step, repeats with the same noise, and does not read padding."""
    injection = _inject(backbone, batch)
    noise = backbone.training_noise(2, torch.Generator().manual_seed(0))
    assert all(len(value) == 2 for value in noise.values()), (
        "every value of training_noise(n) must have n rows."
    )
    again = backbone.training_noise(2, torch.Generator().manual_seed(0))
    assert all(torch.equal(noise[key], again[key]) for key in noise), (
        "training_noise must follow its generator alone."
    )
    loss = backbone.loss(batch, injection, noise)
    assert loss.shape == (2, backbone.horizon), f"loss must be [b, h]; got {tuple(loss.shape)}."
    assert torch.isfinite(loss).all() and (loss > 0).any(), (
        "the loss of random actions must be finite and not zero."
    )
    assert torch.equal(loss, backbone.loss(batch, injection, noise)), (
        "the same noise must give the same loss."
    )
    other = Batch(**{**vars(batch), "prompt": batch.prompt.masked_fill(~batch.prompt_mask, 3)})
    error = float((backbone.loss(other, _inject(backbone, other), noise) - loss).abs().max())
    assert error <= TOLERANCE, f"tokens in the prompt's padding changed the loss by {error:.2g}."


@torch.no_grad()
def check_sample(backbone: Backbone, batch: Batch) -> None:
    """A sample is a chunk, repeats with the same noise, and depends on the observation."""
    injection = _inject(backbone, batch)
    one = backbone.sampling_noise(torch.Generator().manual_seed(0))
    noise = {key: torch.stack([value, value]) for key, value in one.items()}
    chunk = backbone.sample(batch, injection, noise)
    shape = (2, backbone.horizon, backbone.action_dim)
    assert chunk.shape == shape, f"sample must be {shape}; got {tuple(chunk.shape)}."
    assert torch.isfinite(chunk).all(), "a sampled chunk is not finite."
    assert torch.equal(chunk, backbone.sample(batch, injection, noise)), (
        "the same noise must give the same chunk."
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
