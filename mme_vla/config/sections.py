"""Read a section of a configuration into a dataclass: keys, kinds of values, bounds and choices are
checked once, by pydantic.

Annotations declare all of it: `port: Annotated[int, Range(0, 65535)]`,
`kind: Literal["simple", "grounded"]`. `__post_init__` is for what several keys mean together.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from annotated_types import BaseMetadata, Ge, GroupedMetadata, Gt, Le
from pydantic import AllowInfNan, BeforeValidator, TypeAdapter, ValidationError
from pydantic_core import PydanticSerializationError, to_json

from mme_vla.errors import UserError, brief, did_you_mean, listed

_WORDS: Mapping[Any, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    NoneType: "null",
}


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

    @property
    def text(self) -> str:
        """The bounds in words, to be read after "a number"."""
        if math.isfinite(self.above):
            upper = f" and at most {self.most:g}" if math.isfinite(self.most) else ""
            return f" above {self.above:g}{upper}"
        if math.isfinite(self.most):
            return f" from {self.least:g} to {self.most:g}"
        return f", {self.least:g} or more"


Positive = Annotated[float, Range(above=0), AllowInfNan(False)]
NonNegative = Annotated[float, Range(least=0), AllowInfNan(False)]
PositiveInt = Annotated[int, Range(least=1)]
NonNegativeInt = Annotated[int, Range(least=0)]


def _number_as_text(value: Any) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return str(value) if is_number else value


PathText = Annotated[str, BeforeValidator(_number_as_text)]
"""A path or a name. A command line reads a folder called `7` as a number."""


Secret = Annotated[PathText | None, BeforeValidator(lambda value: value or None)]
"""A key that a server asks for. An empty environment variable, as compose files leave it, is no
key.
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
    # Read as JSON, whose lists and maps may become tuples and dataclasses in strict mode.
    try:
        text = to_json(section, inf_nan_mode="constants", fallback=brief)
    except PydanticSerializationError as error:  # half of a surrogate pair
        raise UserError(
            f"{where or 'the configuration'} holds a text that is not Unicode: {brief(str(error))}."
        ) from None
    if kind not in _ADAPTERS:
        _ADAPTERS[kind] = TypeAdapter(kind)
    try:
        read: T = _ADAPTERS[kind].validate_json(text, strict=True, extra="forbid")
    except ValidationError as error:
        raise _mistake(error, kind, json.loads(text), where) from None
    return read


_ADAPTERS: dict[Any, TypeAdapter[Any]] = {}
"""pydantic's readers of the dataclasses that were read before."""


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
            raise _unknown(where, key, list(known))
    return {str(key): value for key, value in values.items()}


def _unknown(where: str, key: Any, known: Sequence[str]) -> UserError:
    name = brief(key, quote=False)
    if where:
        name = f"{where}.{name}"
    return UserError(f"Unknown key {name}. {did_you_mean(str(key), known)}")


def _mistake(error: ValidationError, kind: Any, value: Any, where: str) -> UserError:
    """What is wrong with the first key that pydantic refuses, in the words of its annotation."""
    errors = error.errors(include_url=False)
    # A misspelt key says more than the one that is missing for it.
    misspelt = [one for one in errors if one["type"] == "unexpected_keyword_argument"]
    first = misspelt[0] if misspelt else errors[0]
    problem = first.get("ctx", {}).get("error")
    if isinstance(problem, UserError):
        return problem  # of a `__post_init__`
    # Down to the key: what follows it are items of a list, and pydantic's names of alternatives.
    key = where
    is_secret = False
    for part in first["loc"]:
        section = _section_of(kind)
        if section is None or not isinstance(value, Mapping):
            break
        if is_dataclass(section):
            names = {spec.name: spec for spec in fields(section)}
            if first["type"] == "unexpected_keyword_argument" and part not in names:
                return _unknown(key, part, list(names))
            if part not in names:
                continue  # pydantic's name of an alternative
            if part not in value:
                return UserError(
                    f"{key or 'the configuration'} lacks the key {part!r}; it has"
                    f" {listed(value) or 'none'}."
                )
            kind = get_type_hints(section, include_extras=True)[str(part)]
            is_secret = not names[str(part)].repr
        elif part in value:
            kind = get_args(section)[1]
        else:
            break
        key = f"{key}.{part}" if key else str(part)
        value = value[part]
    assigned = "" if is_secret else f"={brief(value)}"
    choices = _choices(kind)
    if choices and isinstance(value, str):
        return UserError(f"{key}{assigned}. {did_you_mean(value, map(str, choices))}")
    return UserError(f"{key}{assigned} must be {_expected(kind)}.")


def _section_of(kind: Any) -> Any:
    """The dataclass or `Mapping` that an annotation names, alone or beside others; else None."""
    alternatives = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    for part in alternatives:
        if is_dataclass(part) or get_origin(part) is Mapping:
            return part
    return None


def _choices(kind: Any) -> Sequence[Any]:
    if get_origin(kind) is Literal:
        return get_args(kind)
    choices: list[Any] = []
    if get_origin(kind) in (Union, UnionType):
        for part in get_args(kind):
            choices += _choices(part)
    return choices


def _expected(kind: Any) -> str:
    """What a field takes, for messages."""
    inside = get_args(kind)
    if get_origin(kind) is Annotated:
        bounds = "".join(part.text for part in inside[1:] if isinstance(part, Range))
        return f"{_expected(inside[0])}{bounds}"
    if get_origin(kind) is Literal:
        return " or ".join(map(str, inside))
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(map(_expected, inside))
    if get_origin(kind) is tuple:
        if inside[-1] is Ellipsis:
            return f"a list, each {_expected(inside[0])}"
        return f"a list of {len(inside)} values: {', '.join(map(_expected, inside))}"
    return _WORDS.get(kind, "a section of keys")
