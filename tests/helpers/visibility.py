"""Visibility tables with blocks and valid tokens for them."""

from collections.abc import Mapping

import torch
from torch import Tensor

from mme_vla.backbone.layers import PI05_VISIBILITY, Span, Visibility
from mme_vla.integration.base import MEMORY_VISIBILITY, memory_visibility

OWN: Visibility = {
    "memory": {"memory", "images"}, "images": {"prompt"}, "prompt": {"memory", "action"},
    "action": {"memory", "images", "prompt", "action"},
}  # fmt: skip
TABLES: Mapping[str, Visibility] = {
    "pi05": PI05_VISIBILITY,
    "memory": MEMORY_VISIBILITY,
    "paper": memory_visibility(prompt_sees_memory=False),
    "own": OWN,
}


def blocks_of(table: Visibility) -> list[Span]:
    return [Span(name, length) for name, length in zip(table, (5, 7, 6, 4), strict=False)]


def validity(n: int, seed: int = 0) -> Tensor:
    return torch.rand(3, n, generator=torch.Generator().manual_seed(seed)) < 0.7
