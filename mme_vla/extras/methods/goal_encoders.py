"""The goal's words through an encoder that does not learn: asked once for each goal, and known by
its name alone.
"""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, brief, missing_extra, require
from mme_vla.policy.tensor_files import check_transformers_folder
from mme_vla.processing.base import PolicyProcessor, PromptSpec, read_settings
from mme_vla.processing.normalise import NormStats
from mme_vla.processing.prompt import checked_text
from mme_vla.utils import checked_file

HASHED = "hashed"
"""The encoder that makes fixed random vectors of words, to try things out without a download."""


class GoalEncoder:
    """Texts → numbers `width` wide. Nothing of it learns, and nothing is saved with a policy but
    its name.
    """

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


class ClipEncoder(GoalEncoder):
    """A CLIP's tokenizer and text tower, frozen, on the CPU; loaded with the first text.

    Args:
        source: the hub's name of a CLIP, or a folder as transformers writes them.

    method: what it is for.
    tower: its class in transformers.
    size, option: how its configuration and this library's call the width.
    """

    method: ClassVar[str]
    tower: ClassVar[str]
    size: ClassVar[str]
    option: ClassVar[str]

    def __init__(self, width: int, source: str | Path) -> None:
        super().__init__(width)
        self.source = str(source)

    @cached_property
    def parts(self) -> tuple[Any, Any]:
        """The tokenizer and the tower."""
        try:
            import transformers
        except ImportError:
            raise missing_extra(self.method, "baselines") from None
        check_transformers_folder(self.source)
        try:
            tokenizer = transformers.CLIPTokenizer.from_pretrained(self.source)
            tower = getattr(transformers, self.tower).from_pretrained(self.source)
        except (OSError, ValueError) as error:
            raise UserError(
                f"The text tower {self.source} cannot be had ({str(error).splitlines()[0]})."
                " Connect once so that it is kept, give a folder that holds it"
                " (processor.text=<folder>), or try things out with processor.text=hashed."
            ) from None
        width = getattr(tower.config, self.size)
        require(
            width == self.width,
            f"{self.source} gives {width} numbers, the network reads {self.width}: set"
            f" {self.option}.",
        )
        return tokenizer, tower.eval().requires_grad_(False)


class GoalProcessor(PolicyProcessor):
    """A processor whose prompt is what its encoder `text` makes of the goal; nothing else is read.

    name: the processor's in `processor.json`.
    trusted: encoders that are taken on a checkpoint's word.
    """

    name: ClassVar[str]
    trusted: ClassVar[tuple[str, ...]] = (HASHED,)
    text: GoalEncoder
    text_name: str

    @property
    def prompt_spec(self) -> PromptSpec:
        return PromptSpec(self.text_name)

    def prompt(
        self,
        goal: str,
        subgoal: str | None = None,
        state: np.ndarray | Tensor | None = None,
        past_actions: np.ndarray | Tensor | None = None,
    ) -> Tensor:
        return self.text(goal)

    @classmethod
    def load(cls, folder: Path | str, tokenizer: Path | str | None = None) -> Self:
        """Read what `save` wrote.

        Args:
            folder: of a checkpoint, which may be untrusted.
            tokenizer: the folder of a CLIP, in place of what `processor.json` names.
        """
        folder = Path(folder)
        settings = read_settings(folder)
        require(
            settings.pop("name", None) == cls.name,
            f"{folder} holds a processor of another kind of policy.",
        )
        stats = settings.pop("stats", None)
        text = settings.pop("text", None)
        if tokenizer is not None:
            text = str(tokenizer)
        elif text not in cls.trusted:
            raise UserError(
                f"{folder} takes its text tower from {brief(text, 200)}, which is not read on a"
                " checkpoint's word. If you trust it: from_pretrained(…,"
                f" tokenizer={brief(text, 200)})."
            )
        try:
            robot = Embodiment.from_dict(settings.pop("embodiment", {}))
            options: dict[str, Any] = {"text": text, "embodiment": robot}
            if stats is not None:
                require(isinstance(stats, str), f"stats={brief(stats)} must be the name of a file.")
                options["stats"] = NormStats.load(checked_file(folder, stats, "statistics"))
            return cls(**options, **settings)
        except (TypeError, ValueError, KeyError, IndexError) as error:
            raise UserError(f"{folder}: its processor cannot be built ({error}).") from None
