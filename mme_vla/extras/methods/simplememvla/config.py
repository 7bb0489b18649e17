"""Sizes of SimpleMemVLA's network: `configs/backbone/simplememvla*.yaml`, where each
is explained.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Final, Self

from mme_vla.config.sections import (
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveInt,
    Range,
    read_section,
)
from mme_vla.errors import UserError, brief, missing_extra

NAME: Final = "simplememvla"
LARGEST = 2**24
"""Bound of every size: a number of a damaged file exceeds it, and would take memory."""


@dataclass(frozen=True)
class HeadSizes:
    """The action head: a transformer over condition tokens, one state token and the chunk.

    rope_section: shares of (time, row, column) in the rotary angles, scaled to `rope_factor` of
        half a head's width.
    time_alpha: flow times are Beta(time_alpha, 1), 1 = noise.
    """

    width: PositiveInt = 2048
    depth: PositiveInt = 16
    heads: PositiveInt = 16
    mlp_ratio: Positive = 3.5
    rope_theta: Positive = 1e7
    rope_section: tuple[NonNegativeInt, NonNegativeInt, NonNegativeInt] = (11, 11, 10)
    rope_factor: Annotated[float, Range(above=0, most=1)] = 0.25
    dropout: Annotated[float, Range(least=0, most=0.99)] = 0.0
    state_dropout: Annotated[float, Range(least=0, most=1)] = 0.0
    time_alpha: Positive = 1.5

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise UserError(
                f"backbone.head.width={self.width} must be a multiple of"
                f" backbone.head.heads={self.heads}."
            )
        if not sum(self.rope_section):
            raise UserError(
                "backbone.head.rope_section=[0, 0, 0] leaves no rotary angle: give a share to an"
                " axis."
            )


@dataclass(frozen=True)
class SimpleMemVlaSizes:
    """The keys of the section `backbone`.

    vlm: a `Qwen3_5Config` of transformers, in its own keys (`text_config`, `vision_config`).
    image_size: side of the images, in pixels, that costs are counted at and that a memory's frames
        are resized to.
    state_dim: numbers of the state token; 0 for none.
    memory_width: of a memory's tokens before their projection.
    """

    vlm: Mapping[str, Any]
    action_dim: PositiveInt
    horizon: PositiveInt
    state_dim: NonNegativeInt
    head: HeadSizes = field(default_factory=HeadSizes)
    image_size: PositiveInt = 256
    memory_width: PositiveInt = 1024
    action_weight: NonNegative = 1.0
    words_weight: NonNegative = 1.0

    @classmethod
    def from_dict(cls, section: Mapping[str, Any]) -> Self:
        """Read the section `backbone` of a configuration."""
        values = dict(section)
        if (name := values.pop("name", None)) != NAME:
            raise UserError(
                f"backbone.name={brief(name)} is no network of SimpleMemVLA: choose"
                " backbone=simplememvla, or simplememvla_tiny to try things out."
            )
        return read_section(cls, values, "backbone")

    def __post_init__(self) -> None:
        if self.image_size % self.factor:
            raise UserError(
                f"backbone.image_size={self.image_size} must be a multiple of {self.factor} pixels."
            )

    @cached_property
    def qwen(self) -> Any:
        """The vision-language model's `Qwen3_5Config`, with tied embeddings."""
        try:
            from transformers import Qwen3_5Config
        except ImportError:
            raise missing_extra("SimpleMemVLA", "vlm") from None
        _check_numbers(self.vlm, "backbone.vlm")
        try:
            config: Any = Qwen3_5Config(**self.vlm)
            config.tie_word_embeddings = config.text_config.tie_word_embeddings = True
            vision, text = config.vision_config, config.text_config
            fits = (
                vision.out_hidden_size == text.hidden_size
                and not vision.hidden_size % vision.num_heads
            )
        except Exception as error:  # transformers raises its own kinds
            raise UserError(
                f"backbone.vlm is no Qwen3_5Config: {brief(str(error), 300, quote=False)}"
            ) from None
        if not fits:
            raise UserError(
                f"backbone.vlm: vision_config.out_hidden_size={vision.out_hidden_size} must be"
                f" text_config.hidden_size={text.hidden_size}, and vision_config.num_heads must"
                " divide its hidden_size."
            )
        return config

    @property
    def width(self) -> int:
        """Of a token of the language model."""
        return int(self.qwen.text_config.hidden_size)

    @property
    def factor(self) -> int:
        """Pixels of a side that become one token of the language model."""
        return int(self.qwen.vision_config.patch_size * self.qwen.vision_config.spatial_merge_size)


def _check_numbers(section: Any, where: str) -> None:
    """Raise an error if a size is not one: transformers would take the memory."""
    values = section.items() if isinstance(section, Mapping) else enumerate(section)
    for key, value in values:
        if isinstance(value, Mapping | list | tuple):
            _check_numbers(value, f"{where}.{key}")
        elif isinstance(value, int) and not isinstance(value, bool) and not -1 <= value <= LARGEST:
            raise UserError(f"{where}.{key}={brief(value)} is larger than any network can be.")
