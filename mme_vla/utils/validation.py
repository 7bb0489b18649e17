"""Checks of values from outside with pydantic, whose mistakes become one paragraph.

Files, messages and command lines are checked once, where they come in. The code behind that trusts
the checked object.
"""

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from mme_vla.errors import UserError, brief, did_you_mean, listed

_TYPES = {
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "string_type": "a text",
    "string_parsing": "a text",
    "dataclass_type": "a section of keys",
    "model_type": "a section of keys",
    "dict_type": "a map of keys",
    "tuple_type": "a list",
}
"""What a value must be, by pydantic's names of mistakes."""


def validated[T](kind: type[T], value: object, what: str, where: str = "") -> T:
    """Check a value against a pydantic model, a dataclass or any other type pydantic knows.

    A validator of a field raises a `ValueError` whose text continues the name of the key. A text
    that ends with a full stop is the whole sentence; otherwise the value is added:
    `ValueError("must be an even number")` becomes "steps must be an even number, got 3."

    Args:
        kind: the type.
        value: what came from outside.
        what: its name at the beginning of a sentence, such as "The request".
        where: the dotted key of `value` itself, which precedes the keys inside it.

    Raises:
        UserError: the first value that does not fit, by its key, with what is allowed.
    """
    try:
        checked: T = _adapter(kind).validate_python(value)  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise UserError(_sentence(first, kind, what, where)) from None
    return checked


@lru_cache(maxsize=64)
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _sentence(error: ErrorDetails, kind: Any, what: str, where: str) -> str:
    """Say what is wrong with one value."""
    key = _key(where, error["loc"]) or what
    value, rule = error["input"], error["type"]
    if rule == "missing":
        meaning = _descriptions(kind).get(str(error["loc"][-1]), "")
        present = listed(value) if isinstance(value, Mapping) and value else "none"
        lacking = _key("", error["loc"])
        if meaning:
            lacking += f" ({meaning})"
        return f"{what} lacks {lacking}; it has {present}."
    if rule in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _descriptions(kind) if len(error["loc"]) == 1 else {}
        near = did_you_mean(str(error["loc"][-1]), known) if known else "Leave it out."
        return f"Unknown key {key}. {near}"
    if rule == "value_error":
        text = str(error["ctx"]["error"])
        return f"{key} {text}" if text.endswith(".") else f"{key} {text}, got {described(value)}."
    if rule == "literal_error" and isinstance(value, str):
        choices = re.findall(r"'([^']*)'", error["ctx"]["expected"])
        return f"{key}={brief(value)}. {did_you_mean(value[:200], choices)}"
    if rule in _TYPES:
        return f"{key}={described(value)} must be {_TYPES[rule]}."
    # pydantic's own sentences: "Input should be greater than 0".
    _, _, expected = error["msg"].partition(" should ")
    return f"{key}={described(value)} must {expected or error['msg']}."


def _key(where: str, location: tuple[int | str, ...]) -> str:
    """The dotted name of a value, with the numbers of list entries in brackets."""
    key = where
    for part in location:
        if isinstance(part, int):
            key += f"[{part}]"
        else:
            name = brief(part, quote=False)
            key = f"{key}.{name}" if key else name
    return key


def _descriptions(kind: Any) -> dict[str, str]:
    """What each key of a model means, by the name that the outside uses."""
    if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
        return dict.fromkeys(getattr(kind, "__dataclass_fields__", {}), "")
    meanings = {}
    for name, field in kind.model_fields.items():
        meanings[field.alias or name] = field.description or ""
    return meanings


def described(value: object) -> str:
    """A value for a message: arrays by dtype and shape, lists by length, all else as `brief`.

    >>> described([np.zeros((2, 3), np.uint8)])
    'a list of 1 value, the first: uint8 [2, 3]'
    """
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {list(value.shape)}"
    if isinstance(value, list | tuple):
        if not value:
            return "an empty list"
        count = "1 value" if len(value) == 1 else f"{len(value)} values"
        first = "a list" if isinstance(value[0], list | tuple) else described(value[0])
        return f"a list of {count}, the first: {first}"
    if isinstance(value, Mapping):
        return f"a map of {listed(value, 4) or 'nothing'}"
    return brief(value)
