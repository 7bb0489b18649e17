"""A section of a configuration as the dataclass it means: every key and every kind of value is checked here, once.

What a value means (a bound, a choice) is checked by the dataclass itself, in `__post_init__`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

from mme_vla.errors import UserError, brief, did_you_mean, listed

_WORDS: Mapping[Any, str] = {
    bool: "true or false", int: "a whole number", float: "a number", str: "a text", NoneType: "null",
}  # fmt: skip


class _MisfitError(Exception):
    """A value of another kind than its key's."""


def read_section[T](kind: type[T], values: Any, where: str = "", *, others: bool = False, **fixed: Any) -> T:
    """Build a dataclass from a mapping.

    Args:
        kind: a dataclass; the annotations of its fields say what their values must be: `bool`, `int`, `float` (whole
            numbers too), `str`, a dataclass (a section of its own), tuples of these (lists are taken), mappings, `Any`,
            and unions with None.
        values: the section. where: its dotted name in messages; empty for the top level.
        others: whether keys of other purposes may stand in it; they are left aside.
        fixed: fields that the section does not decide.
    """
    specs = {spec.name: spec for spec in fields(kind) if spec.init and spec.name not in fixed}  # type: ignore[arg-type]
    needed = [n for n, spec in specs.items() if spec.default is MISSING and spec.default_factory is MISSING]
    if others and isinstance(values, Mapping):
        values = {key: value for key, value in values.items() if key in specs}
    parsed, hints = section_keys(values, where, specs), get_type_hints(kind)
    for key in needed:
        if key not in parsed:
            raise _lacking(where, key, parsed)
    read: dict[str, Any] = {}
    for key, value in parsed.items():
        name = f"{where}.{key}" if where else key
        try:
            read[key] = _converted(value, hints[key], name)
        except _MisfitError:
            assigned = f"={brief(value)}" if specs[key].repr else ""  # some values are secrets
            raise UserError(f"{name}{assigned} must be {_expected(hints[key])}.") from None
    return kind(**read, **fixed)


def section_keys(values: Any, where: str, known: Iterable[str], required: Iterable[str] = ()) -> dict[str, Any]:
    """A mapping with no unknown key, and with a value for every required one."""
    if not isinstance(values, Mapping):
        raise UserError(f"{where or 'the configuration'} must be a section of keys, got {brief(values)}.")
    for key in values:
        if key not in known:
            name = brief(key, quote=False)
            raise UserError(f"Unknown key {f'{where}.' if where else ''}{name}. {did_you_mean(str(key), list(known))}")
    for key in required:
        if values.get(key) is None:
            raise _lacking(where, key, values)
    return {str(key): value for key, value in values.items()}


def _lacking(where: str, key: str, keys: Iterable[Any]) -> UserError:
    return UserError(f"{where or 'the configuration'} lacks the key {key!r}; it has {listed(keys) or 'none'}.")


def _converted(value: Any, kind: Any, name: str) -> Any:
    """The value as its field wants it: sections read, lists as tuples."""
    origin, inside = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        return _first_that_fits(value, inside, name)
    if is_dataclass(kind):
        return value if isinstance(value, cast(type, kind)) else read_section(cast(type, kind), value, name)
    if origin is tuple:
        return _tuple(value, inside, name)
    accepted = (int, float) if kind is float else (origin or kind,)
    if isinstance(value, bool) != (kind is bool) or not isinstance(value, accepted):
        raise _MisfitError
    return value


def _first_that_fits(value: Any, kinds: Sequence[Any], name: str) -> Any:
    for kind in kinds:
        if is_dataclass(kind) and isinstance(value, Mapping):  # its own words for what is wrong inside
            return _converted(value, kind, name)
    for kind in kinds:
        if not is_dataclass(kind) or isinstance(value, cast(type, kind)):
            try:
                return _converted(value, kind, name)
            except _MisfitError:
                continue
    raise _MisfitError


def _tuple(value: Any, kinds: Sequence[Any], name: str) -> tuple[Any, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise _MisfitError
    endless = len(kinds) == 2 and kinds[1] is Ellipsis
    if not endless and len(value) != len(kinds):
        raise _MisfitError
    each = [kinds[0]] * len(value) if endless else kinds
    return tuple(_converted(item, kind, name) for item, kind in zip(value, each, strict=True))


def _expected(kind: Any) -> str:
    """The words for what a field takes."""
    inside = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(map(_expected, inside))
    if get_origin(kind) is tuple:
        if inside[-1] is Ellipsis:
            return f"a list, each {_expected(inside[0])}"
        return f"a list of {len(inside)} values: {', '.join(map(_expected, inside))}"
    return _WORDS.get(kind, "a section of keys")
