"""Reads a section of a configuration into a dataclass: keys, kinds of values, bounds and choices
are checked once.

Annotations declare all of it: `port: Annotated[int, Range(0, 65535)]`,
`kind: Literal["simple", "grounded"]`. `__post_init__` is for what several keys mean together.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache, partial
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from mme_vla.errors import UserError, brief, did_you_mean, listed

_WORDS: Mapping[Any, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    NoneType: "null",
}


@dataclass(frozen=True)
class Range:
    """Bounds of a finite number: from `least` to `most`, and larger than `above`."""

    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf

    def holds(self, value: float) -> bool:
        """Whether a number is within the bounds."""
        return self.above < value < math.inf and self.least <= value <= self.most

    @property
    def text(self) -> str:
        if math.isfinite(self.most):
            return f" from {self.least:g} to {self.most:g}"
        return (
            f" above {self.above:g}" if math.isfinite(self.above) else f", {self.least:g} or more"
        )


Positive = Annotated[float, Range(above=0)]
NonNegative = Annotated[float, Range(least=0)]
PositiveInt = Annotated[int, Range(least=1)]
NonNegativeInt = Annotated[int, Range(least=0)]


class _MisfitError(Exception):
    """A value that its key does not take."""


def read_section[T](
    kind: type[T], values: Any, where: str = "", *, others: bool = False, **fixed: Any
) -> T:
    """Build a dataclass from a mapping.

    Args:
        kind: a dataclass. Its annotations: `bool`, `int`, `float` (whole numbers too), `str`,
            `Literal`, a dataclass (a section of its own), tuples of these (lists are taken),
            mappings, `Any`, unions, and numbers with a `Range`.
        values: the section. where: its dotted name in messages; empty for the top level.
        others: ignore keys that are no fields. fixed: fields that the section does not set.
    """
    specs = {spec.name: spec for spec in fields(kind) if spec.init and spec.name not in fixed}  # type: ignore[arg-type]
    needed = [
        n
        for n, spec in specs.items()
        if spec.default is MISSING and spec.default_factory is MISSING
    ]
    if others and isinstance(values, Mapping):
        values = {key: value for key, value in values.items() if key in specs}
    parsed, hints = section_keys(values, where, specs), _hints(kind)  # type: ignore[arg-type]
    if lacking := [key for key in needed if key not in parsed]:
        raise _lacking(where, lacking[0], parsed)
    read: dict[str, Any] = {}
    for key, value in parsed.items():
        name = f"{where}.{key}" if where else key
        try:
            read[key] = _converted(value, hints[key], name)
        except _MisfitError:
            assigned = f"={brief(value)}" if specs[key].repr else ""  # some values are secrets
            choices = isinstance(value, str) and _choices(hints[key])
            hint = (
                f". {did_you_mean(value, map(str, choices))}"
                if choices
                else f" must be {_expected(hints[key])}."
            )
            raise UserError(f"{name}{assigned}{hint}") from None
    return kind(**read, **fixed)


_hints = cache(partial(get_type_hints, include_extras=True))


@cache
def _parts(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """Origin and arguments of an annotation."""
    return get_origin(kind), get_args(kind)


def section_keys(
    values: Any, where: str, known: Iterable[str], required: Iterable[str] = ()
) -> dict[str, Any]:
    """A mapping with no unknown key, and with a value for every required one."""
    if not isinstance(values, Mapping):
        raise UserError(
            f"{where or 'the configuration'} must be a section of keys, got {brief(values)}."
        )
    for key in values:
        if key not in known:
            name = brief(key, quote=False)
            raise UserError(
                f"Unknown key {f'{where}.' if where else ''}{name}."
                f" {did_you_mean(str(key), list(known))}"
            )
    for key in required:
        if values.get(key) is None:
            raise _lacking(where, key, values)
    return {str(key): value for key, value in values.items()}


def _lacking(where: str, key: str, keys: Iterable[Any]) -> UserError:
    return UserError(
        f"{where or 'the configuration'} lacks the key {key!r}; it has {listed(keys) or 'none'}."
    )


def _converted(value: Any, kind: Any, name: str) -> Any:
    """The value of a field: sections are read, lists become tuples."""
    origin, inside = _parts(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        return _first_that_fits(value, inside, name)
    if is_dataclass(kind):
        return (
            value
            if isinstance(value, cast(type, kind))
            else read_section(cast(type, kind), value, name)
        )
    if origin is tuple:
        return _tuple(value, inside, name)
    if origin is Annotated:
        value = _converted(value, inside[0], name)
        fits = all(bound.holds(value) for bound in inside[1:] if isinstance(bound, Range))
    elif origin is Literal:
        fits = any(value == choice and type(value) is type(choice) for choice in inside)
    else:
        accepted = (int, float) if kind is float else (origin or kind,)
        fits = isinstance(value, bool) == (kind is bool) and isinstance(value, accepted)
    if not fits:
        raise _MisfitError
    return value


def _first_that_fits(value: Any, kinds: Sequence[Any], name: str) -> Any:
    for kind in kinds:
        if is_dataclass(kind) and isinstance(value, Mapping):
            # its own words for what is wrong inside
            return _converted(value, kind, name)
    for kind in kinds:
        if not is_dataclass(kind) or isinstance(value, cast(type, kind)):
            try:
                return _converted(value, kind, name)
            except _MisfitError:
                continue
    raise _MisfitError


def _tuple(value: Any, kinds: Sequence[Any], name: str) -> tuple[Any, ...]:
    endless = len(kinds) == 2 and kinds[1] is Ellipsis
    if (
        not isinstance(value, Sequence)
        or isinstance(value, str)
        or not (endless or len(value) == len(kinds))
    ):
        raise _MisfitError
    each = [kinds[0]] * len(value) if endless else kinds
    return tuple(_converted(item, kind, name) for item, kind in zip(value, each, strict=True))


def _choices(kind: Any) -> Sequence[Any]:
    if get_origin(kind) in (Union, UnionType):
        return [choice for part in get_args(kind) for choice in _choices(part)]
    return get_args(kind) if get_origin(kind) is Literal else ()


def _expected(kind: Any) -> str:
    """What a field takes, for messages."""
    inside = get_args(kind)
    if get_origin(kind) is Annotated:
        return f"{_expected(inside[0])}{inside[1].text}"
    if get_origin(kind) is Literal:
        return " or ".join(map(str, inside))
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(map(_expected, inside))
    if get_origin(kind) is tuple:
        if inside[-1] is Ellipsis:
            return f"a list, each {_expected(inside[0])}"
        return f"a list of {len(inside)} values: {', '.join(map(_expected, inside))}"
    return _WORDS.get(kind, "a section of keys")
