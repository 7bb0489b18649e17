"""Text that the policy writes: a line at each decision, which its next prompt has as the note
`scratchpad`.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla import Batch, MemoryTokens, register
from mme_vla.backbone.base import AuxiliaryLosses, HasLanguageHead, Injection
from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.processing import PromptFormat, PromptInput

NOTE = "scratchpad"


@register("prompt", "scratchpad")
class Scratchpad(PromptFormat):
    """The goal and the line of the decision before."""

    notes = writes = (NOTE,)

    def pieces(self, inputs: PromptInput) -> list[tuple[str, bool]]:
        return [(f"Task: {inputs.goal}; Notes: {inputs.notes[NOTE]};\nAction: ", True)]


@register("backbone", "pi05_writer")
class Writer(Pi05Backbone, AuxiliaryLosses, HasLanguageHead):
    """π0.5 with a small language head: all tokens of a line at once, from the mean of images and
    prompt.
    """

    note = NOTE

    def __init__(self, config: Any, extra_experts: Mapping[str, Any] | None = None) -> None:
        super().__init__(config, extra_experts)
        width = config.vlm.width
        self.slots = nn.Parameter(torch.randn(Scratchpad.note_length, width))
        self.line = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def logits(self, injection: Injection) -> Tensor:
        """Of a line's tokens, [b, l, vocabulary]."""
        means = [
            (b.tokens * b.mask[..., None]).sum(1) / b.mask.sum(1, keepdim=True)
            for b in injection.blocks
        ]
        return self.line(sum(means)[:, None] + self.slots) @ self.embedding.weight.T

    def losses(
        self, batch: Batch, injection: Injection, memory: MemoryTokens | None
    ) -> dict[str, Tensor]:
        logits = self.logits(injection).float()
        return {
            "line": nn.functional.cross_entropy(
                logits.mT, batch.labels[NOTE], reduction="none"
            ).mean(1)
        }

    def write(self, batch: Batch, injection: Injection) -> Tensor:
        return self.logits(injection).argmax(-1)
