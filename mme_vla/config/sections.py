"""Read a section of a configuration into a dataclass: keys, kinds of values, bounds and choices are
checked once, by pydantic.

Annotations declare all of it: `port: Annotated[int, Range(0, 65535)]`,
`kind: Literal["simple", "grounded"]`. `__post_init__` is for what several keys mean together.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any

from annotated_types import BaseMetadata, Ge, GroupedMetadata, Gt, Le
from pydantic import AllowInfNan, BeforeValidator, Field, StringConstraints

from mme_vla.errors import UserError, brief
from mme_vla.utils.validation import unknown_key, validated


@dataclass(frozen=True)
class Range(GroupedMetadata):
    """Bounds of a number: from `least` to `most`, and larger than `above`."""

    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf

    def __iter__(self) -> Iterator[BaseMetadata]:
        """The bounds as pydantic reads them."""
        if math.isfinite(self.least):
            yield Ge(self.least)
        if math.isfinite(self.most):
            yield Le(self.most)
        if math.isfinite(self.above):
            yield Gt(self.above)


Positive = Annotated[float, Range(above=0), AllowInfNan(False)]
NonNegative = Annotated[float, Range(least=0), AllowInfNan(False)]
PositiveInt = Annotated[int, Range(least=1)]
NonNegativeInt = Annotated[int, Range(least=0)]


def _number_as_text(value: Any) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return str(value) if is_number else value


PathText = Annotated[str, StringConstraints(pattern=r"\S"), BeforeValidator(_number_as_text)]
"""A path or a name, never empty. A command line reads a folder called `7` as a number."""


Secret = Annotated[
    PathText | None,
    BeforeValidator(lambda value: value or None),
    Field(json_schema_extra={"writeOnly": True}),
]
"""A key that a server asks for, which no message shows. An empty environment variable, as compose
files leave it, is no key.
"""


def read_section[T](
    kind: type[T], values: Any, where: str = "", *, others: bool = False, **fixed: Any
) -> T:
    """Build a dataclass from a mapping.

    Args:
        kind: a dataclass, with annotations that pydantic knows. Lists become tuples, whole numbers
            become `float` where one is wanted, and dataclasses are sections of their own. Nothing
            else is converted: a text never becomes a number.
        values: the section.
        where: its dotted name in messages; empty for the top level.
        others: ignore keys that are no fields.
        fixed: fields that the section does not set.

    Raises:
        UserError: the first key that does not fit, with its value and what is allowed.
    """
    known = [spec.name for spec in fields(kind) if spec.init and spec.name not in fixed]  # type: ignore[arg-type]
    if others and isinstance(values, Mapping):
        values = {key: value for key, value in values.items() if key in known}
    section = {**section_keys(values, where, known), **fixed}
    return validated(kind, section, where or "the configuration", where, strict=True)


def without(section: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    """A section but for some of its keys, such as the `name` that chose its class."""
    return {key: value for key, value in section.items() if key not in keys}


def section_keys(values: Any, where: str, known: Iterable[str]) -> dict[str, Any]:
    """A mapping with no unknown key."""
    if not isinstance(values, Mapping):
        raise UserError(
            f"{where or 'the configuration'} must be a section of keys, got {brief(values)}."
        )
    for key in values:
        if key not in known:
            raise UserError(unknown_key(where, key, known))
    return {str(key): value for key, value in values.items()}
