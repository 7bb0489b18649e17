"""Stacking items of one dataset into a batch."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from mme_vla.memory.base import stack_history
from mme_vla.processing.past_views import stack_past
from mme_vla.types import Batch


def collate(items: Sequence[dict[str, Any]]) -> Batch:
    """Stack items of one dataset into a `Batch`, without the prompt padding that none of them uses."""

    def stack(name: str) -> Tensor:
        return torch.stack([item[name] for item in items])

    images = stack("images")
    batch = Batch(
        images=images,
        image_mask=torch.ones(images.shape[:2], dtype=torch.bool),
        prompt=stack("prompt"),
        prompt_mask=stack("prompt_mask"),
        history=stack_history([item["history"] for item in items]) if "history" in items[0] else None,
        actions=stack("actions"),
        action_mask=stack("action_mask") if "action_mask" in items[0] else None,
        state=stack("state"),
        past=stack_past([item.get("past") for item in items]),
    )
    return batch.without_prompt_padding()
