"""The goal's words as tokens: CLIP's text tower before its projection, or fixed random words to try things out."""

from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from mme_vla.errors import UserError, missing_extra
from mme_vla.processing.goal_encoders import HASHED, GoalEncoder, direction_of


class GoalTokens(GoalEncoder):
    """Texts → tokens [words, width]."""

    def __init__(self, width: int, words: int) -> None:
        super().__init__(width)
        self.words = words


class HashedTokens(GoalTokens):
    """One fixed random vector a word, zeros behind the last: equal words, equal vectors."""

    def encode(self, text: str) -> Tensor:
        """See `GoalTokens`."""
        tokens = torch.zeros(self.words, self.width)
        for place, word in enumerate(text.lower().split()[: self.words]):
            tokens[place] = direction_of(word, self.width)
        return tokens


class ClipTokens(GoalTokens):
    """All states of a CLIP's text tower after its last norm, frozen, on the CPU; read when the first text is asked for.

    The released model reads OpenAI's RN50 text tower (width 512), which no repository of the hub holds in this form.
    """

    def __init__(self, width: int, words: int, folder: str) -> None:
        """Remember where it is: a folder with a CLIP text model and its tokenizer, as transformers writes them."""
        super().__init__(width, words)
        self.folder = folder

    @cached_property
    def _parts(self) -> tuple[Any, Any]:
        try:
            import transformers
        except ImportError as error:
            raise missing_extra("SAM2Act+", "baselines") from error
        try:
            tokenizer = transformers.CLIPTokenizer.from_pretrained(self.folder)
            tower = transformers.CLIPTextModel.from_pretrained(self.folder)
        except (OSError, ValueError) as error:
            raise UserError(
                f"No text tower of a CLIP at {self.folder} ({str(error).splitlines()[0]}). Give a folder that holds "
                "one (processor.text=<folder>), or processor.text=hashed to try things out."
            ) from None
        if tower.config.hidden_size != self.width:
            raise UserError(
                f"{self.folder} gives {tower.config.hidden_size} numbers a token, the network reads {self.width}: set "
                "backbone.language."
            )
        return tokenizer, tower.eval().requires_grad_(False)

    @torch.no_grad()
    def encode(self, text: str) -> Tensor:
        """See `GoalTokens`."""
        tokenizer, tower = self._parts
        read = tokenizer([text], padding="max_length", truncation=True, max_length=self.words, return_tensors="pt")
        # The released code fills with zeros, where transformers repeats the end-of-text token.
        ids = read["input_ids"] * read["attention_mask"]
        states: Tensor = tower(input_ids=ids).last_hidden_state
        return states[0]


def goal_tokens(name: str, width: int, words: int) -> GoalTokens:
    """The encoder called `hashed`, or a CLIP in a folder."""
    return HashedTokens(width, words) if name == HASHED else ClipTokens(width, words, name)
