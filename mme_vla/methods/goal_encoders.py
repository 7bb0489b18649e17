"""The goal's words through an encoder that does not learn: asked once for each goal, and known by its name alone."""

import hashlib
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, brief, require
from mme_vla.processing.base import PolicyProcessor, read_settings
from mme_vla.processing.normalise import NormStats
from mme_vla.processing.prompt import checked_text
from mme_vla.utils import check_sums, inside

HASHED = "hashed"
"""The encoder that makes fixed random vectors of words, to try things out without a download."""


class GoalEncoder:
    """Texts → numbers `width` wide. Nothing of it learns, and nothing is saved with a policy but its name."""

    def __init__(self, width: int) -> None:
        self.width = width
        self._known: dict[str, Tensor] = {}

    def __call__(self, text: str) -> Tensor:
        """What a text becomes."""
        if checked_text(text, "the goal") not in self._known:
            self._known[text] = self.encode(text)
        return self._known[text]

    def encode(self, text: str) -> Tensor:
        """What a text becomes that is not known yet."""
        raise NotImplementedError


def direction_of(word: str, width: int) -> Tensor:
    """A fixed random vector [width]: equal words, equal vectors, on every machine."""
    seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:8], "big") >> 1
    return torch.randn(width, generator=torch.Generator().manual_seed(seed))


def load_with_goal_encoder[P: PolicyProcessor](
    kind: type[P], name: str, folder: Path, encoder: Path | str | None, trusted: tuple[str, ...]
) -> P:
    """Build a processor whose `text` names an encoder from a folder of a checkpoint, which may be untrusted.

    Args:
        name: of this kind of processor. encoder: in place of what `processor.json` names. trusted: encoders that are
            taken on a checkpoint's word.
    """
    settings = read_settings(folder)
    require(settings.pop("name", None) == name, f"{folder} holds a processor of another kind of policy.")
    text, stats = settings.get("text"), settings.pop("stats", None)
    if encoder is not None:
        settings["text"] = str(encoder)
    elif text not in trusted:
        raise UserError(
            f"{folder} takes its text tower from {brief(text, 200)}, which is not read on a checkpoint's word. If "
            f"you trust it: from_pretrained(…, tokenizer={brief(text, 200)})."
        )
    try:
        options: dict[str, Any] = {"embodiment": Embodiment.from_dict(settings.pop("embodiment", {}))}
        if stats is not None:
            require(isinstance(stats, str), f"stats={brief(stats)} must be the name of a file.")
            path = inside(folder, stats, "statistics")
            check_sums(folder, [stats])
            options["stats"] = NormStats.load(path)
        return kind(**options, **settings)
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise UserError(f"{folder}: its processor cannot be built ({error}).") from None
