"""`check_backbone`: does a backbone host memory, train and sample as the rest of the library expects?"""

from typing import Any

import torch

from mme_vla.backbone.base import Backbone, Injection
from mme_vla.backbone.blocks import Block
from mme_vla.config.sections import read_section
from mme_vla.registry import BACKBONES
from mme_vla.types import Batch

TOLERANCE = 1e-4


def check_backbone(name: str, **sizes: Any) -> None:
    """Run every check on the backbone that is registered under `name`, and print a line for each that passed.

    Args:
        name: the key in `BACKBONES`. sizes: small ones, as its YAML would give them.

    Raises:
        AssertionError: names the property that does not hold, and the values.
        UserError: an unknown backbone or size.
    """
    kind: type[Backbone] = BACKBONES[name]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        backbone = kind(read_section(kind.Config, sizes, "backbone")).eval()
    batch = _batch(backbone)
    images = batch.images.float() / 127.5 - 1
    check_tokens(backbone, images)
    print(f"{name}: vision tokens have the right shapes, and do not depend on the batch")
    check_loss(backbone, batch, images)
    print(f"{name}: the loss is finite, repeats with the same random numbers, and ignores the prompt's padding")
    check_sample(backbone, batch, images)
    print(f"{name}: a sampled chunk is {backbone.horizon} x {backbone.action_dim}, finite, and repeats")
    check_parts(backbone)
    print(f"{name}: parts() covers every parameter, vision and action among them")


def _batch(backbone: Backbone) -> Batch:
    generator, size = torch.Generator().manual_seed(0), backbone.image_size
    prompt_mask = torch.tensor([[True] * 6 + [False] * 2, [True] * 8])
    return Batch(
        images=torch.randint(0, 256, (2, 2, 3, size, size), generator=generator, dtype=torch.uint8),
        image_mask=torch.ones(2, 2, dtype=torch.bool),
        prompt=torch.randint(1, 16, (2, 8), generator=generator) * prompt_mask,
        prompt_mask=prompt_mask,
        actions=torch.randn(2, backbone.horizon, backbone.action_dim, generator=generator),
    )


def _without_names(visible: Any) -> Any:
    """An integration that adds nothing: every block of the observation sees the observation, actions see all."""
    return lambda blocks: Injection(list(blocks), visible)


def _table(blocks: list[Block]) -> dict[str, set[str]]:
    names = {block.name for block in blocks}
    return {**dict.fromkeys(names, names), "action": names | {"action"}}


@torch.no_grad()
def check_tokens(backbone: Backbone, images: torch.Tensor) -> None:
    """Pooled tokens have the sizes that caches and memories are made for, image by image."""
    flat = images.flatten(0, 1)
    for pooled in (backbone.grid, 1):
        tokens = backbone.pooled_tokens(flat, pooled, "mean")
        shape = (len(flat), pooled**2, backbone.vision_width)
        assert tokens.shape == shape, f"pooled_tokens at grid {pooled} must be {shape}; got {tuple(tokens.shape)}."
    error = float((backbone.pooled_tokens(flat[1:2], 1, "mean") - tokens[1:2]).abs().max())
    assert error <= TOLERANCE, f"an image's tokens depend on its batch (by {error:.2g})."


@torch.no_grad()
def check_loss(backbone: Backbone, batch: Batch, images: torch.Tensor) -> None:
    """The loss is one number a step, repeats with the same draws, and does not read padding."""
    inject = _without_names(_table(backbone.observation_blocks(batch, images)))
    draws = backbone.loss_draws(2, torch.Generator().manual_seed(0))
    assert all(len(value) == 2 for value in draws.values()), "every value of loss_draws(n) must have n rows."
    again = backbone.loss_draws(2, torch.Generator().manual_seed(0))
    assert all(torch.equal(draws[key], again[key]) for key in draws), "loss_draws must follow its generator alone."
    loss = backbone.loss(batch, images, inject, draws)
    assert loss.shape == (2, backbone.horizon), f"loss must be [b, h]; got {tuple(loss.shape)}."
    assert torch.isfinite(loss).all() and (loss > 0).any(), "the loss of random actions must be finite and not zero."
    assert torch.equal(loss, backbone.loss(batch, images, inject, draws)), "the same draws must give the same loss."
    other = Batch(**{**vars(batch), "prompt": batch.prompt.masked_fill(~batch.prompt_mask, 3)})
    error = float((backbone.loss(other, images, inject, draws) - loss).abs().max())
    assert error <= TOLERANCE, f"tokens in the prompt's padding changed the loss by {error:.2g}."


@torch.no_grad()
def check_sample(backbone: Backbone, batch: Batch, images: torch.Tensor) -> None:
    """A sample is a chunk, repeats with the same draws, and depends on the observation."""
    inject = _without_names(_table(backbone.observation_blocks(batch, images)))
    one = backbone.sample_draws(torch.Generator().manual_seed(0))
    draws = {key: torch.stack([value, value]) for key, value in one.items()}
    chunk = backbone.sample(batch, images, inject, draws)
    shape = (2, backbone.horizon, backbone.action_dim)
    assert chunk.shape == shape, f"sample must be {shape}; got {tuple(chunk.shape)}."
    assert torch.isfinite(chunk).all(), "a sampled chunk is not finite."
    assert torch.equal(chunk, backbone.sample(batch, images, inject, draws)), "the same draws must give the same chunk."


def check_parts(backbone: Backbone) -> None:
    """Every parameter belongs to a part, and the parts fine-tuning freezes have parameters."""
    import re

    parts = set()
    for name, _ in backbone.named_parameters():
        part = next((part for part, pattern in backbone.parts().items() if re.match(pattern, name)), None)
        assert part is not None, f"no part of parts() holds {name!r}; its last pattern must match the rest."
        parts.add(part)
    assert {"vision", "action"} <= parts, f"parts() must name 'vision' and 'action'; parameters fall into {parts}."
    names = [name for name, _ in backbone.named_modules()]
    for end in (*backbone.lora_targets, *backbone.heads):
        assert any(f".{name}".endswith(f".{end}") for name in names), f"{end!r} ends no module's name."
