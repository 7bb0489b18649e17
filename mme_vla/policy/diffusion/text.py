"""The goal's words as one vector of unit length, computed once for each goal."""

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.errors import UserError, missing_extra
from mme_vla.processing.goal_encoders import HASHED, GoalEncoder, direction_of

if TYPE_CHECKING:
    from transformers import CLIPTextModelWithProjection

CLIP = "openai/clip-vit-base-patch32"
CLIP_WIDTH = 512
LONGEST = 77
"""Tokens that CLIP reads."""


class HashedWords(GoalEncoder):
    """The sum of one fixed random direction a word: equal words, equal vectors. To try things out without CLIP."""

    def encode(self, text: str) -> Tensor:
        total = torch.zeros(self.width)
        for word in text.lower().split() or [""]:
            total += direction_of(word, self.width)
        return functional.normalize(total, dim=0)


class ClipText(GoalEncoder):
    """CLIP's text tower and projection, frozen, on the CPU; read when the first text is asked for."""

    def __init__(self, width: int, source: str | Path = CLIP) -> None:
        """Remember where it is.

        Args:
            source: the hub's name of a CLIP, or a folder as transformers writes them.
        """
        super().__init__(width)
        self.source = str(source)

    @cached_property
    def _parts(self) -> tuple[Any, "CLIPTextModelWithProjection"]:
        try:
            from transformers import CLIPTextModelWithProjection, CLIPTokenizer
        except ImportError:
            raise missing_extra("Diffusion Policy", "baselines") from None
        try:
            tokenizer = CLIPTokenizer.from_pretrained(self.source)
            tower = CLIPTextModelWithProjection.from_pretrained(self.source)
        except (OSError, ValueError) as error:
            raise UserError(
                f"The text tower {self.source} cannot be had ({str(error).splitlines()[0]}). Connect once so that it "
                "is kept, give a folder that holds it (processor.text=<folder>), or try things out with "
                "processor.text=hashed."
            ) from None
        if tower.config.projection_dim != self.width:
            raise UserError(
                f"{self.source} gives {tower.config.projection_dim} numbers a text, the network reads {self.width}: "
                "set backbone.text_dim."
            )
        return tokenizer, tower.eval().requires_grad_(False)

    def encode(self, text: str) -> Tensor:
        tokenizer, tower = self._parts
        read = tokenizer([text], padding="longest", truncation=True, max_length=LONGEST, return_tensors="pt")
        return text_features(tower, read["input_ids"], read["attention_mask"])[0]


@torch.no_grad()
def text_features(tower: "CLIPTextModelWithProjection", ids: Tensor, mask: Tensor) -> Tensor:
    """Token ids and mask [b, l] → the projected state of each end of text, of unit length [b, d]."""
    return functional.normalize(tower(input_ids=ids, attention_mask=mask).text_embeds, dim=-1)


def text_encoder(name: str, width: int) -> GoalEncoder:
    """The encoder called `hashed` or `clip`, or a CLIP in a folder of one's own."""
    if name == HASHED:
        return HashedWords(width)
    return ClipText(width, CLIP if name == "clip" else name)
